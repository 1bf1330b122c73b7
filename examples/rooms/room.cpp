// Rooms from a seed: a shell with recessed doors and windows, and furniture built from boxes,
// rounded boxes and turned shapes. Everything is built in the room's own frame and moved to the
// world last.
#include <algorithm>
#include <array>
#include <cmath>

#include "examples/rooms/rooms.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

// Random numbers with mappings of our own: those of <random> differ between standard libraries.
// Never two draws among the arguments of one call in parentheses: their order is the compiler's
// choice (that of a list in braces is fixed).
class Dice {
 public:
  explicit Dice(uint64_t seed) : engine_(seed) {}
  float real(float a, float b) { return a + (b - a) * float(double(engine_() >> 11) * 0x1p-53); }
  int integer(int a, int b) { return a + int((engine_() >> 33) % uint64_t(b - a + 1)); }
  bool chance(float p) { return real(0, 1) < p; }
  template <typename T, size_t N>
  const T& pick(const T (&items)[N]) {
    return items[size_t(integer(0, int(N) - 1))];
  }

 private:
  std::mt19937_64 engine_;
};

// Scene-linear from display sRGB 0-1, with a little variation of tone and tint.
Vector3f colour(Dice& dice, float r, float g, float b, float variation = .06f) {
  const float tone = dice.real(-variation, variation);
  Vector3f c(r, g, b);
  for (float& v : c)
    v = linearFromSrgb(
        std::clamp(v + tone + dice.real(-.3f * variation, .3f * variation), .02f, .95f));
  return c;
}

struct Rect {
  Vector2f min, max;
  bool overlaps(const Rect& o) const {
    return min.x() < o.max.x() && o.min.x() < max.x() && min.y() < o.max.y() && o.min.y() < max.y();
  }
  Rect grown(float m) const { return {min - Vector2f(m, m), max + Vector2f(m, m)}; }
};

/// Where a piece stands: its own x to the right, y away from its back, z up.
struct Place {
  Vector2f origin = Vector2f::Zero();
  float c = 1, s = 0;  // cosine and sine of its yaw; exact for quarter turns
  int wall = -1;

  static Place quarter(const Vector2f& origin, int turns, int wall = -1) {
    static constexpr float kC[4] = {1, 0, -1, 0}, kS[4] = {0, 1, 0, -1};
    return {origin, kC[turns & 3], kS[turns & 3], wall};
  }
  Vector3f direction(const Vector3f& d) const {
    return {c * d.x() - s * d.y(), s * d.x() + c * d.y(), d.z()};
  }
  Vector3f point(const Vector3f& p) const {
    return direction(p) + Vector3f(origin.x(), origin.y(), 0);
  }
  Place at(float x, float y, int turns = 0) const {
    const Vector3f p = point({x, y, 0});
    const Place q = quarter({0, 0}, turns);
    return {p.head<2>(), c * q.c - s * q.s, s * q.c + c * q.s, wall};
  }
  Rect rect(const Vector2f& lo, const Vector2f& hi) const {
    Eigen::AlignedBox2f box;
    for (float x : {lo.x(), hi.x()})
      for (float y : {lo.y(), hi.y()}) box.extend(point({x, y, 0}).head<2>());
    return {box.min(), box.max()};
  }
};

struct Opening {
  int wall;      // 0: y = 0, 1: x = W, 2: y = D, 3: x = 0
  float lo, hi;  // along the wall, room coordinate (x of walls 0 and 2, y of walls 1 and 3)
  float bottom, top, recess;
  bool is_window, has_curtains;
};

struct Palette {
  int wall, accent_wall, floor, ceiling, trim, wood, wood2, fabric, fabric2, accent, bedding, metal,
      dark, white, screen, leaf, soil, ceramic, lamp;
  std::array<int, 7> books;
};

class RoomBuilder {
 public:
  explicit RoomBuilder(uint64_t seed) : dice_(seed) { room_.seed = seed; }
  Room build();

 private:
  // --- shapes
  // -------------------------------------------------------------------------------------
  int vertex(const Vector3f& p_room) {
    room_.mesh.vertices.push_back(p_room);
    return int(room_.mesh.vertices.size()) - 1;
  }
  void triangle(int a, int b, int c, int material, const Vector3f& u, const Vector3f& v) {
    room_.mesh.triangles.emplace_back(a, b, c);
    room_.material.push_back(material);
    room_.tangent_u.push_back(u), room_.tangent_v.push_back(v);
  }
  /// Corners in order round the quad, room frame; the texture runs along `u`.
  void quadInRoom(const std::array<Vector3f, 4>& p, int material, const Vector3f& u,
                  const Vector3f& v) {
    int i[4];
    for (int k = 0; k < 4; ++k) i[k] = vertex(p[size_t(k)]);
    triangle(i[0], i[1], i[2], material, u, v);
    triangle(i[0], i[2], i[3], material, u, v);
  }
  void quad(const Place& at, const std::array<Vector3f, 4>& p, int material) {
    const Vector3f u = (p[1] - p[0]).normalized();
    const Vector3f n = u.cross(p[3] - p[0]);
    const Vector3f v = n.cross(u).normalized();
    quadInRoom({at.point(p[0]), at.point(p[1]), at.point(p[2]), at.point(p[3])}, material,
               at.direction(u), at.direction(v));
  }
  void box(const Place& at, const Vector3f& lo, const Vector3f& hi, int material);
  /// A box whose edges are rounded with `radius`: cushions, mattresses.
  void roundedBox(const Place& at, const Vector3f& lo, const Vector3f& hi, float radius,
                  int material);
  /// A turned shape about a vertical axis: (radius, z) from bottom to top, capped where radius > 0.
  void turned(const Place& at, float x, float y, const std::vector<Vector2f>& profile, int material,
              int sides = 14);
  void turnedShell(const Place& at, float x, float y, const std::vector<Vector2f>& profile,
                   int material, int sides = 14);
  void solid(const Place& at, const Vector3f& lo, const Vector3f& hi) {
    Eigen::AlignedBox3f box;
    for (float x : {lo.x(), hi.x()})
      for (float y : {lo.y(), hi.y()})
        for (float z : {lo.z(), hi.z()}) box.extend(at.point({x, y, z}));
    room_.solids.push_back(box);
  }
  void solidBox(const Place& at, const Vector3f& lo, const Vector3f& hi, int material) {
    box(at, lo, hi, material);
    solid(at, lo, hi);
  }
  void solidTurned(const Place& at, float x, float y, const std::vector<Vector2f>& profile,
                   int material, int sides = 14) {
    turned(at, x, y, profile, material, sides);
    float r = 0;
    for (const Vector2f& p : profile) r = std::max(r, p.x());
    solid(at, {x - r, y - r, profile.front().y()}, {x + r, y + r, profile.back().y()});
  }
  int material(Pattern pattern, const Vector3f& a, const Vector3f& b = Vector3f::Zero(),
               float period_m = .3f, float emission = 0) {
    Material m;
    m.pattern = pattern, m.colour_a = a, m.colour_b = b, m.period_m = period_m;
    m.emission = emission;
    room_.materials.push_back(m);
    return int(room_.materials.size()) - 1;
  }

  // --- materials, shell
  // ---------------------------------------------------------------------------
  int woodMaterial();
  int fabricMaterial(bool calm);
  void choosePalette();
  void chooseOpenings();
  bool openingFits(const Opening& o, float margin) const;
  void buildShell();
  void buildDoor(const Opening& o);
  void buildWindow(const Opening& o);
  void buildSkirting();

  // --- placement
  // ----------------------------------------------------------------------------------
  float wallLength(int wall) const { return wall % 2 ? size_.y() : size_.x(); }
  /// Frame at `along` (own x, from the wall's middle) of a wall: x along the wall, y into the room.
  Place wallPlace(int wall, float along = 0, float off = 0) const {
    const Vector2f middle[4] = {{size_.x() / 2, 0},
                                {size_.x(), size_.y() / 2},
                                {size_.x() / 2, size_.y()},
                                {0, size_.y() / 2}};
    return Place::quarter(middle[wall], wall, wall).at(along, off);
  }
  /// The opening's extent along its wall in the wall's own x.
  Vector2f alongWall(const Opening& o) const {
    const float half = wallLength(o.wall) / 2;
    return o.wall < 2 ? Vector2f(o.lo - half, o.hi - half) : Vector2f(half - o.hi, half - o.lo);
  }
  bool isFree(const Rect& footprint, const Rect& clearance) const;
  /// Finds room for a w x d x h piece with its back at a wall; false if there is none.
  bool placeAtWall(float w, float d, float h, float front, Place* out);
  bool placeFree(float w, float d, Place* out);
  void occupy(const Place& at, float w, float d, float h, float front);

  // --- furniture: x in [-w/2, w/2], y in [0, d] from the back
  // -------------------------------------
  void bed();
  void nightstand(const Place& at, float w, float d);
  void wardrobe();
  void drawers();
  void shelf();
  void sofaGroup();
  void armchair();
  void seat(const Place& at, float w, float d, int material, int cushions);
  void television();
  void diningGroup();
  void chair(const Place& at, int wood, int seat_material);
  void desk();
  void plant();
  void floorLamp();
  void tableLamp(const Place& at, float x, float y, float z);
  void ceilingLamp();
  void pictures();
  void rug(const Rect& r);
  void legs(const Place& at, const Vector2f& lo, const Vector2f& hi, float top, float thickness,
            int material);
  void books(const Place& at, float x0, float x1, float y0, float y1, float z, float height);
  void clutter(const Place& at, const Vector2f& lo, const Vector2f& hi, float z);

