#pragma once
// Private to the room generator: dice, simple shapes, and the shell of a room (walls, floor,
// ceilings, doors, windows). All in the room's own frame: floor at z = 0, metres.
#include <random>
#include <string>
#include <vector>

#include "examples/rooms/rooms.h"
#include "vdb/uniform.h"

namespace vdbc {

/// Random numbers with mappings of our own: those of <random> differ between standard libraries.
/// Never two draws among the arguments of one call in parentheses: their order is the compiler's
/// choice (that of a list in braces is fixed).
class Dice {
 public:
  explicit Dice(uint64_t seed) : engine_(seed) {}
  float real(float a, float b) { return a + (b - a) * float(uniform(engine_)); }
  int integer(int a, int b) { return a + int((engine_() >> 33) % uint64_t(b - a + 1)); }
  bool chance(float p) { return real(0, 1) < p; }
  template <typename T, size_t N>
  const T& pick(const T (&items)[N]) {
    return items[size_t(integer(0, int(N) - 1))];
  }
  template <typename T>
  const T& pick(const std::vector<T>& items) {
    return items[size_t(integer(0, int(items.size()) - 1))];
  }

 private:
  std::mt19937_64 engine_;
};

/// Scene-linear from display sRGB 0-1, with a little variation of tone and tint.
Eigen::Vector3f paint(Dice& dice, const Eigen::Vector3f& srgb, float variation = .06f);

/// Where something stands: its own x to the right, y to its front, z up (as ModelInfo).
struct Place {
  Eigen::Vector2f origin = Eigen::Vector2f::Zero();
  float c = 1, s = 0;  // cosine and sine of its yaw

  static Place facing(const Eigen::Vector2f& origin, const Eigen::Vector2f& front) {
    return {origin, front.y(), -front.x()};
  }
  Eigen::Vector2f right() const { return {c, s}; }
  Eigen::Vector2f front() const { return {-s, c}; }
  Eigen::Vector2f point(float x, float y) const { return origin + x * right() + y * front(); }
  Eigen::Vector2f local(const Eigen::Vector2f& p) const {
    return {right().dot(p - origin), front().dot(p - origin)};
  }
  Eigen::Vector3f point(const Eigen::Vector3f& p) const {
    const Eigen::Vector2f q = point(p.x(), p.y());
    return {q.x(), q.y(), p.z()};
  }
  Eigen::Vector3f direction(const Eigen::Vector3f& d) const {
    return {c * d.x() - s * d.y(), s * d.x() + c * d.y(), d.z()};
  }
  /// The place at (x, y) of this one, the same way round, then turned.
  Place at(float x, float y) const { return {point(x, y), c, s}; }
  Place turned(float radians) const;
  Place back() const { return {origin, -c, -s}; }
  Eigen::Affine3f affine(float z = 0) const;
};

/// An upright box that may be turned: what a piece takes up.
struct Block {
  Place at;  // its middle
  Eigen::Vector2f half = Eigen::Vector2f::Zero();
  float bottom = 0, top = 0;

  std::array<Eigen::Vector2f, 4> corners() const;
  Eigen::AlignedBox3f bounds() const;
  float distance(const Eigen::Vector2f& p) const;  // in plan; 0 inside
};
/// Whether two blocks share more than `slack` metres in every direction (separating axes).
bool overlap(const Block& a, const Block& b, float slack = 0);

/// A material and the metres after which its picture repeats (1 for patterns, whose uv is metres).
struct Finish {
  int material = 0;
  Eigen::Vector2f repeat_m = Eigen::Vector2f::Ones();
};

/// Adds simple shapes to a surface.
class Shaper {
 public:
  explicit Shaper(SurfaceMesh* surface) : surface_(*surface) {}

  Finish plain(const Eigen::Vector3f& colour, float specular = 0, float roughness = .5f);
  Finish pattern(Material::Pattern pattern, const Eigen::Vector3f& a, const Eigen::Vector3f& b,
                 float period_m, float specular = 0, float roughness = .5f);
  Finish add(const Material& material, const Eigen::Vector2f& repeat_m = {1, 1});
  Material& material(const Finish& finish) { return surface_.materials[size_t(finish.material)]; }

  /// Corners anticlockwise seen from the front; uv is the distance along p1 - p0 and p3 - p0, from
  /// the room's origin. Triangles without area are left out.
  void quad(const std::array<Eigen::Vector3f, 4>& p, const Finish& finish);
  /// A box in the frame of `at`; the grain runs along the longer side of each face.
  void box(const Place& at, const Eigen::Vector3f& lo, const Eigen::Vector3f& hi,
           const Finish& finish);
  /// A turned shape about a vertical axis: (radius, z) from bottom to top, capped where radius > 0.
  void turned(const Place& at, const std::vector<Eigen::Vector2f>& profile, const Finish& finish,
              int sides = 20);
  /// Hanging cloth with folds: x from lo to hi, y about zero.
  void curtain(const Place& at, float lo, float hi, float bottom, float top, float depth,
               const Finish& finish);

 private:
  void triangle(const Eigen::Vector3f (&p)[3], const Eigen::Vector2f (&uv)[3],
                const Eigen::Vector3f (&normal)[3], int material);
  SurfaceMesh& surface_;
};

struct Opening {
  float lo = 0, hi = 0;  // along the wall
  float bottom = 0, top = 0, recess = .1f;
  bool is_window = false, has_curtains = false;
};

/// A wall from corner to corner, the room on its left.
struct Wall {
  Eigen::Vector2f from, to, along;  // along: unit, exact on an axis
  float length = 0;
  std::vector<Opening> openings;

  Eigen::Vector2f inward() const { return {-along.y(), along.x()}; }
  int axis() const { return along.x() != 0 ? 0 : 1; }
  /// Frame at `s` metres along: x along the wall, y into the room.
  Place place(float s, float off = 0) const {
    return Place::facing(from + s * along + off * inward(), inward());
  }
  /// Room coordinate on axis() at `s` metres along; the same float wherever it is asked for.
  float coordinate(float s) const {
    return s == length ? to[axis()] : from[axis()] + along[axis()] * s;
  }
};

/// What the generator knows of the shell while it furnishes.
struct Shell {
  std::vector<Eigen::Vector2f> outline;   // anticlockwise, right angles
  std::vector<Wall> walls;                // walls[i] from outline[i]
  std::vector<Eigen::Vector3f> ceilings;  // as Room
  float height = 0;
  bool is_evening = false;
  Finish fabric;                  // of the curtains
  std::vector<Block> fixtures;    // curtains: what furniture must keep off
  std::vector<Block> keep_clear;  // where doors open

  float ceilingAt(const Eigen::Vector2f& p) const;
  bool contains(const Eigen::Vector2f& p) const;
};

struct ShellPlan {
  std::string kind;
  float width = 0, depth = 0, height = 0;
  Eigen::Vector2f cut = Eigen::Vector2f::Zero();  // of an L: what is missing at one corner
  bool is_evening = false;
  float knee = 0, slope = 0;  // attic: height at the low wall, rise per metre; 0: flat
};

/// Builds the shell into room->surface (room frame), with window lights, sun, floor and ceilings.
Shell buildShell(const AssetLibrary& assets, const ShellPlan& plan, Dice& dice, Room* room);

}  // namespace vdbc
