#include "examples/rooms/shell.h"

#include <algorithm>
#include <cmath>

#include "examples/rooms/floor_plan.h"
#include "splat/image.h"
#include "vdb/error.h"

namespace vdbc {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

Vector3f paint(Dice& dice, const Vector3f& srgb, float variation) {
  const float tone = dice.real(-variation, variation);
  Vector3f c = srgb;
  for (float& v : c)
    v = linearFromSrgb(
        std::clamp(v + tone + dice.real(-.3f * variation, .3f * variation), .02f, .93f));
  return c;
}

// --- places and blocks
// ------------------------------------------------------------------------------

Place Place::turned(float radians) const {
  const float tc = std::cos(radians), ts = std::sin(radians);
  return {origin, c * tc - s * ts, s * tc + c * ts};
}

Eigen::Affine3f Place::affine(float z) const {
  Eigen::Affine3f a = Eigen::Affine3f::Identity();
  a.linear() << c, -s, 0, s, c, 0, 0, 0, 1;
  a.translation() << origin.x(), origin.y(), z;
  return a;
}

std::array<Vector2f, 4> Block::corners() const {
  return {at.point(-half.x(), -half.y()), at.point(half.x(), -half.y()),
          at.point(half.x(), half.y()), at.point(-half.x(), half.y())};
}

Eigen::AlignedBox3f Block::bounds() const {
  Eigen::AlignedBox3f box;
  for (const Vector2f& p : corners()) {
    box.extend(Vector3f(p.x(), p.y(), bottom));
    box.extend(Vector3f(p.x(), p.y(), top));
  }
  return box;
}

float Block::distance(const Vector2f& p) const {
  return (at.local(p).cwiseAbs() - half).cwiseMax(0.f).norm();
}

bool overlap(const Block& a, const Block& b, float slack) {
  if (a.top - b.bottom <= slack || b.top - a.bottom <= slack) return false;
  const Vector2f d = b.at.origin - a.at.origin;
  for (const Vector2f& axis : {a.at.right(), a.at.front(), b.at.right(), b.at.front()}) {
    const auto reach = [&](const Block& o) {
      return o.half.x() * std::abs(axis.dot(o.at.right())) +
             o.half.y() * std::abs(axis.dot(o.at.front()));
    };
    if (reach(a) + reach(b) - std::abs(axis.dot(d)) <= slack) return false;
  }
  return true;
}

// --- shapes
// -----------------------------------------------------------------------------------------

Finish Shaper::add(const Material& material, const Vector2f& repeat_m) {
  surface_.materials.push_back(material);
  return {int(surface_.materials.size()) - 1, repeat_m};
}

Finish Shaper::plain(const Vector3f& colour, float specular, float roughness) {
  return pattern(Pattern::kPlain, colour, colour, .3f, specular, roughness);
}

Finish Shaper::pattern(Pattern pattern, const Vector3f& a, const Vector3f& b, float period_m,
                       float specular, float roughness) {
  Material m;
  m.pattern = pattern, m.colour_a = a, m.colour_b = b, m.period_m = period_m;
  m.specular = specular, m.roughness = roughness;
  return add(m);
}

void Shaper::triangle(const Vector3f (&p)[3], const Vector2f (&uv)[3], const Vector3f (&normal)[3],
                      int material) {
  if ((p[1] - p[0]).cross(p[2] - p[0]).norm() < 1e-8f) return;
  const int first = int(surface_.mesh.vertices.size());
  surface_.mesh.vertices.insert(surface_.mesh.vertices.end(), p, p + 3);
  surface_.mesh.triangles.emplace_back(first, first + 1, first + 2);
  surface_.material.push_back(material);
  surface_.uv.push_back({uv[0], uv[1], uv[2]});
  surface_.normal.push_back({normal[0], normal[1], normal[2]});
}

void Shaper::quad(const std::array<Vector3f, 4>& p, const Finish& finish) {
  const Vector3f u = (p[1] - p[0]).normalized();
  const Vector3f v = u.cross(p[3] - p[0]).cross(u).normalized();
  Vector2f uv[4];
  for (size_t i = 0; i < 4; ++i)
    uv[i] = Vector2f(u.dot(p[i]), v.dot(p[i])).cwiseQuotient(finish.repeat_m);
  const Vector3f flat[3] = {Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()};
  triangle({p[0], p[1], p[2]}, {uv[0], uv[1], uv[2]}, flat, finish.material);
  triangle({p[0], p[2], p[3]}, {uv[0], uv[2], uv[3]}, flat, finish.material);
}

void Shaper::box(const Place& at, const Vector3f& lo, const Vector3f& hi, const Finish& finish) {
  const Vector3f size = hi - lo;
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      const int a = (axis + 1) % 3, b = (axis + 2) % 3;
      std::array<Vector3f, 4> p = {lo, lo, lo, lo};
      for (Vector3f& q : p) q[axis] = side ? hi[axis] : lo[axis];
      p[1][a] = p[2][a] = hi[a];
      p[2][b] = p[3][b] = hi[b];
      if (!side) std::swap(p[1], p[3]);
      // Texture runs along p0 - p1: turn so that this is the longer side.
      if ((size[a] < size[b]) != (side == 0)) std::rotate(p.begin(), p.begin() + 1, p.end());
      for (Vector3f& q : p) q = at.point(q);
      quad(p, finish);
    }
}