  Dice dice_;
  Room room_;
  Vector3f size_ = Vector3f::Zero();
  float lamps_on_ = 0;   // 0 in daylight, up to 1
  int chair_style_ = 0;  // one set of chairs a room
  bool has_rug_ = false;
  Palette palette_ = {};
  std::vector<Opening> openings_;
  std::vector<Rect> occupied_, keep_clear_;
  struct Covered {
    int wall;
    float lo, hi, top;  // wall's own x; what stands there reaches to `top`
  };
  std::vector<Covered> covered_;
  std::vector<Covered> window_sills_;  // only pieces lower than `top` may stand there
};

// --- shapes
// ---------------------------------------------------------------------------------------

void RoomBuilder::box(const Place& at, const Vector3f& lo, const Vector3f& hi, int material) {
  const Vector3f size = hi - lo;
  for (int axis = 0; axis < 3; ++axis) {
    // Grain runs along the longer side of each face.
    int a = (axis + 1) % 3, b = (axis + 2) % 3;
    if (size[a] < size[b]) std::swap(a, b);
    for (int side = 0; side < 2; ++side) {
      Vector3f p[4] = {lo, lo, lo, lo};
      for (Vector3f& q : p) q[axis] = side ? hi[axis] : lo[axis];
      p[1][a] = p[2][a] = hi[a];
      p[2][b] = p[3][b] = hi[b];
      quadInRoom({at.point(p[0]), at.point(p[1]), at.point(p[2]), at.point(p[3])}, material,
                 at.direction(Vector3f::Unit(a)), at.direction(Vector3f::Unit(b)));
    }
  }
}

void RoomBuilder::roundedBox(const Place& at, const Vector3f& lo, const Vector3f& hi, float radius,
                             int material) {
  const Vector3f centre = (lo + hi) / 2, half = (hi - lo) / 2;
  radius = std::min(radius, half.minCoeff());
  const Vector3f core = half.array() - radius;
  // Grid lines of a face on [-1, 1]: the flat middle and two steps round each edge.
  static constexpr float kStep[6] = {-1.f, -.4f, 0.f, 0.f, .4f, 1.f};
  const auto surface = [&](int axis, int side, int i, int j) {
    Vector3f q;
    q[axis] = side ? 1.f : -1.f;
    q[(axis + 1) % 3] = kStep[i], q[(axis + 2) % 3] = kStep[j];
    Vector3f sign;
    for (int k = 0; k < 3; ++k) {
      const int index = k == axis ? side * 5 : k == (axis + 1) % 3 ? i : j;
      sign[k] = index < 3 ? -1.f : 1.f;
    }
    return Vector3f(centre + sign.cwiseProduct(core) + radius * q.normalized());
  };
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      const Vector3f u = at.direction(Vector3f::Unit((axis + 1) % 3));
      const Vector3f v = at.direction(Vector3f::Unit((axis + 2) % 3));
      for (int i = 0; i < 5; ++i)
        for (int j = 0; j < 5; ++j)
          quadInRoom({at.point(surface(axis, side, i, j)), at.point(surface(axis, side, i + 1, j)),
                      at.point(surface(axis, side, i + 1, j + 1)),
                      at.point(surface(axis, side, i, j + 1))},
                     material, u, v);
    }
}

void RoomBuilder::turnedShell(const Place& at, float x, float y,
                              const std::vector<Vector2f>& profile, int material, int sides) {
  const auto ring = [&](const Vector2f& p, int k) {
    const float angle = 2 * float(M_PI) * float(k % sides) / float(sides);
    return Vector3f(x + p.x() * std::cos(angle), y + p.x() * std::sin(angle), p.y());
  };
  for (size_t i = 0; i + 1 < profile.size(); ++i)
    for (int k = 0; k < sides; ++k) {
      const Vector3f a = ring(profile[i], k), b = ring(profile[i], k + 1);
      const Vector3f c = ring(profile[i + 1], k + 1), d = ring(profile[i + 1], k);
      const Vector3f across = at.direction(ring({1, 0}, k + 1) - ring({1, 0}, k)).normalized();
      quadInRoom({at.point(a), at.point(b), at.point(c), at.point(d)}, material, across,
                 Vector3f::UnitZ());
    }
}

void RoomBuilder::turned(const Place& at, float x, float y, const std::vector<Vector2f>& profile,
                         int material, int sides) {
  turnedShell(at, x, y, profile, material, sides);
  for (const Vector2f& end : {profile.front(), profile.back()}) {
    if (end.x() <= 0) continue;
    const int middle = vertex(at.point({x, y, end.y()}));
    for (int k = 0; k < sides; ++k) {
      int corner[2];
      for (int e = 0; e < 2; ++e) {
        const float angle = 2 * float(M_PI) * float((k + e) % sides) / float(sides);
        corner[e] = vertex(
            at.point({x + end.x() * std::cos(angle), y + end.x() * std::sin(angle), end.y()}));
      }
      triangle(middle, corner[0], corner[1], material, Vector3f::UnitX(), Vector3f::UnitY());
    }
  }
}

void RoomBuilder::legs(const Place& at, const Vector2f& lo, const Vector2f& hi, float top,
                       float thickness, int material) {
  for (float x : {lo.x(), hi.x() - thickness})
    for (float y : {lo.y(), hi.y() - thickness})
      solidBox(at, {x, y, 0}, {x + thickness, y + thickness, top}, material);
}

// --- materials
// ------------------------------------------------------------------------------------

int RoomBuilder::woodMaterial() {
  static constexpr float kWood[][3] = {{.72f, .56f, .38f}, {.58f, .40f, .25f}, {.42f, .28f, .18f},
                                       {.80f, .68f, .52f}, {.66f, .46f, .28f}, {.90f, .88f, .84f},
                                       {.33f, .24f, .19f}, {.52f, .47f, .41f}};
  const auto& w = dice_.pick(kWood);
  const Vector3f a = colour(dice_, w[0], w[1], w[2]);
  const float grain = dice_.real(.55f, .8f);
  return material(Pattern::kPlanks, a, a * grain, dice_.real(.5f, .9f));
}

int RoomBuilder::fabricMaterial(bool calm) {
  static constexpr float kFabric[][3] = {
      {.55f, .55f, .56f}, {.30f, .36f, .46f}, {.72f, .66f, .57f}, {.36f, .44f, .38f},
      {.60f, .33f, .28f}, {.25f, .27f, .30f}, {.80f, .78f, .73f}, {.62f, .50f, .30f},
      {.40f, .52f, .58f}, {.55f, .42f, .48f}, {.78f, .60f, .35f}, {.35f, .25f, .22f}};
  const auto& f = dice_.pick(kFabric);
  const auto& g = dice_.pick(kFabric);
  const Vector3f a = colour(dice_, f[0], f[1], f[2]);
  if (calm || dice_.chance(.4f)) {
    const float shade = dice_.real(.7f, .9f);
    return material(Pattern::kNoise, a, a * shade, dice_.real(.01f, .03f));
  }
  const Vector3f b = colour(dice_, g[0], g[1], g[2]);
  const Pattern pattern = dice_.chance(.6f) ? Pattern::kStripes : Pattern::kChecks;
  return material(pattern, a, b, dice_.real(.06f, .22f));
}

void RoomBuilder::choosePalette() {
  static constexpr float kWalls[][3] = {{.90f, .89f, .86f}, {.88f, .85f, .78f}, {.82f, .83f, .84f},
                                        {.78f, .83f, .86f}, {.80f, .84f, .77f}, {.89f, .81f, .77f},
                                        {.86f, .80f, .66f}, {.92f, .91f, .90f}, {.74f, .74f, .72f}};
  static constexpr float kAccents[][3] = {
      {.32f, .42f, .50f}, {.40f, .50f, .42f}, {.62f, .36f, .30f}, {.52f, .46f, .56f},
      {.75f, .60f, .38f}, {.34f, .36f, .38f}, {.66f, .74f, .80f}, {.72f, .55f, .50f}};
  const auto& w = dice_.pick(kWalls);
  const auto& aw = dice_.pick(kAccents);
  const Vector3f wall = colour(dice_, w[0], w[1], w[2], .04f);
  palette_.wall = material(Pattern::kNoise, wall, wall * .95f, .25f);
  const Vector3f accent = colour(dice_, aw[0], aw[1], aw[2]);
  const float style = dice_.real(0, 1);
  palette_.accent_wall =
      style < .45f   ? palette_.wall
      : style < .75f ? material(Pattern::kNoise, accent, accent * .93f, .3f)
      : style < .9f  ? material(Pattern::kStripes, wall, (wall + accent) / 2, dice_.real(.12f, .3f))
                     : material(Pattern::kTiles, accent, accent * .6f, dice_.real(.15f, .3f));
  const float floor = dice_.real(0, 1);
  if (floor < .65f) {
    static constexpr float kFloors[][3] = {{.68f, .52f, .36f}, {.56f, .40f, .27f},
                                           {.76f, .64f, .49f}, {.45f, .31f, .22f},
                                           {.63f, .58f, .51f}, {.72f, .50f, .30f}};
    const auto& f = dice_.pick(kFloors);
    const Vector3f a = colour(dice_, f[0], f[1], f[2]);
    palette_.floor = material(Pattern::kPlanks, a, a * .6f, dice_.real(.09f, .2f));
  } else if (floor < .82f) {
    const Vector3f a = colour(dice_, .75f, .72f, .67f, .12f);
    const float grout = dice_.real(.5f, .75f);
    palette_.floor = material(Pattern::kTiles, a, a * grout, dice_.real(.25f, .6f));
  } else {
    const Vector3f a = colour(dice_, .60f, .57f, .53f, .15f);
    palette_.floor = material(Pattern::kNoise, a, a * .75f, dice_.real(.015f, .04f));
  }
  palette_.ceiling = material(Pattern::kPlain, colour(dice_, .93f, .93f, .92f, .02f));
  palette_.trim =
      material(Pattern::kPlain, dice_.chance(.75f) ? colour(dice_, .92f, .92f, .90f, .03f)
                                                   : colour(dice_, .50f, .36f, .25f));
  palette_.wood = woodMaterial(), palette_.wood2 = woodMaterial();
  palette_.fabric = fabricMaterial(true), palette_.fabric2 = fabricMaterial(false);
  palette_.accent = fabricMaterial(false);
  const Vector3f bedding = colour(dice_, .87f, .86f, .84f);
  palette_.bedding = material(Pattern::kNoise, bedding, bedding * .92f, .06f);
  palette_.metal = material(Pattern::kPlain, colour(dice_, .55f, .55f, .54f, .12f));
  palette_.dark = material(Pattern::kPlain, colour(dice_, .17f, .17f, .18f, .05f));
  palette_.white = material(Pattern::kPlain, colour(dice_, .90f, .90f, .89f, .03f));
  palette_.screen = material(Pattern::kPlain, colour(dice_, .08f, .085f, .09f, .02f));
  const Vector3f leaf = colour(dice_, .27f, .44f, .20f);
  palette_.leaf = material(Pattern::kNoise, leaf, leaf * .6f, .06f);
  palette_.soil = material(Pattern::kPlain, colour(dice_, .22f, .16f, .12f));
  static constexpr float kPots[][3] = {
      {.72f, .42f, .30f}, {.88f, .87f, .85f}, {.30f, .32f, .34f}, {.45f, .55f, .60f}};
  const auto& pot = dice_.pick(kPots);
  palette_.ceramic = material(Pattern::kPlain, colour(dice_, pot[0], pot[1], pot[2]));
  static constexpr float kBooks[][3] = {{.60f, .20f, .18f}, {.18f, .28f, .45f}, {.85f, .80f, .70f},
                                        {.22f, .38f, .28f}, {.75f, .55f, .20f}, {.28f, .24f, .28f},
                                        {.70f, .70f, .72f}};
  for (size_t i = 0; i < palette_.books.size(); ++i)
    palette_.books[i] =
        material(Pattern::kPlain, colour(dice_, kBooks[i][0], kBooks[i][1], kBooks[i][2], .12f));
  const Vector3f shade(1.f, .82f, .58f);
  palette_.lamp = material(Pattern::kPlain, shade, Vector3f::Zero(), .3f, dice_.real(.9f, 1.3f));
}

// --- shell
// ----------------------------------------------------------------------------------------

bool RoomBuilder::openingFits(const Opening& o, float margin) const {
  if (o.lo < margin || o.hi > wallLength(o.wall) - margin) return false;
  const float gap = o.has_curtains ? .8f : .5f;
  for (const Opening& other : openings_)
    if (other.wall == o.wall && o.lo < other.hi + gap && other.lo < o.hi + gap) return false;
  return true;
}

void RoomBuilder::chooseOpenings() {
  const int doors = dice_.chance(.3f) ? 2 : 1, windows = dice_.integer(1, 3);
  for (int tries = 0, made = 0; made < doors && tries < 50; ++tries) {
    Opening o{dice_.integer(0, 3), 0, 0, 0, 2.05f, .09f, false, false};
    const float width = dice_.real(.78f, .95f), length = wallLength(o.wall);
    o.lo = dice_.real(.18f, length - width - .18f), o.hi = o.lo + width;
    if (!openingFits(o, .15f)) continue;
    openings_.push_back(o), ++made;
  }
  const float top = std::min(size_.z() - dice_.real(.2f, .4f), 2.35f);
  const float sill = dice_.chance(.2f) ? .12f : dice_.real(.55f, 1.f);
  const bool curtains = dice_.chance(.5f);
  for (int tries = 0, made = 0; made < windows && tries < 60; ++tries) {
    Opening o{dice_.integer(0, 3), 0, 0, sill, top, dice_.real(.12f, .2f), true, curtains};
    const float length = wallLength(o.wall), width = std::min(dice_.real(.8f, 2.1f), length - 1.1f);
    o.lo = dice_.real(.5f, length - width - .5f), o.hi = o.lo + width;
    if (!openingFits(o, .5f)) continue;
    openings_.push_back(o), ++made;
  }
}

void RoomBuilder::buildShell() {
  // One lattice of lines through every opening's edges: neighbouring cells share whole edges with
  // identical coordinates, on walls, corners and reveals, so no ray slips out between triangles.
  std::array<std::vector<float>, 3> lines;
  for (int a = 0; a < 3; ++a) lines[size_t(a)] = {0.f, size_[a]};
  for (const Opening& o : openings_) {
    auto& along = lines[o.wall % 2 ? 1 : 0];
    along.push_back(o.lo), along.push_back(o.hi);
    lines[2].push_back(o.bottom), lines[2].push_back(o.top);
  }
  for (auto& l : lines) {
    std::sort(l.begin(), l.end());
    l.erase(std::unique(l.begin(), l.end()), l.end());
  }
  const auto cells = [&](int axis, float at, int a, Vector2f range_a, int b, Vector2f range_b,
                         int material, const auto& keep) {
    for (size_t i = 0; i + 1 < lines[size_t(a)].size(); ++i)
      for (size_t j = 0; j + 1 < lines[size_t(b)].size(); ++j) {
        const Vector2f u(lines[size_t(a)][i], lines[size_t(a)][i + 1]);
        const Vector2f v(lines[size_t(b)][j], lines[size_t(b)][j + 1]);
        if (u[0] < range_a[0] || u[1] > range_a[1] || v[0] < range_b[0] || v[1] > range_b[1])
          continue;
        if (!keep((u[0] + u[1]) / 2, (v[0] + v[1]) / 2)) continue;
        std::array<Vector3f, 4> p;
        for (size_t k = 0; k < 4; ++k) {
          p[k][axis] = at;
          p[k][a] = u[k == 1 || k == 2];
          p[k][b] = v[k >= 2];
        }
        quadInRoom(p, material, Vector3f::Unit(a), Vector3f::Unit(b));
      }
  };
  const auto all = [](float, float) { return true; };
  const Vector2f span[3] = {{0, size_.x()}, {0, size_.y()}, {0, size_.z()}};
  const int along_floor = size_.x() > size_.y() ? 0 : 1;
  cells(2, 0, along_floor, span[along_floor], 1 - along_floor, span[1 - along_floor],
        palette_.floor, all);
  cells(2, size_.z(), 0, span[0], 1, span[1], palette_.ceiling, all);
  const int accent = dice_.integer(0, 3);
  for (int wall = 0; wall < 4; ++wall) {
    const int axis = wall % 2 ? 0 : 1, a = 1 - axis;
    const float at = wall == 1 ? size_.x() : wall == 2 ? size_.y() : 0.f;
    cells(axis, at, a, span[a], 2, span[2], wall == accent ? palette_.accent_wall : palette_.wall,
          [&](float u, float z) {
            for (const Opening& o : openings_)
              if (o.wall == wall && u > o.lo && u < o.hi && z > o.bottom && z < o.top) return false;
            return true;
          });
  }
  const float daylight = dice_.real(4.f, 9.f);
  const Vector3f tint{dice_.real(.85f, 1.f), dice_.real(.93f, 1.f), dice_.real(.97f, 1.08f)};
  // Outside: sky with soft clouds, or trees. Not much brighter than white, so that edges of the
  // frames are as smooth as all others.
  const Vector3f behind =
      dice_.chance(.4f) ? Vector3f(.45f, .62f, .38f) : Vector3f(.62f, .74f, .88f);
  const float haze = dice_.real(.4f, 1.f);
  const Vector3f veiled = tint * haze + behind * (1 - haze);
  const int outside = material(Pattern::kNoise, tint, veiled, dice_.real(.4f, 1.2f), 1.35f);
  for (const Opening& o : openings_) {
    const int axis = o.wall % 2 ? 0 : 1, a = 1 - axis;
    const float at = o.wall == 1 ? size_.x() : o.wall == 2 ? size_.y() : 0.f;
    const float back = o.wall == 1 || o.wall == 2 ? at + o.recess : at - o.recess;
    cells(axis, back, a, {o.lo, o.hi}, 2, {o.bottom, o.top}, o.is_window ? outside : palette_.wood2,
          all);
    // Reveals: strips between the wall and the back, split at the same lines.
    const auto strip = [&](int line_axis, Vector2f range, int fixed_axis, float fixed) {
      const auto& l = lines[size_t(line_axis)];
      for (size_t i = 0; i + 1 < l.size(); ++i) {
        if (l[i] < range[0] || l[i + 1] > range[1]) continue;
        std::array<Vector3f, 4> p;
        for (size_t k = 0; k < 4; ++k) {
          p[k][fixed_axis] = fixed;
          p[k][line_axis] = l[i + (k == 1 || k == 2)];
          p[k][axis] = k >= 2 ? back : at;
        }
        quadInRoom(p, palette_.trim, Vector3f::Unit(line_axis), Vector3f::Unit(axis));
      }
    };
    for (float z : {o.bottom, o.top}) strip(a, {o.lo, o.hi}, 2, z);
    for (float u : {o.lo, o.hi}) strip(2, {o.bottom, o.top}, a, u);
    if (o.is_window) {
      RoomLight light;
      const Place place = wallPlace(o.wall);
      const Vector2f x = alongWall(o);
      // In the wall's plane: oblique rays are not cut by the reveal.
      light.centre = place.point({(x[0] + x[1]) / 2, 0, (o.bottom + o.top) / 2});
      light.half_u = place.direction({(x[1] - x[0]) / 2, 0, 0});
      // x cross z points to -y: turn half_v so that the light shines into the room.
      light.half_v = Vector3f(0, 0, -(o.top - o.bottom) / 2);
      light.bound_m = .02f;
      light.radiance = tint * daylight;
      room_.lights.push_back(light);
      buildWindow(o);
    } else {
      buildDoor(o);
    }
  }
}