void Shaper::turned(const Place& at, const std::vector<Vector2f>& profile, const Finish& finish,
                    int sides) {
  const auto ring = [&](const Vector2f& p, int k) {
    const float angle = 2 * float(M_PI) * float(k % sides) / float(sides);
    return at.point(Vector3f(p.x() * std::cos(angle), p.x() * std::sin(angle), p.y()));
  };
  for (size_t i = 0; i + 1 < profile.size(); ++i) {
    const Vector2f slope = profile[i + 1] - profile[i];
    for (int k = 0; k < sides; ++k) {
      const Vector3f p[4] = {ring(profile[i], k), ring(profile[i], k + 1),
                             ring(profile[i + 1], k + 1), ring(profile[i + 1], k)};
      Vector3f n[2];
      for (int e = 0; e < 2; ++e) {
        const float angle = 2 * float(M_PI) * float((k + e) % sides) / float(sides);
        n[e] = at.direction({slope.y() * std::cos(angle), slope.y() * std::sin(angle), -slope.x()})
                   .normalized();
      }
      const Vector2f zero = Vector2f::Zero();
      triangle({p[0], p[1], p[2]}, {zero, zero, zero}, {n[0], n[1], n[1]}, finish.material);
      triangle({p[0], p[2], p[3]}, {zero, zero, zero}, {n[0], n[1], n[0]}, finish.material);
    }
  }
  for (int end = 0; end < 2; ++end) {
    const Vector2f& p = end ? profile.back() : profile.front();
    const Vector3f middle = at.point(Vector3f(0, 0, p.y()));
    for (int k = 0; p.x() > 0 && k < sides; ++k) {
      const Vector3f a = ring(p, k), b = ring(p, k + 1), n = Vector3f::Zero();
      const Vector2f zero = Vector2f::Zero();
      triangle({middle, end ? a : b, end ? b : a}, {zero, zero, zero}, {n, n, n}, finish.material);
    }
  }
}

void Shaper::curtain(const Place& at, float lo, float hi, float bottom, float top, float depth,
                     const Finish& finish) {
  constexpr float kFold = .1f;
  constexpr int kSteps = 8;
  const int folds = std::max(1, int((hi - lo) / kFold)), steps = folds * kSteps;
  const auto point = [&](int i, float z) {
    const float phase = 2 * float(M_PI) * float(i) / kSteps;
    return at.point(Vector3f(lo + (hi - lo) * float(i) / float(steps), depth * std::sin(phase), z));
  };
  const auto normal = [&](int i) {
    const float phase = 2 * float(M_PI) * float(i) / kSteps;
    const float rise = depth * std::cos(phase) * 2 * float(M_PI) * float(folds) / (hi - lo);
    return at.direction(Vector3f(-rise, 1, 0).normalized());
  };
  for (int i = 0; i < steps; ++i) {
    const Vector3f p[4] = {point(i + 1, bottom), point(i, bottom), point(i, top),
                           point(i + 1, top)};
    const Vector3f n0 = normal(i), n1 = normal(i + 1);
    // Along the cloth, so that its pattern is not stretched by the folds.
    const float u0 = float(i) * kFold / kSteps * 1.3f, u1 = float(i + 1) * kFold / kSteps * 1.3f;
    const Vector2f uv[4] = {{u1, bottom}, {u0, bottom}, {u0, top}, {u1, top}};
    triangle({p[0], p[1], p[2]}, {uv[0], uv[1], uv[2]}, {n1, n0, n0}, finish.material);
    triangle({p[0], p[2], p[3]}, {uv[0], uv[2], uv[3]}, {n1, n0, n1}, finish.material);
  }
}

// --- shell
// ------------------------------------------------------------------------------------------

float Shell::ceilingAt(const Vector2f& p) const { return vdbc::ceilingAt(ceilings, p); }

bool Shell::contains(const Vector2f& p) const { return isInside(outline, p); }

namespace {

constexpr float kTrim = .07f;  // width of door frames

struct Style {
  Finish wall, accent, floor, ceiling, trim, leaf, metal, tiles;
  int accent_wall = -1;
  float tile_height = 0;  // walls below it have `tiles`; 0: none
};

class ShellBuilder {
 public:
  ShellBuilder(const AssetLibrary& assets, const ShellPlan& plan, Dice& dice, Room* room)
      : assets_(assets), plan_(plan), dice_(dice), room_(*room), shape_(&room->surface) {
    shell_.is_evening = plan.is_evening;
  }

  Shell build() {
    outline();
    chooseOpenings();
    chooseStyle();
    lattice();
    floorAndCeiling();
    for (size_t i = 0; i < shell_.walls.size(); ++i) wall(i);
    outside();
    for (const Wall& w : shell_.walls)
      for (const Opening& o : w.openings) {
        reveal(w, o);
        o.is_window ? window(w, o) : door(w, o);
      }
    skirting();
    sun();
    room_.floor = shell_.outline;
    room_.ceilings = shell_.ceilings;
    return std::move(shell_);
  }