void RoomBuilder::buildDoor(const Opening& o) {
  const Place at = wallPlace(o.wall);
  const Vector2f x = alongWall(o);
  const float w = .07f, t = .018f, depth = -o.recess;
  box(at, {x[0] - w, 0, 0}, {x[0], t, o.top + w}, palette_.trim);
  box(at, {x[1], 0, 0}, {x[1] + w, t, o.top + w}, palette_.trim);
  box(at, {x[0], 0, o.top}, {x[1], t, o.top + w}, palette_.trim);
  // Raised panels and a handle on the leaf.
  const int rows = dice_.integer(1, 3), columns = dice_.integer(1, 2);
  const float margin = .11f, width = x[1] - x[0] - 2 * margin, height = o.top - 2 * margin;
  for (int i = 0; i < columns; ++i)
    for (int j = 0; j < rows; ++j) {
      const float px = x[0] + margin + width * float(i) / float(columns);
      const float pz = margin + height * float(j) / float(rows);
      box(at, {px + .03f, depth, pz + .03f},
          {px + width / float(columns) - .03f, depth + .015f, pz + height / float(rows) - .03f},
          palette_.wood2);
    }
  const float hx = dice_.chance(.5f) ? x[0] + .06f : x[1] - .06f,
              to = hx < (x[0] + x[1]) / 2 ? 1 : -1;
  box(at, {hx - .02f, depth, .95f}, {hx + .02f, depth + .01f, 1.15f}, palette_.metal);
  box(at, {std::min(hx, hx + to * .12f), depth + .03f, 1.06f},
      {std::max(hx, hx + to * .12f), depth + .05f, 1.08f}, palette_.metal);
  box(at, {hx - .01f, depth, 1.06f}, {hx + .01f, depth + .05f, 1.08f}, palette_.metal);
  keep_clear_.push_back(at.rect({x[0] - .05f, 0}, {x[1] + .05f, .95f}));
  covered_.push_back({o.wall, x[0] - .1f, x[1] + .1f, o.top});
}

void RoomBuilder::buildWindow(const Opening& o) {
  const Place at = wallPlace(o.wall);
  const Vector2f x = alongWall(o);
  const float back = -o.recess, f = .055f, front = back + .05f;
  const int frame = palette_.trim;
  box(at, {x[0], back, o.bottom}, {x[0] + f, front, o.top}, frame);
  box(at, {x[1] - f, back, o.bottom}, {x[1], front, o.top}, frame);
  box(at, {x[0] + f, back, o.bottom}, {x[1] - f, front, o.bottom + f}, frame);
  box(at, {x[0] + f, back, o.top - f}, {x[1] - f, front, o.top}, frame);
  const int panes = std::max(1, int((x[1] - x[0]) / dice_.real(.5f, .8f)));
  for (int i = 1; i < panes; ++i) {
    const float m = x[0] + (x[1] - x[0]) * float(i) / float(panes);
    box(at, {m - .03f, back, o.bottom + f}, {m + .03f, front, o.top - f}, frame);
  }
  if (dice_.chance(.4f)) {
    const float z = o.top - (o.top - o.bottom) * .3f;
    box(at, {x[0] + f, back, z - .02f}, {x[1] - f, front - .01f, z + .02f}, frame);
  }
  float lo = x[0], hi = x[1], low_top = o.bottom - .05f;
  if (o.bottom > .3f) {
    box(at, {x[0] - .05f, back, o.bottom - .03f}, {x[1] + .05f, .07f, o.bottom}, palette_.trim);
    if (dice_.chance(.4f) && x[1] - x[0] > .7f) {  // radiator: ribs on two rails
      const float r0 = x[0] + .08f, r1 = x[1] - .08f, z1 = o.bottom - .12f;
      for (float r = r0; r + .04f <= r1; r += .06f)
        box(at, {r, .04f, .14f}, {r + .04f, .1f, z1}, palette_.white);
      box(at, {r0, .05f, .18f}, {r1, .09f, .22f}, palette_.white);
      box(at, {r0, .05f, z1 - .08f}, {r1, .09f, z1 - .04f}, palette_.white);
      solid(at, {r0, .03f, .1f}, {r1, .11f, z1});
      occupied_.push_back(at.rect({r0, 0}, {r1, .12f}));
      low_top = .1f;
    }
  }
  if (o.has_curtains) {
    const float wide = dice_.real(.2f, .38f), z0 = .03f,
                z1 = std::min(o.top + .12f, size_.z() - .04f);
    for (int side = 0; side < 2; ++side) {
      const float c0 = side ? x[1] - .06f : x[0] + .06f - wide, c1 = c0 + wide;
      const int folds = 2 * int(wide / .05f);
      for (int i = 0; i < folds; ++i) {
        const float a = c0 + wide * float(i) / float(folds),
                    b = c0 + wide * float(i + 1) / float(folds);
        const float ya = i % 2 ? .12f : .16f, yb = i % 2 ? .16f : .12f;
        quad(at,
             {Vector3f(a, ya, z0), Vector3f(b, yb, z0), Vector3f(b, yb, z1), Vector3f(a, ya, z1)},
             palette_.accent);
      }
      solid(at, {c0, .115f, z0}, {c1, .165f, z1});
      occupied_.push_back(at.rect({c0, 0}, {c1, .17f}));
      lo = std::min(lo, c0), hi = std::max(hi, c1);
    }
    box(at, {lo - .1f, .13f, z1}, {hi + .1f, .15f, z1 + .02f}, palette_.metal);
  }
  covered_.push_back({o.wall, lo - .05f, hi + .05f, 10.f});
  window_sills_.push_back({o.wall, lo, hi, low_top});
}

void RoomBuilder::buildSkirting() {
  const float h = dice_.real(.06f, .11f), t = .014f;
  for (int wall = 0; wall < 4; ++wall) {
    const Place at = wallPlace(wall);
    const float half = wallLength(wall) / 2;
    std::vector<Vector2f> gaps;
    for (const Opening& o : openings_)
      if (o.wall == wall && o.bottom < h) {
        const Vector2f x = alongWall(o);
        gaps.push_back({x[0] - (o.is_window ? 0 : .07f), x[1] + (o.is_window ? 0 : .07f)});
      }
    std::sort(gaps.begin(), gaps.end(),
              [](const Vector2f& a, const Vector2f& b) { return a[0] < b[0]; });
    float from = -half;
    for (const Vector2f& g : gaps) {
      if (g[0] > from) box(at, {from, 0, 0}, {g[0], t, h}, palette_.trim);
      from = g[1];
    }
    if (half > from) box(at, {from, 0, 0}, {half, t, h}, palette_.trim);
  }
}

// --- placement
// ------------------------------------------------------------------------------------

bool RoomBuilder::isFree(const Rect& footprint, const Rect& clearance) const {
  const float wall_gap = .015f;
  if (footprint.min.minCoeff() < wall_gap || footprint.max.x() > size_.x() - wall_gap ||
      footprint.max.y() > size_.y() - wall_gap)
    return false;
  const Rect wide = footprint.grown(.03f);
  for (const Rect& r : occupied_)
    if (r.overlaps(wide) || r.overlaps(clearance)) return false;
  for (const Rect& r : keep_clear_)
    if (r.overlaps(footprint)) return false;
  return true;
}

void RoomBuilder::occupy(const Place& at, float w, float d, float h, float front) {
  occupied_.push_back(at.rect({-w / 2, 0}, {w / 2, d}));
  if (front > 0) keep_clear_.push_back(at.rect({-w / 2, d}, {w / 2, d + front}));
  if (at.wall < 0) return;
  const Place wall = wallPlace(at.wall);
  const Vector2f o = at.origin - wall.origin;
  const float along = o.x() * wall.c + o.y() * wall.s;
  covered_.push_back({at.wall, along - w / 2, along + w / 2, h});
}

bool RoomBuilder::placeAtWall(float w, float d, float h, float front, Place* out) {
  for (int tries = 0; tries < 80; ++tries) {
    const int wall = dice_.integer(0, 3);
    const float half = wallLength(wall) / 2 - w / 2 - .02f;
    if (half < 0) continue;
    // Corners are used as much as the middle: people push furniture aside.
    float along = dice_.real(-half, half);
    if (dice_.chance(.35f)) along = along < 0 ? -half : half;
    const Place at = wallPlace(wall, along, .022f);
    bool blocked = false;
    for (const Covered& s : window_sills_)
      blocked |= s.wall == wall && h > s.top && along - w / 2 < s.hi && along + w / 2 > s.lo;
    if (blocked || !isFree(at.rect({-w / 2, 0}, {w / 2, d}),
                           at.rect({-w / 2, d}, {w / 2, d + std::max(front, .01f)})))
      continue;
    occupy(at, w, d, h, front);
    *out = at;
    return true;
  }
  return false;
}

bool RoomBuilder::placeFree(float w, float d, Place* out) {
  for (int tries = 0; tries < 60; ++tries) {
    const int turns = dice_.integer(0, 3);
    const float hw = (turns % 2 ? d : w) / 2, hd = (turns % 2 ? w : d) / 2;
    if (2 * hw > size_.x() - .1f || 2 * hd > size_.y() - .1f) continue;
    const Vector2f centre(dice_.real(hw + .04f, size_.x() - hw - .04f),
                          dice_.real(hd + .04f, size_.y() - hd - .04f));
    const Place middle = Place::quarter(centre, turns);
    const Place at = middle.at(0, -d / 2);
    const Rect footprint = at.rect({-w / 2, 0}, {w / 2, d});
    if (!isFree(footprint, footprint)) continue;
    occupy(at, w, d, 0, 0);
    *out = at;
    return true;
  }
  return false;
}