 private:
  void outline();
  bool fits(const Wall& wall, const Opening& o, float margin) const;
  void chooseOpenings();
  Finish jarTexture(const std::vector<std::string>& names, float specular);
  Finish floorFinish();
  void chooseStyle();
  void lattice();
  void floorAndCeiling();
  template <typename FinishAt>
  void cells(const Wall& wall, float off, float lo, float hi, float bottom, float top,
             const FinishAt& finish);
  void wall(size_t index);
  void outside();
  void reveal(const Wall& wall, const Opening& o);
  void door(const Wall& wall, const Opening& o);
  void window(const Wall& wall, const Opening& o);
  void curtains(const Wall& wall, const Opening& o);
  void skirting();
  void sun();

  const AssetLibrary& assets_;
  const ShellPlan& plan_;
  Dice& dice_;
  Room& room_;
  Shaper shape_;
  Shell shell_;
  Style style_;
  std::array<std::vector<float>, 3> lines_;  // of the lattice, by axis; z without the ceiling
  int pane_ = 0;                             // material
  Vector3f daylight_ = Vector3f::Zero();
};

void ShellBuilder::outline() {
  const float w = plan_.width, d = plan_.depth;
  shell_.outline = {{0, 0}, {w, 0}, {w, d}, {0, d}};
  if (!plan_.cut.isZero()) {
    const size_t corner = size_t(dice_.integer(0, 3));
    const Vector2f c = shell_.outline[corner];
    const Vector2f inner(c.x() > 0 ? w - plan_.cut.x() : plan_.cut.x(),
                         c.y() > 0 ? d - plan_.cut.y() : plan_.cut.y());
    // The edge before corners 0 and 2 runs along y, that before 1 and 3 along x.
    const Vector2f along_y(c.x(), inner.y()), along_x(inner.x(), c.y());
    const bool y_first = corner % 2 == 0;
    shell_.outline[corner] = y_first ? along_y : along_x;
    const auto after = shell_.outline.begin() + long(corner) + 1;
    shell_.outline.insert(after, {inner, y_first ? along_x : along_y});
  }
  const size_t n = shell_.outline.size();
  for (size_t i = 0; i < n; ++i) {
    const Vector2f from = shell_.outline[i], to = shell_.outline[(i + 1) % n], d2 = to - from;
    const Vector2f along = std::abs(d2.x()) > std::abs(d2.y())
                               ? Vector2f(d2.x() > 0 ? 1.f : -1.f, 0)
                               : Vector2f(0, d2.y() > 0 ? 1.f : -1.f);
    shell_.walls.push_back({from, to, along, d2.cwiseAbs().maxCoeff(), {}});
  }
  shell_.height = plan_.height;
  shell_.ceilings = {{0, 0, plan_.height}};
  if (plan_.slope > 0) {
    const float s = plan_.slope, k = plan_.knee;
    const Vector3f planes[] = {{s, 0, k}, {-s, 0, k + s * w}, {0, s, k}, {0, -s, k + s * d}};
    shell_.ceilings.push_back(dice_.pick(planes));
  }
}

bool ShellBuilder::fits(const Wall& wall, const Opening& o, float margin) const {
  if (o.lo < margin || o.hi > wall.length - margin) return false;
  for (float s : {o.lo - kTrim, o.hi + kTrim})
    if (shell_.ceilingAt(wall.from + s * wall.along) < o.top + .1f) return false;
  const float gap = o.has_curtains ? .8f : .3f;
  return std::none_of(wall.openings.begin(), wall.openings.end(), [&](const Opening& other) {
    return o.lo < other.hi + gap && other.lo < o.hi + gap;
  });
}

void ShellBuilder::chooseOpenings() {
  const bool bathroom = plan_.kind == "bathroom", kitchen = plan_.kind == "kitchen";
  const float area = plan_.width * plan_.depth;
  const auto choose = [&](int count, float margin, const auto& make) {
    int made = 0;
    for (int tries = 0; made < count && tries < 80; ++tries) {
      Wall& wall = shell_.walls[size_t(dice_.integer(0, int(shell_.walls.size()) - 1))];
      Opening o = make();
      const float width = std::min(o.hi, wall.length - 2 * margin);
      if (width < .6f) continue;
      o.lo = dice_.real(margin, wall.length - margin - width), o.hi = o.lo + width;
      if (o.is_window) {
        for (float s : {o.lo, o.hi})
          o.top = std::min(o.top, shell_.ceilingAt(wall.from + s * wall.along) - .15f);
        if (o.top < o.bottom + .6f) continue;
      } else if (width < .74f) {
        continue;
      }
      if (!fits(wall, o, margin - 1e-4f)) continue;
      wall.openings.push_back(o), ++made;
    }
    return made;
  };
  const int doors = !bathroom && area > 12 && dice_.chance(.3f) ? 2 : 1;
  const float door_width = bathroom ? .78f : dice_.real(.8f, .95f);
  const int made =
      choose(doors, .12f, [&] { return Opening{0, door_width, 0, 2.05f, .09f, false, false}; });
  require(made > 0, room_.name, ": expected a wall for a door, found none");
  const float top = std::min(plan_.height - dice_.real(.2f, .4f), 2.35f);
  const float sill = bathroom            ? dice_.real(1.1f, 1.4f)
                     : kitchen           ? dice_.real(1.05f, 1.15f)
                     : dice_.chance(.2f) ? .1f
                                         : dice_.real(.6f, .95f);
  const bool curtains = !bathroom && !kitchen && dice_.chance(.5f);
  const int windows = bathroom ? dice_.integer(0, 1) : dice_.integer(1, area > 16 ? 3 : 2);
  choose(windows, curtains ? .5f : .35f, [&] {
    const float width = bathroom ? dice_.real(.6f, .9f) : dice_.real(.9f, 2.2f);
    return Opening{0, width, sill, top, dice_.real(.12f, .22f), true, curtains};
  });
}

Finish ShellBuilder::jarTexture(const std::vector<std::string>& names, float specular) {
  std::vector<size_t> found;
  for (size_t i = 0; i < assets_.textures().size(); ++i)
    if (std::find(names.begin(), names.end(), assets_.textures()[i].name) != names.end())
      found.push_back(i);
  require(!found.empty(), room_.name, ": expected a texture named ", names.front(), ", found none");
  const size_t index = dice_.pick(found);
  Material m;
  m.texture = assets_.texture(index);
  m.colour_a = Vector3f::Ones();
  m.specular = specular, m.roughness = .35f;
  return shape_.add(m, assets_.textures()[index].size_m);
}

Finish ShellBuilder::floorFinish() {
  static const Vector3f kWoods[] = {{.68f, .52f, .36f}, {.56f, .40f, .27f}, {.76f, .64f, .49f},
                                    {.45f, .31f, .22f}, {.63f, .58f, .51f}, {.72f, .50f, .30f}};
  static const Vector3f kCarpets[] = {{.62f, .59f, .55f},
                                      {.46f, .48f, .52f},
                                      {.70f, .64f, .56f},
                                      {.38f, .40f, .40f},
                                      {.55f, .46f, .42f}};
  const bool wet = plan_.kind == "bathroom" || plan_.kind == "kitchen";
  const float kind = dice_.real(0, 1);
  if (wet ? kind < .4f : kind < .12f)
    return jarTexture({"Grey tiles", "Red tiles", "Stone tiles", "Black and white tiles",
                       "Beige tiles", "Light blue tiles", "Dark blue tiles"},
                      .04f);
  if (wet ? kind < .8f : kind < .22f) {
    const Vector3f a = paint(dice_, {.75f, .72f, .67f}, .12f);
    const float grout = dice_.real(.5f, .75f), period = dice_.real(.25f, .6f);
    return shape_.pattern(Pattern::kTiles, a, a * grout, period, .04f, .3f);
  }
  if (!wet && kind < .38f) {
    const Vector3f a = paint(dice_, dice_.pick(kCarpets), .1f);
    return shape_.pattern(Pattern::kNoise, a, a * .75f, dice_.real(.015f, .04f));
  }
  if (!wet && kind < .5f) return jarTexture({"Wooden floor", "Old wooden floor"}, .03f);
  const Vector3f a = paint(dice_, dice_.pick(kWoods));
  return shape_.pattern(Pattern::kPlanks, a, a * .62f, dice_.real(.09f, .2f), .035f, .35f);
}

void ShellBuilder::chooseStyle() {
  static const Vector3f kWalls[] = {{.90f, .89f, .86f}, {.88f, .85f, .78f}, {.84f, .85f, .86f},
                                    {.80f, .84f, .87f}, {.82f, .86f, .79f}, {.89f, .82f, .78f},
                                    {.87f, .82f, .70f}, {.92f, .91f, .90f}, {.78f, .78f, .76f}};
  static const Vector3f kAccents[] = {{.32f, .42f, .50f}, {.40f, .50f, .42f}, {.62f, .36f, .30f},
                                      {.52f, .46f, .56f}, {.75f, .60f, .38f}, {.40f, .42f, .44f},
                                      {.66f, .74f, .80f}, {.72f, .55f, .50f}};
  const Vector3f wall = paint(dice_, dice_.pick(kWalls), .04f);
  style_.wall = shape_.pattern(Pattern::kNoise, wall, wall * .96f, .25f);
  style_.accent = style_.wall;
  const Vector3f accent = paint(dice_, dice_.pick(kAccents));
  const float style = dice_.real(0, 1);
  if (style > .55f) style_.accent_wall = dice_.integer(0, int(shell_.walls.size()) - 1);
  if (style > .9f)
    style_.accent =
        jarTexture({"Small bricks", "Small red bricks", "Small white bricks", "Stone"}, 0);
  else if (style > .8f)
    style_.accent =
        shape_.pattern(Pattern::kStripes, wall, wall * .7f + accent * .3f, dice_.real(.12f, .3f));
  else if (style > .55f)
    style_.accent = shape_.pattern(Pattern::kNoise, accent, accent * .94f, .3f);
  if (plan_.kind == "bathroom") {
    style_.tile_height = dice_.chance(.3f) ? 2.04f : dice_.real(1.2f, 2.f);
    if (dice_.chance(.5f)) {
      style_.tiles = jarTexture({"Blue tiles", "Beige tiles", "Marble", "Light blue tiles"}, .05f);
    } else {
      const Vector3f a =
          paint(dice_, dice_.chance(.6f) ? Vector3f(.88f, .88f, .86f) : dice_.pick(kAccents));
      style_.tiles =
          shape_.pattern(Pattern::kTiles, a, a * .75f, dice_.real(.1f, .25f), .05f, .25f);
    }
  }
  style_.floor = floorFinish();
  style_.ceiling = shape_.plain(paint(dice_, {.92f, .92f, .91f}, .02f));
  const bool white = dice_.chance(.75f);
  style_.trim = shape_.plain(
      white ? paint(dice_, {.91f, .91f, .89f}, .03f) : paint(dice_, {.52f, .37f, .26f}), .04f, .4f);
  const Vector3f leaf = white && dice_.chance(.7f) ? paint(dice_, {.90f, .90f, .88f}, .03f)
                                                   : paint(dice_, {.60f, .44f, .30f});
  style_.leaf = shape_.pattern(Pattern::kPlanks, leaf, leaf * .93f, .6f, .04f, .4f);
  style_.metal = shape_.plain(paint(dice_, {.62f, .62f, .60f}, .12f), .25f, .3f);
  const Vector3f cloth = dice_.chance(.5f) ? paint(dice_, {.86f, .84f, .80f}, .06f) : accent;
  shell_.fabric = dice_.chance(.7f)
                      ? shape_.pattern(Pattern::kNoise, cloth, cloth * .9f, .02f)
                      : shape_.pattern(Pattern::kStripes, cloth, wall, dice_.real(.05f, .16f));
}

// One lattice of lines through every corner, opening and crease: neighbouring cells share whole
// edges with identical coordinates, on walls, floor, ceilings and reveals, so no ray slips out.
void ShellBuilder::lattice() {
  for (const Vector2f& p : shell_.outline) lines_[0].push_back(p.x()), lines_[1].push_back(p.y());
  lines_[2].push_back(0);
  if (style_.tile_height > 0) lines_[2].push_back(style_.tile_height);
  for (const Wall& w : shell_.walls)
    for (const Opening& o : w.openings) {
      auto& along = lines_[size_t(w.axis())];
      along.push_back(w.coordinate(o.lo)), along.push_back(w.coordinate(o.hi));
      lines_[2].push_back(o.bottom), lines_[2].push_back(o.top);
    }
  for (size_t i = 1; i < shell_.ceilings.size(); ++i)  // where a slope meets the flat ceiling
    for (int a = 0; a < 2; ++a)
      if (shell_.ceilings[i][a] != 0)
        lines_[size_t(a)].push_back((shell_.height - shell_.ceilings[i].z()) /
                                    shell_.ceilings[i][a]);
  for (auto& l : lines_) {
    std::sort(l.begin(), l.end());
    l.erase(std::unique(l.begin(), l.end()), l.end());
  }
  lines_[2].push_back(INFINITY);  // the ceiling
}

void ShellBuilder::floorAndCeiling() {
  const bool along_x = plan_.width > plan_.depth;
  for (size_t i = 0; i + 1 < lines_[0].size(); ++i)
    for (size_t j = 0; j + 1 < lines_[1].size(); ++j) {
      const Vector2f lo(lines_[0][i], lines_[1][j]), hi(lines_[0][i + 1], lines_[1][j + 1]);
      if (!shell_.contains((lo + hi) / 2)) continue;
      std::array<Vector3f, 4> p = {Vector3f(lo.x(), lo.y(), 0), Vector3f(hi.x(), lo.y(), 0),
                                   Vector3f(hi.x(), hi.y(), 0), Vector3f(lo.x(), hi.y(), 0)};
      std::array<Vector3f, 4> floor = p;
      if (!along_x) std::rotate(floor.begin(), floor.begin() + 1, floor.end());
      shape_.quad(floor, style_.floor);
      for (Vector3f& q : p) q.z() = shell_.ceilingAt(q.head<2>());
      std::swap(p[1], p[3]);
      shape_.quad(p, style_.ceiling);
    }
}

/// Lattice cells of a wall (or of a plane `off` metres in front of it) in a range along it and in
/// height; `finish` of a cell's middle, nothing where its material is negative. Heights are cut at
/// the ceiling at each line, so cells on both sides of a line end in the same points.
template <typename FinishAt>
void ShellBuilder::cells(const Wall& wall, float off, float lo, float hi, float bottom, float top,
                         const FinishAt& finish) {
  const int a = wall.axis();
  const float ends[2] = {wall.coordinate(lo), wall.coordinate(hi)};
  const float from = std::min(ends[0], ends[1]), to = std::max(ends[0], ends[1]);
  const auto& l = lines_[size_t(a)];
  const auto& z = lines_[2];
  for (size_t i = 0; i + 1 < l.size(); ++i) {
    if (l[i] < from || l[i + 1] > to) continue;
    for (size_t j = 0; j + 1 < z.size(); ++j) {
      if (z[j] < bottom || z[j + 1] > top) continue;
      // Right to left of the wall's own x: as seen from the room.
      const float c[2] = {wall.along[a] > 0 ? l[i + 1] : l[i], wall.along[a] > 0 ? l[i] : l[i + 1]};
      std::array<Vector3f, 4> p;
      for (size_t k = 0; k < 4; ++k) {
        Vector2f q = wall.from;
        q[a] = c[k == 1 || k == 2];
        const float roof = shell_.ceilingAt(q);
        q += off * wall.inward();
        p[k] = {q.x(), q.y(), std::min(z[j + (k >= 2)], roof)};
      }
      if (p[0].z() == p[3].z() && p[1].z() == p[2].z()) continue;
      const float s = ((l[i] + l[i + 1]) / 2 - wall.from[a]) * wall.along[a];
      finish(p, s, (p[0].z() + p[3].z()) / 2);
    }
  }
}

void ShellBuilder::wall(size_t index) {
  const Wall& w = shell_.walls[index];
  const Finish& upper = int(index) == style_.accent_wall ? style_.accent : style_.wall;
  cells(w, 0, 0, w.length, 0, INFINITY, [&](const std::array<Vector3f, 4>& p, float s, float z) {
    for (const Opening& o : w.openings)
      if (s > o.lo && s < o.hi && z > o.bottom && z < o.top) return;
    shape_.quad(p, z < style_.tile_height ? style_.tiles : upper);
  });
}

void ShellBuilder::reveal(const Wall& w, const Opening& o) {
  const int a = w.axis();
  const Vector2f back = -o.recess * w.inward();
  const auto strip = [&](std::array<Vector3f, 2> edge) {  // from the wall's plane to the back
    const Vector3f d(back.x(), back.y(), 0);
    shape_.quad({edge[0], edge[1], edge[1] + d, edge[0] + d}, style_.trim);
  };
  const auto at = [&](float coordinate, float z) {
    Vector2f p = w.from;
    p[a] = coordinate;
    return Vector3f(p.x(), p.y(), z);
  };
  const float lo = w.coordinate(o.lo), hi = w.coordinate(o.hi);
  const auto& l = lines_[size_t(a)];
  const bool rising = w.along[a] > 0;
  for (size_t i = 0; i + 1 < l.size(); ++i) {
    if (l[i] < std::min(lo, hi) || l[i + 1] > std::max(lo, hi)) continue;
    const float first = rising ? l[i] : l[i + 1], second = rising ? l[i + 1] : l[i];
    strip({at(second, o.bottom), at(first, o.bottom)});
    strip({at(first, o.top), at(second, o.top)});
  }
  const auto& z = lines_[2];
  for (size_t j = 0; j + 1 < z.size(); ++j) {
    if (z[j] < o.bottom || z[j + 1] > o.top) continue;
    strip({at(lo, z[j]), at(lo, z[j + 1])});
    strip({at(hi, z[j + 1]), at(hi, z[j])});
  }
}

/// What is seen through the windows: a sky from the jar over hedges, trees and houses; dusk in the
/// evening; in bathrooms frosted glass.
void ShellBuilder::outside() {
  constexpr int kWidth = 160, kHeight = 128;
  auto texture = std::make_shared<Texture>();
  texture->width = kWidth, texture->height = kHeight;
  texture->rgba.resize(size_t(kWidth * kHeight * 4));
  std::vector<size_t> skies;
  for (size_t i = 0; i < assets_.textures().size(); ++i)
    if (assets_.textures()[i].category == "Sky") skies.push_back(i);
  const std::shared_ptr<const Texture> sky =
      skies.empty() ? nullptr : assets_.texture(dice_.pick(skies));
  const bool frosted = plan_.kind == "bathroom";
  const float horizon = dice_.real(.35f, .65f);
  const Vector3f green{dice_.real(.36f, .48f), dice_.real(.43f, .52f), dice_.real(.30f, .38f)};
  const Vector3f house{dice_.real(.6f, .85f), dice_.real(.55f, .75f), dice_.real(.45f, .7f)};
  struct Blob {
    float x, y, r;
    Vector3f colour;
  };
  std::vector<Blob> trees;
  for (int i = dice_.integer(3, 9); i > 0; --i) {
    const float x = dice_.real(0, 1), r = dice_.real(.05f, .18f), shade = dice_.real(.6f, 1.1f);
    trees.push_back({x, horizon - .3f * r, r, green * shade});
  }
  const float house_x = dice_.real(-.6f, 1.f), house_w = dice_.real(.25f, .5f);
  const float house_top = horizon - dice_.real(.12f, .3f);
  for (int j = 0; j < kHeight; ++j)
    for (int i = 0; i < kWidth; ++i) {
      const float x = (float(i) + .5f) / kWidth, y = (float(j) + .5f) / kHeight;
      Vector3f c = Vector3f(.55f, .72f, .93f) + Vector3f(.35f, .22f, .06f) * (y / horizon);
      if (sky && y < horizon) {
        const size_t sx = size_t(x * float(sky->width)) % size_t(sky->width);
        const size_t sy = size_t(y / horizon * .99f * float(sky->height)) % size_t(sky->height);
        const uint8_t* p = &sky->rgba[4 * (sy * size_t(sky->width) + sx)];
        c = .5f * c + .5f * Vector3f(p[0], p[1], p[2]) / 255;
      }
      if (x > house_x && x < house_x + house_w && y > house_top && y < horizon + .05f) c = house;
      if (y > horizon) c = green * (1.5f - .6f * (y - horizon) / (1 - horizon));
      for (const Blob& b : trees) {
        const float edge = b.r * (1 + .12f * std::sin(40 * x + 9 * b.x) * std::cos(37 * y));
        if (Vector2f(x - b.x, y - b.y).norm() < edge)
          c = b.colour * (1.25f - .5f * (y - b.y) / b.r);
      }
      if (frosted) c = Vector3f(.86f, .91f, .93f) - Vector3f::Constant(.12f * y);
      if (shell_.is_evening) c = c.cwiseProduct(Vector3f(.30f, .36f, .55f));
      uint8_t* out = &texture->rgba[size_t(4 * (j * kWidth + i))];
      for (int k = 0; k < 3; ++k) out[k] = uint8_t(std::clamp(c[k], 0.f, 1.f) * 255 + .5f);
      out[3] = 255;
    }
  Material pane;
  pane.texture = texture;
  pane.colour_a = Vector3f::Ones();
  pane.emission = shell_.is_evening ? dice_.real(.15f, .4f) : dice_.real(1.5f, 3.f);
  pane_ = shape_.add(pane).material;
  const Vector3f tint{dice_.real(.86f, 1.f), dice_.real(.93f, 1.f), dice_.real(.97f, 1.08f)};
  daylight_ = tint * (shell_.is_evening ? .12f : dice_.real(5.f, 14.f));
}

void ShellBuilder::door(const Wall& w, const Opening& o) {
  const Place at = w.place(0);
  const float x0 = o.lo, x1 = o.hi, t = .018f, depth = -o.recess;
  cells(w, depth, x0, x1, o.bottom, o.top,
        [&](const std::array<Vector3f, 4>& p, float, float) { shape_.quad(p, style_.leaf); });
  shape_.box(at, {x0 - kTrim, 0, 0}, {x0, t, o.top + kTrim}, style_.trim);
  shape_.box(at, {x1, 0, 0}, {x1 + kTrim, t, o.top + kTrim}, style_.trim);
  shape_.box(at, {x0, 0, o.top}, {x1, t, o.top + kTrim}, style_.trim);
  // Raised panels and a handle on the leaf.
  const int rows = dice_.integer(1, 3), columns = dice_.integer(1, 2);
  const float margin = .11f, width = x1 - x0 - 2 * margin, height = o.top - 2 * margin;
  for (int i = 0; i < columns; ++i)
    for (int j = 0; j < rows; ++j) {
      const float px = x0 + margin + width * float(i) / float(columns);
      const float pz = margin + height * float(j) / float(rows);
      shape_.box(
          at, {px + .03f, depth, pz + .03f},
          {px + width / float(columns) - .03f, depth + .012f, pz + height / float(rows) - .03f},
          style_.leaf);
    }
  const float hx = dice_.chance(.5f) ? x0 + .06f : x1 - .06f, to = hx < (x0 + x1) / 2 ? 1.f : -1.f;
  shape_.box(at, {hx - .02f, depth, .95f}, {hx + .02f, depth + .016f, 1.15f}, style_.metal);
  shape_.box(at, {std::min(hx, hx + to * .12f), depth + .045f, 1.06f},
             {std::max(hx, hx + to * .12f), depth + .062f, 1.08f}, style_.metal);
  shape_.box(at, {hx - .01f, depth, 1.062f}, {hx + .01f, depth + .05f, 1.078f}, style_.metal);
  const float swing = x1 - x0;
  shell_.keep_clear.push_back(
      {w.place((x0 + x1) / 2, swing / 2), {(x1 - x0) / 2 + .04f, swing / 2}, 0, 2.05f});
}

void ShellBuilder::window(const Wall& w, const Opening& o) {
  const Place at = w.place(0);
  const float x0 = o.lo, x1 = o.hi, back = -o.recess, f = .055f, front = back + .05f;
  const Vector2f corner = w.from + o.hi * w.along;  // lower left as seen from the room
  cells(w, back, x0, x1, o.bottom, o.top, [&](const std::array<Vector3f, 4>& p, float, float) {
    Finish part = {pane_, {x1 - x0, o.top - o.bottom}};
    // The picture spans the window: move its origin to the window's corner.
    const size_t first = room_.surface.uv.size();
    shape_.quad(p, part);
    const Vector2f origin(-w.along.dot(corner) / part.repeat_m.x(), o.bottom / part.repeat_m.y());
    for (size_t i = first; i < room_.surface.uv.size(); ++i)
      for (Vector2f& uv : room_.surface.uv[i])
        uv = (uv - origin).cwiseMax(.004f).cwiseMin(.996f);  // no wrapping at the edge
  });
  shape_.box(at, {x0, back, o.bottom}, {x0 + f, front, o.top}, style_.trim);
  shape_.box(at, {x1 - f, back, o.bottom}, {x1, front, o.top}, style_.trim);
  shape_.box(at, {x0 + f, back, o.bottom}, {x1 - f, front, o.bottom + f}, style_.trim);
  shape_.box(at, {x0 + f, back, o.top - f}, {x1 - f, front, o.top}, style_.trim);
  const int panes = std::max(1, int((x1 - x0) / dice_.real(.5f, .8f)));
  for (int i = 1; i < panes; ++i) {
    const float m = x0 + (x1 - x0) * float(i) / float(panes);
    shape_.box(at, {m - .03f, back, o.bottom + f}, {m + .03f, front, o.top - f}, style_.trim);
  }
  if (dice_.chance(.35f)) {
    const float z = o.top - (o.top - o.bottom) * .3f;
    shape_.box(at, {x0 + f, back, z - .02f}, {x1 - f, front - .01f, z + .02f}, style_.trim);
  }
  if (o.bottom > .3f)
    shape_.box(at, {x0 - .05f, front, o.bottom - .03f}, {x1 + .05f, .05f, o.bottom}, style_.trim);
  if (o.has_curtains) curtains(w, o);
  // Before the frame, so that it lights the reveal but is not cut into by the bars.
  RoomLight light;
  light.centre = at.point(Vector3f((x0 + x1) / 2, front + .01f, (o.bottom + o.top) / 2));
  light.half_u = at.direction({(x1 - x0) / 2 - f, 0, 0});
  light.half_v = Vector3f(0, 0, -(o.top - o.bottom) / 2 + f);  // down: u x v points inward
  light.bound_m = .02f;
  light.radiance = daylight_;
  room_.lights.push_back(light);
}

void ShellBuilder::curtains(const Wall& w, const Opening& o) {
  const Place at = w.place(0);
  const float wide = dice_.real(.22f, .38f), z0 = .02f, depth = .03f, off = .1f;
  const float roof = std::min(shell_.ceilingAt(w.from + (o.lo - .4f) * w.along),
                              shell_.ceilingAt(w.from + (o.hi + .4f) * w.along));
  const float z1 = std::min(o.top + .12f, roof - .05f);
  for (int side = 0; side < 2; ++side) {
    const float c0 = side ? o.hi - .08f : o.lo + .08f - wide;
    shape_.curtain(at.at(0, off), c0, c0 + wide, z0, z1, depth, shell_.fabric);
    shell_.fixtures.push_back(
        {w.place(c0 + wide / 2, off), {wide / 2, depth + .005f}, z0, z1 + .03f});
  }
  shape_.box(at, {o.lo - wide, off - .008f, z1}, {o.hi + wide, off + .008f, z1 + .016f},
             style_.metal);
}

void ShellBuilder::skirting() {
  if (style_.tile_height > 0) return;
  const float h = dice_.real(.06f, .11f), t = .014f;
  for (const Wall& w : shell_.walls) {
    std::vector<Vector2f> gaps;
    for (const Opening& o : w.openings)
      if (o.bottom < h)
        gaps.push_back({o.lo - (o.is_window ? 0 : kTrim), o.hi + (o.is_window ? 0 : kTrim)});
    std::sort(gaps.begin(), gaps.end(),
              [](const Vector2f& a, const Vector2f& b) { return a[0] < b[0]; });
    gaps.push_back({w.length, w.length});
    float from = 0;
    for (const Vector2f& g : gaps) {
      if (g[0] > from) shape_.box(w.place(0), {from, 0, 0}, {g[0], t, h}, style_.trim);
      from = g[1];
    }
  }
}

void ShellBuilder::sun() {
  std::vector<const Wall*> sunny;
  for (const Wall& w : shell_.walls)
    for (const Opening& o : w.openings)
      if (o.is_window) sunny.push_back(&w);
  const bool shines = !shell_.is_evening && dice_.chance(.5f);
  if (sunny.empty() || !shines) return;
  const Wall& w = *dice_.pick(sunny);
  const float azimuth = dice_.real(-.9f, .9f), elevation = dice_.real(.26f, .96f);
  const Vector2f level = Place::facing({0, 0}, -w.inward()).turned(azimuth).front();
  room_.sun.towards = {level.x() * std::cos(elevation), level.y() * std::cos(elevation),
                       std::sin(elevation)};
  room_.sun.irradiance = Vector3f(1.f, .93f, .82f) * dice_.real(5.f, 20.f);
}

}  // namespace

Shell buildShell(const AssetLibrary& assets, const ShellPlan& plan, Dice& dice, Room* room) {
  return ShellBuilder(assets, plan, dice, room).build();
}

}  // namespace vdbc