// --- furniture
// ------------------------------------------------------------------------------------

void RoomBuilder::books(const Place& at, float x0, float x1, float y0, float y1, float z,
                        float height) {
  const float start = x0;
  float tallest = 0;
  while (x0 + .05f < x1) {
    const float thick = dice_.real(.018f, .05f), h = height * dice_.real(.72f, 1.f);
    const float deep = dice_.real(.75f, .95f) * (y1 - y0);
    box(at, {x0, y0, z}, {x0 + thick, y0 + deep, z + h},
        palette_.books[size_t(dice_.integer(0, int(palette_.books.size()) - 1))]);
    tallest = std::max(tallest, h);
    x0 += thick + (dice_.chance(.1f) ? dice_.real(.02f, .1f) : .002f);
  }
  if (tallest > 0) solid(at, {start, y0, z}, {std::min(x0, x1), y1, z + tallest});
}

void RoomBuilder::clutter(const Place& at, const Vector2f& lo, const Vector2f& hi, float z) {
  // Side by side along x, so that nothing interpenetrates.
  const float middle = (lo.y() + hi.y()) / 2, deep = (hi.y() - lo.y()) / 2;
  for (float x = lo.x(); x + .32f < hi.x(); x += .34f) {
    const float cx = x + .16f;
    switch (dice_.integer(0, 6)) {
      case 0: {  // vase
        const float r = std::min(dice_.real(.04f, .08f), deep), h = dice_.real(.15f, .32f);
        solidTurned(at, cx, middle,
                    {{r * .7f, z},
                     {r, z + h * .35f},
                     {r * .8f, z + h * .7f},
                     {r * .4f, z + h * .9f},
                     {r * .5f, z + h}},
                    palette_.ceramic);
        break;
      }
      case 1: {  // bowl
        const float r = std::min(dice_.real(.08f, .14f), deep);
        solidTurned(at, cx, middle, {{r * .5f, z}, {r * .9f, z + .04f}, {r, z + .07f}},
                    dice_.chance(.5f) ? palette_.ceramic : palette_.wood2);
        break;
      }
      case 2: {  // a pile of books
        float top = z;
        const int count = dice_.integer(1, 4);
        for (int i = 0; i < count; ++i) {
          const float h = dice_.real(.02f, .04f), w = dice_.real(.09f, .12f);
          box(at, {cx - w, middle - .08f, top}, {cx + w, middle + .08f, top + h},
              palette_.books[size_t(dice_.integer(0, 6))]);
          top += h;
        }
        solid(at, {cx - .12f, middle - .08f, z}, {cx + .12f, middle + .08f, top});
        break;
      }
      case 3: {  // a box
        const float w = dice_.real(.06f, .13f), h = dice_.real(.06f, .2f);
        solidBox(at, {cx - w, middle - .08f, z}, {cx + w, middle + .08f, z + h},
                 dice_.chance(.5f) ? palette_.fabric2 : palette_.white);
        break;
      }
      default:
        break;
    }
  }
}

void RoomBuilder::bed() {
  const float w = dice_.chance(.5f) ? dice_.real(.9f, 1.1f) : dice_.real(1.4f, 1.8f);
  const float d = dice_.real(1.98f, 2.15f), head = dice_.real(.85f, 1.25f);
  Place at;
  const bool tables = dice_.chance(.8f);
  const float side = tables ? .5f : 0.f;
  if (!placeAtWall(w + 2 * side, d, head, .3f, &at) && !placeAtWall(w, d, head, .1f, &at)) return;
  const bool room_for_tables =
      tables && occupied_.back().max.x() - occupied_.back().min.x() +
                        (occupied_.back().max.y() - occupied_.back().min.y()) >
                    w + d + side;
  const float h = w / 2 - .03f;  // the covers hang over
  solidBox(at, {-h, 0, 0}, {h, .06f, head}, dice_.chance(.5f) ? palette_.wood : palette_.fabric);
  box(at, {-h, .06f, .1f}, {h, d, .28f}, palette_.wood);
  for (float x : {-h + .04f, h - .1f})
    for (float y : {.12f, d - .12f}) box(at, {x, y, 0}, {x + .06f, y + .06f, .1f}, palette_.wood);
  const float top = dice_.real(.46f, .56f), fold = dice_.real(.55f, .75f);
  roundedBox(at, {-h + .015f, .065f, .28f}, {h - .015f, d - .02f, top}, .06f, palette_.bedding);
  roundedBox(at, {-h - .02f, fold, top - .16f}, {h + .02f, d + .01f, top + .05f}, .06f,
             palette_.fabric2);
  if (dice_.chance(.5f))  // a throw at the foot
    roundedBox(at, {-h - .026f, d - .65f, top - .14f}, {h + .026f, d - .2f, top + .062f}, .06f,
               palette_.accent);
  solid(at, {-h - .026f, .06f, 0}, {h + .026f, d + .01f, top + .062f});
  const int pillows = w > 1.3f ? 2 : 1;
  const float pw = std::min(.66f, w / float(pillows) - .06f);
  for (int i = 0; i < pillows; ++i) {
    const float x = pillows == 1 ? 0 : (i ? 1 : -1) * w / 4;
    roundedBox(at, {x - pw / 2, .1f, top - .01f}, {x + pw / 2, .5f, top + .13f}, .065f,
               palette_.bedding);
    solid(at, {x - pw / 2, .1f, top + .062f}, {x + pw / 2, .5f, top + .13f});
  }
  if (room_for_tables)
    for (float s : {-1.f, 1.f}) nightstand(at.at(s * (h + .07f + .21f), 0), .4f, .36f);
}

void RoomBuilder::nightstand(const Place& at, float w, float d) {
  const float h = dice_.real(.42f, .58f);
  solidBox(at, {-w / 2, 0, .08f}, {w / 2, d, h}, palette_.wood);
  for (float x : {-w / 2 + .02f, w / 2 - .06f})
    for (float y : {.02f, d - .06f}) box(at, {x, y, 0}, {x + .04f, y + .04f, .08f}, palette_.wood);
  for (int i = 0; i < 2; ++i) {
    const float z0 = .1f + (h - .12f) * float(i) / 2;
    box(at, {-w / 2 + .015f, d, z0}, {w / 2 - .015f, d + .015f, z0 + (h - .12f) / 2 - .015f},
        palette_.wood);
    box(at, {-.04f, d + .015f, z0 + .06f}, {.04f, d + .03f, z0 + .075f}, palette_.metal);
  }
  if (dice_.chance(.7f)) tableLamp(at, 0, d / 2, h);
}

void RoomBuilder::tableLamp(const Place& at, float x, float y, float z) {
  const float h = dice_.real(.2f, .3f), r = dice_.real(.1f, .14f);
  turned(at, x, y,
         {{.06f, z}, {.06f, z + .015f}, {.02f, z + .03f}, {.035f, z + h * .5f}, {.012f, z + h}},
         dice_.chance(.5f) ? palette_.ceramic : palette_.metal, 10);
  turnedShell(at, x, y, {{r, z + h - .03f}, {r * .7f, z + h + .15f}}, palette_.lamp, 16);
  solid(at, {x - r, y - r, z}, {x + r, y + r, z + h + .15f});
  RoomLight light;
  light.centre = at.point({x, y, z + h + .06f});
  light.radius_m = .06f, light.bound_m = 1.3f * r + .02f;
  light.radiance = Vector3f(1.f, .78f, .52f) * lamps_on_ * 60.f;
  room_.lights.push_back(light);
}

void RoomBuilder::floorLamp() {
  Place at;
  if (!placeAtWall(.4f, .4f, 1.7f, .05f, &at)) return;
  const float h = dice_.real(1.4f, 1.65f), r = dice_.real(.15f, .2f), c = .2f;
  turned(at, 0, c, {{.14f, 0}, {.14f, .02f}, {.013f, .035f}, {.013f, h}}, palette_.metal, 10);
  turnedShell(at, 0, c, {{r, h - .12f}, {r * .75f, h + .16f}}, palette_.lamp, 18);
  solid(at, {-.014f, c - .014f, 0}, {.014f, c + .014f, h - .12f});
  solid(at, {-r, c - r, h - .12f}, {r, c + r, h + .16f});
  RoomLight light;
  light.centre = at.point({0, c, h + .02f});
  light.radius_m = .08f, light.bound_m = 1.2f * r + .03f;
  light.radiance = Vector3f(1.f, .8f, .55f) * lamps_on_ * 90.f;
  room_.lights.push_back(light);
}

void RoomBuilder::ceilingLamp() {
  const Place at = Place::quarter(
      {size_.x() / 2 + dice_.real(-.3f, .3f), size_.y() / 2 + dice_.real(-.3f, .3f)}, 0);
  const float top = size_.z();
  RoomLight light;
  if (dice_.chance(.5f)) {  // flat on the ceiling
    const float r = dice_.real(.17f, .28f), h = dice_.real(.07f, .12f);
    turned(at, 0, 0, {{r * .55f, top - h}, {r * .9f, top - h * .8f}, {r, top - h * .3f}, {r, top}},
           palette_.lamp, 20);
    solid(at, {-r, -r, top - h}, {r, r, top});
    light.centre = at.point({0, 0, top - h - .05f});
    light.radius_m = .15f, light.bound_m = r + .02f;
  } else {  // pendant
    const float drop = std::min(dice_.real(.35f, .7f), top - 1.95f), r = dice_.real(.15f, .26f);
    const float z = top - drop;
    turned(at, 0, 0, {{.008f, z + .15f}, {.008f, top - .03f}, {.05f, top - .02f}, {.05f, top}},
           palette_.dark, 8);
    turned(at, 0, 0,
           {{r * .5f, z - .06f},
            {r * .9f, z - .02f},
            {r, z + .05f},
            {r * .8f, z + .13f},
            {r * .3f, z + .17f}},
           palette_.lamp, 20);
    solid(at, {-r, -r, z - .06f}, {r, r, z + .17f});
    solid(at, {-.05f, -.05f, z + .17f}, {.05f, .05f, top});
    light.centre = at.point({0, 0, z});
    light.radius_m = .13f, light.bound_m = r * 1.1f + .03f;
  }
  light.radiance = Vector3f(1.f, .88f, .7f) * dice_.real(25.f, 50.f);
  room_.lights.push_back(light);
}

void RoomBuilder::wardrobe() {
  const float w = dice_.real(.9f, 2.f), d = dice_.real(.55f, .62f);
  const float h = std::min(dice_.real(1.85f, 2.3f), size_.z() - .08f);
  Place at;
  if (!placeAtWall(w, d, h, .6f, &at)) return;
  const int body = dice_.chance(.5f) ? palette_.wood : palette_.white;
  const int doors = std::max(2, int(w / dice_.real(.42f, .55f)));
  solidBox(at, {-w / 2, 0, 0}, {w / 2, d - .025f, h}, body);
  solid(at, {-w / 2, d - .025f, .08f}, {w / 2, d, h});
  const int front = dice_.chance(.6f) ? body : palette_.wood2;
  for (int i = 0; i < doors; ++i) {
    const float a = -w / 2 + w * float(i) / float(doors) + .004f;
    const float b = -w / 2 + w * float(i + 1) / float(doors) - .004f;
    box(at, {a, d - .025f, .08f}, {b, d - .005f, h - .02f}, front);
    const float x = i % 2 ? a + .04f : b - .04f;
    box(at, {x - .008f, d - .005f, .95f}, {x + .008f, d + .02f, 1.2f}, palette_.metal);
  }
}

void RoomBuilder::drawers() {
  const float w = dice_.real(.7f, 1.6f), d = dice_.real(.38f, .48f), h = dice_.real(.7f, 1.05f);
  Place at;
  if (!placeAtWall(w, d, h, .5f, &at)) return;
  const int rows = dice_.integer(2, 4), columns = w > 1.f ? 2 : 1;
  const float foot = dice_.chance(.5f) ? .12f : .03f;
  const int body = dice_.chance(.7f) ? palette_.wood : palette_.white;
  legs(at, {-w / 2 + .01f, .01f}, {w / 2 - .01f, d - .03f}, foot, .045f, body);
  solidBox(at, {-w / 2, 0, foot}, {w / 2, d - .02f, h}, body);
  for (int i = 0; i < rows; ++i)
    for (int j = 0; j < columns; ++j) {
      const float cw = w / float(columns), ch = (h - foot - .04f) / float(rows);
      const float x = -w / 2 + cw * float(j), z = foot + .015f + ch * float(i);
      box(at, {x + .012f, d - .02f, z}, {x + cw - .012f, d - .003f, z + ch - .014f}, body);
      box(at, {x + cw / 2 - .06f, d - .003f, z + ch * .6f},
          {x + cw / 2 + .06f, d + .018f, z + ch * .6f + .015f}, palette_.metal);
    }
  if (dice_.chance(.3f)) {
    tableLamp(at, -w / 2 + .18f, d / 2, h);
    clutter(at, {-w / 2 + .36f, .1f}, {w / 2, d - .1f}, h);
  } else {
    clutter(at, {-w / 2, .1f}, {w / 2, d - .1f}, h);
  }
}

void RoomBuilder::shelf() {
  const float w = dice_.real(.6f, 1.3f), d = dice_.real(.26f, .34f), t = .022f;
  const float h = std::min(dice_.real(.85f, 2.15f), size_.z() - .1f);
  Place at;
  if (!placeAtWall(w, d, h, .5f, &at)) return;
  const int board = dice_.chance(.6f) ? palette_.wood : palette_.white;
  for (float x : {-w / 2, w / 2 - t}) solidBox(at, {x, 0, 0}, {x + t, d, h}, board);
  solidBox(at, {-w / 2 + t, 0, 0}, {w / 2 - t, .01f, h}, board);
  const int rows = std::max(2, int(h / dice_.real(.3f, .4f)));
  for (int i = 0; i <= rows; ++i) {
    const float z = (h - t) * float(i) / float(rows) + (i == 0 ? .05f : 0);
    solidBox(at, {-w / 2 + t, .01f, z}, {w / 2 - t, d, z + t}, board);
    if (i == rows) break;
    const float space = (h - t) / float(rows) - t - (i == 0 ? .05f : 0);
    if (dice_.chance(.72f)) {
      const float x0 = -w / 2 + t + .01f, x1 = w / 2 - t - .01f;
      const float from = dice_.chance(.7f) ? x0 : dice_.real(x0, (x0 + x1) / 2);
      books(at, from, dice_.real((from + x1) / 2, x1), .02f, d - .02f, z + t,
            std::min(space - .03f, .28f));
    } else if (space > .34f) {
      clutter(at, {-w / 2 + t, .05f}, {w / 2 - t, d - .05f}, z + t);
    }
  }
}

void RoomBuilder::seat(const Place& at, float w, float d, int fabric, int cushions) {
  const float base = dice_.real(.1f, .18f), sit = dice_.real(.4f, .47f),
              arm = dice_.real(.13f, .22f);
  const float back = dice_.real(.75f, .9f), arm_top = dice_.real(.55f, .66f), thick = .2f;
  const float h = w / 2;
  for (float x : {-h + .03f, h - .08f})
    for (float y : {.03f, d - .09f}) box(at, {x, y, 0}, {x + .05f, y + .05f, base}, palette_.dark);
  roundedBox(at, {-h + arm - .02f, .03f, base}, {h - arm + .02f, d - .03f, sit - .14f}, .03f,
             fabric);
  roundedBox(at, {-h + .02f, 0, base}, {h - .02f, thick, back}, .05f, fabric);
  for (float x : {-h, h - arm}) roundedBox(at, {x, 0, base}, {x + arm, d, arm_top}, .05f, fabric);
  const float cw = (w - 2 * arm) / float(cushions);
  for (int i = 0; i < cushions; ++i) {
    const float x = -h + arm + cw * float(i);
    roundedBox(at, {x + .003f, thick - .01f, sit - .16f}, {x + cw - .003f, d + .005f, sit}, .05f,
               fabric);
    roundedBox(at, {x + .01f, thick - .02f, sit - .01f}, {x + cw - .01f, thick + .15f, back + .03f},
               .06f, fabric);
  }
  solid(at, {-h, 0, 0}, {h, thick + .15f, back + .03f});
  solid(at, {-h, thick + .15f, 0}, {h, d + .005f, sit});
  for (float x : {-h, h - arm}) solid(at, {x, thick + .15f, sit}, {x + arm, d, arm_top});
  for (int i = 0; i < cushions; ++i)
    if (dice_.chance(.45f)) {
      const float x = -h + arm + cw * (float(i) + .5f), s = std::min(.19f, cw / 2 - .01f);
      roundedBox(at, {x - s, thick + .155f, sit - .005f}, {x + s, thick + .27f, sit + 2 * s}, .055f,
                 palette_.accent);
      solid(at, {x - s, thick + .155f, sit}, {x + s, thick + .27f, sit + 2 * s});
    }
}

void RoomBuilder::sofaGroup() {
  const float w = dice_.real(1.6f, 2.4f), d = dice_.real(.85f, 1.f);
  Place at;
  if (!placeAtWall(w, d, .93f, .45f, &at) && !placeAtWall(1.5f, d, .93f, .45f, &at)) return;
  const Rect& r = occupied_.back();
  const float fitted = at.s == 0 ? r.max.x() - r.min.x() : r.max.y() - r.min.y();
  seat(at, fitted, d, palette_.fabric, fitted > 1.95f ? 3 : 2);
  const float tw = dice_.real(.8f, 1.15f), td = dice_.real(.5f, .65f), th = dice_.real(.36f, .46f);
  const Place front = at.at(0, d + dice_.real(.36f, .44f));
  // The table may stand in the sofa's own clearance.
  keep_clear_.pop_back();
  if (isFree(front.rect({-tw / 2, 0}, {tw / 2, td}), front.rect({-tw / 2, 0}, {tw / 2, td}))) {
    const bool has_rug = dice_.chance(.7f);
    if (has_rug) rug(at.rect({-fitted / 2 - .1f, d * .7f}, {fitted / 2 + .1f, d + 1.5f}));
    occupy(front, tw, td, th, 0);
    covered_.pop_back();
    legs(front, {-tw / 2 + .02f, .02f}, {tw / 2 - .02f, td - .02f}, th - .03f, .045f,
         palette_.wood2);
    solidBox(front, {-tw / 2, 0, th - .03f}, {tw / 2, td, th}, palette_.wood2);
    if (dice_.chance(.4f))
      solidBox(front, {-tw / 2 + .07f, .07f, .14f}, {tw / 2 - .07f, td - .07f, .16f},
               palette_.wood2);
    clutter(front, {-tw / 2, .1f}, {tw / 2, td - .1f}, th);
  } else {
    keep_clear_.push_back(at.rect({-fitted / 2, d}, {fitted / 2, d + .45f}));
  }
  if (dice_.chance(.5f)) armchair();
}

void RoomBuilder::armchair() {
  Place at;
  const float w = dice_.real(.72f, .9f), d = dice_.real(.75f, .88f);
  if (placeAtWall(w, d, .93f, .4f, &at)) seat(at, w, d, palette_.fabric2, 1);
}

void RoomBuilder::television() {
  const float w = dice_.real(1.2f, 1.8f), d = dice_.real(.36f, .45f), h = dice_.real(.38f, .55f);
  Place at;
  if (!placeAtWall(w, d, 1.25f, .5f, &at)) return;
  const int body = dice_.chance(.5f) ? palette_.wood : palette_.white;
  solidBox(at, {-w / 2, 0, .05f}, {w / 2, d - .02f, h}, body);
  box(at, {-w / 2 + .05f, .05f, 0}, {w / 2 - .05f, d - .08f, .05f}, palette_.dark);
  const int parts = dice_.integer(2, 3);
  for (int i = 0; i < parts; ++i) {
    const float a = -w / 2 + w * float(i) / float(parts), b = a + w / float(parts);
    box(at, {a + .01f, d - .02f, .07f}, {b - .01f, d - .004f, h - .03f}, body);
    box(at, {(a + b) / 2 - .05f, d - .004f, h - .1f}, {(a + b) / 2 + .05f, d + .012f, h - .085f},
        palette_.metal);
  }
  const float tv = std::min(w - .1f, dice_.real(.95f, 1.4f)), th = tv * .57f;
  solidBox(at, {-.15f, .1f, h}, {.15f, .28f, h + .015f}, palette_.dark);
  solidBox(at, {-.03f, .16f, h + .015f}, {.03f, .2f, h + .07f}, palette_.dark);
  solidBox(at, {-tv / 2, .16f, h + .07f}, {tv / 2, .2f, h + .07f + th}, palette_.dark);
  box(at, {-tv / 2 + .015f, .2f, h + .085f}, {tv / 2 - .015f, .202f, h + .055f + th},
      palette_.screen);
}

void RoomBuilder::chair(const Place& at, int wood, int seat_material) {
  // Faces its own -y: the back is at y = d, away from the table.
  const float w = .43f, d = .42f, sit = .45f, back = .88f, leg = .035f;
  legs(at, {-w / 2, 0}, {w / 2, d}, sit - .04f, leg, wood);
  solidBox(at, {-w / 2, 0, sit - .04f}, {w / 2, d, sit}, wood);
  roundedBox(at, {-w / 2 + .015f, .012f, sit - .01f}, {w / 2 - .015f, d - .04f, sit + .025f}, .017f,
             seat_material);
  solid(at, {-w / 2, 0, sit}, {w / 2, d - .04f, sit + .025f});
  for (float x : {-w / 2, w / 2 - leg}) box(at, {x, d - leg, sit}, {x + leg, d, back}, wood);
  solid(at, {-w / 2, d - leg, sit}, {w / 2, d, back});
  if (chair_style_ == 0) {
    for (float z : {.56f, .68f, .80f})
      box(at, {-w / 2 + leg, d - .028f, z}, {w / 2 - leg, d - .008f, z + .055f}, wood);
  } else if (chair_style_ == 1) {
    box(at, {-w / 2 + leg, d - .03f, sit + .1f}, {w / 2 - leg, d - .005f, back - .02f},
        seat_material);
  } else {
    box(at, {-w / 2 + leg, d - .03f, back - .07f}, {w / 2 - leg, d, back}, wood);
    for (float x = -w / 2 + .08f; x < w / 2 - .08f; x += .07f)
      box(at, {x, d - .025f, sit}, {x + .018f, d - .008f, back - .07f}, wood);
  }
}

void RoomBuilder::diningGroup() {
  const bool round = dice_.chance(.3f);
  const float w = round ? dice_.real(.9f, 1.25f) : dice_.real(1.1f, 2.f);
  const float d = round ? w : dice_.real(.78f, .95f), h = dice_.real(.72f, .77f);
  // The chairs' seats slide a little under the top; the group keeps a walkway around itself.
  const float tuck = .16f, around = .45f;
  Place at;
  if (!placeFree(w + 2 * around, d + 2 * around, &at)) return;
  const Place table = at.at(0, around);
  const int wood = palette_.wood;
  if (dice_.chance(.4f)) rug(at.rect({-w / 2 - around, 0}, {w / 2 + around, d + 2 * around}));
  if (round) {
    solidTurned(table, 0, d / 2, {{.25f, 0}, {.24f, .03f}, {.05f, .06f}, {.05f, h - .03f}}, wood,
                12);
    solidTurned(table, 0, d / 2, {{w / 2, h - .03f}, {w / 2, h}}, wood, 28);
  } else {
    legs(table, {-w / 2 + .02f, .02f}, {w / 2 - .02f, d - .02f}, h - .035f, .06f, wood);
    solidBox(table, {-w / 2, 0, h - .035f}, {w / 2, d, h}, wood);
    box(table, {-w / 2 + .08f, .04f, h - .1f}, {w / 2 - .08f, .06f, h - .035f}, wood);
    box(table, {-w / 2 + .08f, d - .06f, h - .1f}, {w / 2 - .08f, d - .04f, h - .035f}, wood);
  }
  clutter(table, {-w / 4, .25f}, {w / 4, d - .25f}, h);
  const int seat_material = dice_.chance(.5f) ? palette_.fabric2 : palette_.wood2;
  const int chair_wood = dice_.chance(.6f) ? wood : palette_.dark;
  const float in = round ? .05f : tuck;
  const int per_side = round ? 1 : std::max(1, int((w - .2f) / .56f));
  for (int i = 0; i < per_side; ++i) {
    const float x = (float(i) + .5f) / float(per_side) * (w - .2f) - (w - .2f) / 2;
    for (int side = 0; side < 2; ++side) {
      if (dice_.chance(.12f)) continue;
      const float pull = in - (dice_.chance(.25f) ? dice_.real(0, .1f) : 0.f);
      chair(table.at(side ? x : -x, side ? d - pull : pull, side ? 0 : 2), chair_wood,
            seat_material);
    }
  }
  // Chairs at the ends of a long table stand clear of those at its sides.
  for (int side = 0; side < 2; ++side)
    if ((round || w > 1.5f) && dice_.chance(.6f))
      chair(table.at(side ? w / 2 - (round ? .05f : .0f) : -w / 2 + (round ? .05f : .0f), d / 2,
                     side ? 3 : 1),
            chair_wood, seat_material);
}

void RoomBuilder::desk() {
  const float w = dice_.real(1.f, 1.6f), d = dice_.real(.55f, .72f), h = dice_.real(.72f, .76f);
  Place at;
  if (!placeAtWall(w, d, .78f, .7f, &at)) return;
  covered_.back().top = 1.3f;
  if (dice_.chance(.5f)) {
    legs(at, {-w / 2 + .01f, .01f}, {w / 2 - .01f, d - .01f}, h - .03f, .045f, palette_.metal);
  } else {
    const float side = dice_.chance(.5f) ? 1.f : -1.f, a = side > 0 ? w / 2 - .4f : -w / 2;
    solidBox(at, {a, 0, 0}, {a + .4f, d - .04f, h - .03f}, palette_.wood);
    for (int i = 0; i < 3; ++i)
      box(at, {a + .015f, d - .04f, .06f + .21f * float(i)},
          {a + .385f, d - .025f, .25f + .21f * float(i)}, palette_.wood);
    const float b = side > 0 ? -w / 2 : w / 2 - .03f;
    solidBox(at, {b, 0, 0}, {b + .03f, d - .02f, h - .03f}, palette_.wood);
  }
  solidBox(at, {-w / 2, 0, h - .03f}, {w / 2, d, h}, palette_.wood);
  const float m = dice_.real(-w / 6, w / 6), mw = dice_.real(.22f, .3f);
  solidBox(at, {m - .1f, .08f, h}, {m + .1f, .24f, h + .012f}, palette_.dark);
  solidBox(at, {m - .02f, .13f, h + .012f}, {m + .02f, .16f, h + .1f}, palette_.dark);
  solidBox(at, {m - mw, .13f, h + .1f}, {m + mw, .165f, h + .1f + mw * 1.15f}, palette_.dark);
  box(at, {m - mw + .01f, .165f, h + .11f}, {m + mw - .01f, .167f, h + .09f + mw * 1.15f},
      palette_.screen);
  solidBox(at, {m - .2f, .32f, h}, {m + .2f, .44f, h + .02f}, palette_.white);
  if (w > 1.2f && m < w / 2 - .62f && dice_.chance(.6f)) tableLamp(at, w / 2 - .16f, .2f, h);
  // A chair pulled out and turned at random, as people leave them: one box, clear of the desk.
  const Place spot = at.at(dice_.real(-.12f, .12f), d + .36f);
  const float yaw = dice_.real(-.5f, .5f), c = std::cos(yaw), s = std::sin(yaw);
  Place turned_chair = spot;
  turned_chair.c = spot.c * c - spot.s * s, turned_chair.s = spot.s * c + spot.c * s;
  turned_chair = turned_chair.at(0, -.21f);
  const Rect r = turned_chair.rect({-.24f, 0}, {.24f, .44f});
  const Rect clearance = keep_clear_.back();
  keep_clear_.pop_back();
  if (isFree(r, r)) {
    const size_t first = room_.solids.size();
    chair(turned_chair, palette_.dark, palette_.fabric2);
    room_.solids.resize(first);
    solid(turned_chair, {-.22f, 0, 0}, {.22f, .42f, .88f});
    occupied_.push_back(r);
  }
  keep_clear_.push_back(clearance);
}

void RoomBuilder::plant() {
  const float r = dice_.real(.11f, .19f), pot = dice_.real(.2f, .38f);
  const float height = dice_.real(.5f, 1.1f), spread = dice_.real(.25f, .42f);
  Place at;
  if (!placeAtWall(2 * spread, 2 * spread, pot + height, 0.f, &at)) return;
  const float c = spread;
  turned(at, 0, c, {{r * .7f, 0}, {r, pot}, {r * .9f, pot}, {r * .88f, pot - .03f}},
         palette_.ceramic);
  solid(at, {-r, c - r, 0}, {r, c + r, pot});
  turned(at, 0, c, {{.012f, pot - .03f}, {.008f, pot + height * .6f}}, palette_.soil, 6);
  turned(at, 0, c, {{r * .88f, pot - .031f}, {.001f, pot - .03f}}, palette_.soil, 12);
  solid(at, {-spread, c - spread, pot}, {spread, c + spread, pot + height});
  const int leaves = dice_.integer(16, 34);
  for (int i = 0; i < leaves; ++i) {
    // A stalk leaves the stem, bends outward and ends in a pointed blade of two folded halves.
    const float yaw = 2.4f * float(i) + dice_.real(-.3f, .3f),
                reach = spread * dice_.real(.5f, .95f);
    const float z0 = pot + height * .55f * float(i) / float(leaves);
    const float z1 = std::min(pot + height * .97f, z0 + height * dice_.real(.25f, .5f));
    const Vector3f out(std::cos(yaw), std::sin(yaw), 0), side(-out.y(), out.x(), 0);
    const Vector3f base(0, c, z0), mid = base + out * reach * .45f + Vector3f(0, 0, z1 - z0);
    const Vector3f tip = base + out * reach + Vector3f(0, 0, (z1 - z0) * dice_.real(.45f, .95f));
    const float half = reach * dice_.real(.12f, .22f);
    const Vector3f left = mid + side * half - Vector3f(0, 0, .02f);
    const Vector3f right = mid - side * half - Vector3f(0, 0, .02f);
    quad(at, {base, left, tip, mid}, palette_.leaf);
    quad(at, {base, mid, tip, right}, palette_.leaf);
  }
}

void RoomBuilder::rug(const Rect& r) {
  const Vector2f lo = r.min.cwiseMax(Vector2f(.06f, .06f));
  const Vector2f hi = r.max.cwiseMin(Vector2f(size_.x() - .06f, size_.y() - .06f));
  if ((hi - lo).minCoeff() < .6f || has_rug_) return;
  has_rug_ = true;
  const float height = dice_.real(.008f, .015f), edge = dice_.chance(.5f) ? .07f : 0.f;
  const Place at;
  const int weave = fabricMaterial(false), border = fabricMaterial(true);
  box(at, {lo.x(), lo.y(), .001f}, {hi.x(), hi.y(), height}, edge > 0 ? border : weave);
  if (edge > 0)
    box(at, {lo.x() + edge, lo.y() + edge, .001f}, {hi.x() - edge, hi.y() - edge, height + .001f},
        weave);
}

void RoomBuilder::pictures() {
  const int count = dice_.integer(2, 5);
  for (int tries = 0, made = 0; tries < 40 && made < count; ++tries) {
    const int wall = dice_.integer(0, 3);
    const float w = dice_.real(.3f, 1.f), h = w * dice_.real(.6f, 1.35f),
                z = dice_.real(1.45f, 1.65f);
    const float half = wallLength(wall) / 2 - w / 2 - .15f, low = z - h / 2;
    if (half < 0 || z + h / 2 > size_.z() - .12f) continue;
    const float along = dice_.real(-half, half);
    bool blocked = false;
    for (const Covered& c : covered_)
      blocked |= c.wall == wall && c.top > low - .08f && along - w / 2 - .08f < c.hi &&
                 along + w / 2 + .08f > c.lo;
    if (blocked) continue;
    const Place at = wallPlace(wall, along);
    const int frames[] = {palette_.dark, palette_.white, palette_.wood, palette_.metal};
    const float edge = dice_.real(.015f, .045f),
                mat = dice_.chance(.5f) ? dice_.real(.03f, .08f) : 0;
    const int frame = dice_.pick(frames);
    const Vector2f a(-w / 2, low), b(w / 2, low + h);
    box(at, {a.x(), 0, a.y()}, {a.x() + edge, .025f, b.y()}, frame);
    box(at, {b.x() - edge, 0, a.y()}, {b.x(), .025f, b.y()}, frame);
    box(at, {a.x() + edge, 0, a.y()}, {b.x() - edge, .025f, a.y() + edge}, frame);
    box(at, {a.x() + edge, 0, b.y() - edge}, {b.x() - edge, .025f, b.y()}, frame);
    const float e = edge + mat;
    if (mat > 0)
      box(at, {a.x() + edge, 0, a.y() + edge}, {b.x() - edge, .012f, b.y() - edge}, palette_.white);
    // A painting: land and sky, a few blobs of paint, or stripes.
    const float p_rgb[] = {dice_.real(.2f, .85f), dice_.real(.2f, .75f), dice_.real(.2f, .7f)};
    const Vector3f p = colour(dice_, p_rgb[0], p_rgb[1], p_rgb[2]);
    const float q_rgb[] = {dice_.real(.1f, .9f), dice_.real(.1f, .85f), dice_.real(.15f, .8f)};
    const Vector3f q = colour(dice_, q_rgb[0], q_rgb[1], q_rgb[2]);
    static constexpr Pattern kPaint[] = {Pattern::kNoise, Pattern::kNoise, Pattern::kChecks,
                                         Pattern::kStripes};
    const int canvas = material(dice_.pick(kPaint), p, q, w * dice_.real(.15f, .5f));
    const float horizon = dice_.real(.3f, .7f);
    const float split = a.y() + e + (h - 2 * e) * horizon;
    box(at, {a.x() + e, 0, a.y() + e}, {b.x() - e, .014f, split}, canvas);
    const int sky =
        dice_.chance(.5f) ? canvas : material(Pattern::kNoise, (p + q) / 2, p * .5f, w * .6f);
    box(at, {a.x() + e, 0, split}, {b.x() - e, .014f, b.y() - e}, sky);
    covered_.push_back({wall, along - w / 2 - .05f, along + w / 2 + .05f, 10.f});
    ++made;
  }
}

// --- the room
// -------------------------------------------------------------------------------------

Room RoomBuilder::build() {
  size_ = {dice_.real(3.f, 6.5f), dice_.real(3.f, 6.5f), dice_.real(2.4f, 3.f)};
  room_.inside = Eigen::AlignedBox3f(Vector3f::Zero(), size_);
  lamps_on_ = dice_.chance(.7f) ? dice_.real(.4f, 1.f) : 0.f;
  chair_style_ = dice_.integer(0, 2);
  choosePalette();
  chooseOpenings();
  buildShell();
  buildSkirting();
  ceilingLamp();

  // Large pieces first; small ones fill what is left.
  enum Kind { kBedroom, kLiving, kDining, kStudy };
  static constexpr Kind kKinds[] = {kBedroom, kBedroom, kLiving, kLiving, kDining, kStudy};
  const Kind kind = dice_.pick(kKinds);
  if (kind == kBedroom) {
    bed();
    wardrobe();
    if (dice_.chance(.6f)) drawers();
    if (dice_.chance(.35f)) desk();
    if (dice_.chance(.4f)) shelf();
  } else if (kind == kLiving) {
    sofaGroup();
    if (dice_.chance(.8f)) television();
    shelf();
    if (size_.x() * size_.y() > 20 && dice_.chance(.7f)) diningGroup();
    if (dice_.chance(.5f)) drawers();
  } else if (kind == kDining) {
    diningGroup();
    drawers();
    if (dice_.chance(.6f)) shelf();
    if (dice_.chance(.4f)) sofaGroup();
  } else {
    desk();
    shelf();
    shelf();
    if (dice_.chance(.6f)) sofaGroup();
    if (dice_.chance(.5f)) drawers();
    if (dice_.chance(.3f)) wardrobe();
  }
  const float area = size_.x() * size_.y();
  if (area > 14 && dice_.chance(.5f)) armchair();
  if (area > 20 && dice_.chance(.6f)) shelf();
  if (area > 20 && dice_.chance(.5f)) drawers();
  if (area > 26 && dice_.chance(.6f)) kind == kDining ? sofaGroup() : diningGroup();
  if (dice_.chance(.6f)) floorLamp();
  for (int i = dice_.integer(0, 3); i > 0; --i) plant();
  if (!has_rug_ && dice_.chance(.5f)) {
    const Vector2f half{dice_.real(.6f, 1.2f), dice_.real(.5f, 1.f)};
    const Vector2f centre =
        size_.head<2>() / 2 + Vector2f{dice_.real(-.4f, .4f), dice_.real(-.4f, .4f)};
    rug({centre - half, centre + half});
  }
  pictures();

  const float yaw = dice_.real(0, 2 * float(M_PI));
  const Vector3f place{dice_.real(-4.f, 4.f), dice_.real(-4.f, 4.f), 0.f};
  room_.world_from_room = Eigen::Translation3f(place) * Eigen::AngleAxisf(yaw, Vector3f::UnitZ());
  const Eigen::Matrix3f turn = room_.world_from_room.linear();
  for (Vector3f& p : room_.mesh.vertices) p = room_.world_from_room * p;
  for (Vector3f& t : room_.tangent_u) t = turn * t;
  for (Vector3f& t : room_.tangent_v) t = turn * t;
  for (RoomLight& light : room_.lights) {
    light.centre = room_.world_from_room * light.centre;
    light.half_u = turn * light.half_u, light.half_v = turn * light.half_v;
  }
  return std::move(room_);
}

}  // namespace

Room makeRoom(uint64_t seed) { return RoomBuilder(seed).build(); }

}  // namespace vdbc
