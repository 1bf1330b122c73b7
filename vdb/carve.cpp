// Filled and seen-empty voxels of depth views.
//
// Exactness. The truth is a double-precision DDA along every ray, rounding and all. The
// voxel-driven version decides with geometry wherever rounding cannot matter and runs that very DDA
// for the one ray in question where it could: every comparison keeps kSlack (in voxels), a bound on
// how far the DDA's accumulated rounding moves a crossing (rays are at most kMaxRayVoxels long).
#include "vdb/carve.h"

#include <openvdb/math/DDA.h>
#include <openvdb/math/Ray.h>
#include <openvdb/tools/Prune.h>
#include <openvdb/tree/ValueAccessor.h>
#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <atomic>
#include <cfloat>
#include <cmath>
#include <limits>

#include "vdb/grid_instances.h"

// Hot loops are compiled for several instruction sets and chosen at run time.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
#define VDBC_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define VDBC_CLONES
#endif
// A clone's callees are only compiled for its instruction set where they are inlined.
#define VDBC_INLINE inline __attribute__((always_inline))

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using RayD = openvdb::math::Ray<double>;

constexpr double kMaxRayVoxels = 65536;       // per axis; longer rays are not traversed at all
constexpr double kMaxOriginVoxels = 1 << 24;  // cameras further from the grid's origin are an error
// Voxels. A DDA of n steps adds at most n * 2^-53 to a crossing's time in [0, 1], that is
// n^2 * 2^-53 = 5e-7 voxels; rounding of the end point (2^-53 * kMaxOriginVoxels = 2e-9) is less.
constexpr double kSlack = 1e-6;

// What the rays of a view have in common.
struct Rays {
  Rays(const VoxelFrame& frame, const DepthView& view, size_t number)
      : camera(view.camera),
        grid_from_world(frame.world_from_grid.inverse()),
        voxel_m(double(frame.voxel_m)) {
    const Camera& c = camera;
    require(view.depth != nullptr && c.width > 0 && c.height > 0, "carve: view ", number,
            ": expected a depth image, found none");
    require(std::isfinite(c.fx) && std::isfinite(c.fy) && c.fx > 0 && c.fy > 0 &&
                std::isfinite(c.cx) && std::isfinite(c.cy),
            "carve: view ", number, ": expected positive focal lengths, found ", c.fx, ", ", c.fy);
    require(std::isfinite(voxel_m) && voxel_m > 0, "carve: expected a positive voxel size, found ",
            voxel_m);
    origin = toIndex(c.world_from_camera.translation());
    const bool near = origin.cwiseAbs().maxCoeff() < kMaxOriginVoxels;  // false for NaN
    require(near, "carve: view ", number, ": expected a camera within ", kMaxOriginVoxels,
            " voxels of the grid's origin, found ", origin.transpose());
    start = Coord(int(std::floor(origin.x())), int(std::floor(origin.y())),
                  int(std::floor(origin.z())));

    // Rays use the pose as it is, so a slightly skewed one is inverted in full below.
    grid_from_camera = grid_from_world.linear() * c.world_from_camera.linear();
    const double skew =
        (grid_from_camera.transpose() * grid_from_camera - Matrix3d::Identity()).norm();
    require(skew < 1e-3, "carve: view ", number, ": expected a rigid pose, found one off by ",
            skew);
    double longest = 0;
    for (double u : {0.0, double(c.width)}) {
      for (double v : {0.0, double(c.height)}) {
        longest = std::max(longest, (grid_from_camera * inCamera(u, v)).cwiseAbs().maxCoeff());
      }
    }
    max_depth_m = kMaxRayVoxels * voxel_m / longest;
  }

  Vector3d inCamera(double u, double v) const {
    return {(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1};
  }
  Vector3d toIndex(const Vector3d& p_world) const { return grid_from_world * p_world / voxel_m; }
  // The point of pixel (i, j), voxel units.
  Vector3d point(int i, int j, double depth_m) const {
    return toIndex(camera.unproject(i + 0.5, j + 0.5, depth_m));
  }

  Camera camera;
  Eigen::Isometry3d grid_from_world;
  double voxel_m;
  Vector3d origin;  // of all rays, voxel units
  Coord start;      // its voxel
  Matrix3d grid_from_camera;
  double max_depth_m;  // what would lie beyond kMaxRayVoxels
};

Coord floorCoord(const Vector3d& p) {
  return openvdb::Coord::floor(openvdb::Vec3d(p.x(), p.y(), p.z()));
}

// The ray of a pixel as the truth has it: calls visit(voxel) from the camera's voxel on until the
// voxel of the point is reached (not visited itself), the segment ends, or visit returns false.
// Returns the voxel of the point.
template <typename Visit>
Coord traverse(const Rays& rays, int i, int j, double depth_m, const Visit& visit) {
  const Vector3d p = rays.point(i, j, depth_m);
  const Vector3d d = p - rays.origin;
  const Coord hit = floorCoord(p);
  const RayD ray({rays.origin.x(), rays.origin.y(), rays.origin.z()}, {d.x(), d.y(), d.z()}, 0.,
                 1.);
  openvdb::math::DDA<RayD> dda(ray);
  do {
    if (dda.voxel() == hit || !visit(dda.voxel())) break;
  } while (dda.step());
  return hit;
}

// Depth that carries rays: usableDepth() less what is too far to traverse.
std::vector<float> rayDepth(const DepthView& view, const Rays& rays,
                            const CarveSettings& settings) {
  CarveSettings limited = settings;
  limited.max_depth_m =
      std::min(settings.max_depth_m, std::nextafter(float(rays.max_depth_m), 0.f));
  return usableDepth(view, limited);
}

// --- pixels
// -----------------------------------------------------------------------------------------

// One row of usableDepth(); `above` and `below` are null at the image's edges.
VDBC_CLONES void usableRow(const float* row, const float* above, const float* below, int width,
                           float max_depth, float ratio, float* out) {
  for (int i = 0; i < width; ++i) {
    const float d = row[i];
    out[i] = (d > 0.f) & (d <= max_depth) & (d <= FLT_MAX) ? d : 0.f;
  }
  if (!(ratio > 0.f)) return;
  const auto between = [ratio](float a, float d, float b) {
    const float limit = ratio * d, da = a - d, db = b - d;
    return (a > 0.f) & (b > 0.f) & (a <= FLT_MAX) & (b <= FLT_MAX) &
           (((da > limit) & (db < -limit)) | ((da < -limit) & (db > limit)));
  };
  for (int i = 1; i + 1 < width; ++i) {
    out[i] = between(row[i - 1], row[i], row[i + 1]) ? 0.f : out[i];
  }
  if (!above || !below) return;
  for (int i = 0; i < width; ++i) out[i] = between(above[i], row[i], below[i]) ? 0.f : out[i];
}

// Voxels of the points of one row: point = origin + depth * (first + i * step), voxel units.
// `sure` is 0 where a point is so close to a voxel's face that rounding decides.
VDBC_CLONES void voxelsOfRow(const float* depth, int width, const double* origin,
                             const double* first, const double* step, int* x, int* y, int* z,
                             uint8_t* sure) {
  // Truncation rounds down once all is positive; 2^26 + 2^24 leaves 26 bits for the fraction.
  constexpr double kBias = 1 << 26;
  for (int i = 0; i < width; ++i) {
    const double d = double(depth[i]);
    const double px = origin[0] + d * (first[0] + i * step[0]) + kBias;
    const double py = origin[1] + d * (first[1] + i * step[1]) + kBias;
    const double pz = origin[2] + d * (first[2] + i * step[2]) + kBias;
    const int ix = int(px), iy = int(py), iz = int(pz);
    const double rx = px - ix - 0.5, ry = py - iy - 0.5, rz = pz - iz - 0.5;
    const double r = std::max(std::max(std::abs(rx), std::abs(ry)), std::abs(rz));
    x[i] = ix - int(kBias), y[i] = iy - int(kBias), z[i] = iz - int(kBias);
    sure[i] = r < 0.5 - kSlack;
  }
}

struct MinMax {
  float lo, hi;
};

// Halves rows: out[i] = of a[2i], a[2i + 1], b[2i], b[2i + 1], for all i that have both columns.
VDBC_CLONES void halveDepth(const float* a, const float* b, int n, MinMax* out) {
  for (int i = 0; i < n; ++i) {
    const float p = a[2 * i], q = a[2 * i + 1], r = b[2 * i], s = b[2 * i + 1];
    out[i] = {std::min(std::min(p, q), std::min(r, s)), std::max(std::max(p, q), std::max(r, s))};
  }
}

// Nearest and farthest depth over squares of 2^k pixels. No ray counts as depth 0: nothing lies in
// front of it, and a square without rays is all 0.
class DepthPyramid {
 public:
  DepthPyramid() = default;
  DepthPyramid(const float* depth, int width, int height) : depth_(depth), width_(width) {
    int w = width, h = height;
    while (w > 1 || h > 1) {
      Level level{(w + 1) / 2, {}};
      const int lh = (h + 1) / 2;
      level.cells.resize(size_t(level.width) * lh);
      for (int j = 0; j < lh; ++j) {
        const int j0 = 2 * j, j1 = std::min(2 * j + 1, h - 1);
        MinMax* out = &level.cells[size_t(j) * level.width];
        if (levels_.empty()) {
          const float *a = depth + size_t(j0) * w, *b = depth + size_t(j1) * w;
          halveDepth(a, b, w / 2, out);
          if (w & 1) out[w / 2] = {std::min(a[w - 1], b[w - 1]), std::max(a[w - 1], b[w - 1])};
        } else {
          const MinMax *a = &levels_.back().cells[size_t(j0) * w],
                       *b = &levels_.back().cells[size_t(j1) * w];
          for (int i = 0; i < level.width; ++i) {
            const int i0 = 2 * i, i1 = std::min(2 * i + 1, w - 1);
            out[i] = join(join(a[i0], a[i1]), join(b[i0], b[i1]));
          }
        }
      }
      w = level.width, h = lh;
      levels_.push_back(std::move(level));
    }
  }

  // Bounds over pixels [i0, i1] x [j0, j1]; may take in a few pixels around.
  VDBC_INLINE MinMax over(int i0, int i1, int j0, int j1) const {
    int k = 0;
    for (int n = std::max(i1 - i0, j1 - j0); n > 3; n >>= 1) ++k;
    MinMax all{FLT_MAX, 0.f};
    if (k == 0) {
      for (int j = j0; j <= j1; ++j) {
        const float* row = depth_ + size_t(j) * width_;
        for (int i = i0; i <= i1; ++i) all = join(all, {row[i], row[i]});
      }
      return all;
    }
    const Level& level = levels_[size_t(k) - 1];
    for (int j = j0 >> k; j <= j1 >> k; ++j) {
      const MinMax* row = &level.cells[size_t(j) * level.width];
      for (int i = i0 >> k; i <= i1 >> k; ++i) all = join(all, row[i]);
    }
    return all;
  }

 private:
  static MinMax join(MinMax a, MinMax b) { return {std::min(a.lo, b.lo), std::max(a.hi, b.hi)}; }
  struct Level {
    int width;
    std::vector<MinMax> cells;
  };
  const float* depth_ = nullptr;
  int width_ = 0;
  std::vector<Level> levels_;  // [0] is 2 x 2 pixels
};

// --- boxes in an image
// ------------------------------------------------------------------------------

// Where a box (grown by kSlack) lies in an image.
struct Footprint {
  double u0, u1, v0, v1;  // pixels; valid unless `crosses`
  double z0, z1;          // planar depth, metres
};

// The pixels whose centres lie in a footprint, inclusive; may be empty. (The limits are clamped to
// where int() is defined. int() truncates, so a centre right on u0 or v0 is left out: the
// footprint's slack makes that right.)
struct PixelRange {
  VDBC_INLINE PixelRange(const Footprint& f, int width, int height)
      : i0(int(std::min(std::max(f.u0 + 0.5, 0.), double(width)))),
        i1(int(std::max(std::min(f.u1 - 0.5, width - 1.), -1.))),
        j0(int(std::min(std::max(f.v0 + 0.5, 0.), double(height)))),
        j1(int(std::max(std::min(f.v1 - 0.5, height - 1.), -1.))) {}
  int i0, i1, j0, j1;
};

// A view made ready: rays, their depth and its pyramid, and the projection in voxel units.
struct Prepared {
  Prepared(const VoxelFrame& frame, const DepthView& view, size_t number,
           const CarveSettings& settings)
      : rays(frame, view, number), depth(rayDepth(view, rays, settings)) {
    const Camera& c = rays.camera;
    pyramid = DepthPyramid(depth.data(), c.width, c.height);
    farthest = pyramid.over(0, c.width - 1, 0, c.height - 1).hi;
    Matrix3d k;
    k << c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1;
    const Matrix3d pixel_from_grid = k * rays.grid_from_camera.inverse() * rays.voxel_m;
    const Matrix3d grid_from_pixel = rays.grid_from_camera / rays.voxel_m * k.inverse();
    for (int axis = 0; axis < 3; ++axis) {
      for (int n = 0; n < 3; ++n) project[axis][n] = pixel_from_grid(n, axis);
      across[axis] = grid_from_pixel(axis, 0);
      down[axis] = grid_from_pixel(axis, 1);
      corner[axis] = grid_from_pixel(axis, 2) + 0.5 * (across[axis] + down[axis]);
      origin[axis] = rays.origin[axis];
    }
    // A voxel holds a ball of radius 1/2, its image a disc of radius f / (2 z), and a disc of more
    // than sqrt(1/2) pixels holds a pixel's centre. 0.71 leaves room for a pose's skew and for
    // kSlack.
    pierced_z = std::min(c.fx, c.fy) * 0.5 * rays.voxel_m / 0.71;
    double reach = 0;
    for (double u : {0.0, double(c.width)}) {
      for (double v : {0.0, double(c.height)}) reach = std::max(reach, rays.inCamera(u, v).norm());
    }
    apex_reach = reach;
  }

  Rays rays;
  std::vector<float> depth;
  DepthPyramid pyramid;
  float farthest = 0;    // metres
  double project[3][3];  // [axis]: (u z, v z, z) for a step of one voxel; z in metres
  // Direction of pixel (i, j) in voxels per metre of depth: corner + i * across + j * down.
  double corner[3], across[3], down[3];
  double origin[3];
  double pierced_z;  // up to this depth, metres, every voxel holds a ray if its footprint has depth
  double apex_reach;  // length of the longest ray direction at depth 1
};

enum class Verdict { kNever, kAll, kUnsure };

struct Box {
  int x, y, z, size;  // voxels [x, x + size)^3
};

// Can the rays of `view` pass the box: none, surely every voxel of it, or look closer?
VDBC_INLINE Verdict classify(const Prepared& view, const Box& box, Footprint& f) {
  const double size = box.size + 2 * kSlack;
  const double o[3] = {box.x - kSlack - view.origin[0], box.y - kSlack - view.origin[1],
                       box.z - kSlack - view.origin[2]};
  const auto& m = view.project;
  double base[3];
  for (int n = 0; n < 3; ++n) base[n] = o[0] * m[0][n] + o[1] * m[1][n] + o[2] * m[2][n];
  double a[8], b[8], z[8];  // u z, v z, z of the corners
  for (int c = 0; c < 8; ++c) {
    const double sx = (c & 4) ? size : 0, sy = (c & 2) ? size : 0, sz = (c & 1) ? size : 0;
    a[c] = base[0] + sx * m[0][0] + sy * m[1][0] + sz * m[2][0];
    b[c] = base[1] + sx * m[0][1] + sy * m[1][1] + sz * m[2][1];
    z[c] = base[2] + sx * m[0][2] + sy * m[1][2] + sz * m[2][2];
  }
  f.z0 = f.z1 = z[0];
  for (int c = 1; c < 8; ++c) f.z0 = std::min(f.z0, z[c]), f.z1 = std::max(f.z1, z[c]);
  if (f.z1 <= 0 || f.z0 > view.farthest) return Verdict::kNever;

  const int width = view.rays.camera.width, height = view.rays.camera.height;
  if (f.z0 < 0.5 * view.rays.voxel_m) {  // across the image plane, or nearly
    // Outside of one side of the pyramid of pixel centres?
    double left = -DBL_MAX, right = -DBL_MAX, top = -DBL_MAX, bottom = -DBL_MAX;
    for (int c = 0; c < 8; ++c) {
      left = std::max(left, a[c] - 0.5 * z[c]);
      right = std::max(right, (width - 0.5) * z[c] - a[c]);
      top = std::max(top, b[c] - 0.5 * z[c]);
      bottom = std::max(bottom, (height - 0.5) * z[c] - b[c]);
    }
    const bool outside = left < 0 || right < 0 || top < 0 || bottom < 0;
    return outside ? Verdict::kNever : Verdict::kUnsure;
  }

  for (int c = 0; c < 8; ++c) {
    const double inverse = 1 / z[c];
    a[c] *= inverse, b[c] *= inverse;
  }
  f.u0 = f.u1 = a[0], f.v0 = f.v1 = b[0];
  for (int c = 1; c < 8; ++c) {
    f.u0 = std::min(f.u0, a[c]), f.u1 = std::max(f.u1, a[c]);
    f.v0 = std::min(f.v0, b[c]), f.v1 = std::max(f.v1, b[c]);
  }
  if (f.u1 < 0.5 || f.v1 < 0.5) return Verdict::kNever;
  if (box.size == 1 && f.z1 <= view.pierced_z) {
    // One depth often settles a voxel: its ball holds the centre of the pixel that its centre is
    // in.
    const double u = (base[0] + 0.5 * size * (m[0][0] + m[1][0] + m[2][0])) * 2 / (f.z0 + f.z1);
    const double v = (base[1] + 0.5 * size * (m[0][1] + m[1][1] + m[2][1])) * 2 / (f.z0 + f.z1);
    if (u >= 0 && v >= 0 && u < width && v < height &&
        view.depth[size_t(v) * size_t(width) + size_t(u)] > f.z1) {
      return Verdict::kAll;
    }
  }
  const PixelRange pixels(f, width, height);
  if (pixels.i0 > pixels.i1 || pixels.j0 > pixels.j1) return Verdict::kNever;
  const MinMax d = view.pyramid.over(pixels.i0, pixels.i1, pixels.j0, pixels.j1);
  if (f.z0 > d.hi || d.hi <= 0) return Verdict::kNever;
  const bool inside = f.u0 >= 0 && f.v0 >= 0 && f.u1 <= width && f.v1 <= height;
  if (inside && f.z1 < d.lo && f.z1 <= view.pierced_z) return Verdict::kAll;
  return Verdict::kUnsure;
}

// classify() for each of `count` views; moves the unsure to the front of `kept`, writes their
// footprints (only for single voxels) and their number. True as soon as one view passes all of it;
// that view moves to the front, as it will pass most siblings too (the order changes no result).
VDBC_CLONES bool classifyViews(const Prepared** views, int count, Box box, const Prepared** kept,
                               Footprint* footprints, int* kept_count) {
  int n = 0;
  for (int i = 0; i < count; ++i) {
    Footprint f;
    const Verdict verdict = classify(*views[i], box, f);
    if (verdict == Verdict::kAll) {
      std::swap(views[0], views[i]);
      return true;
    }
    if (verdict == Verdict::kUnsure) {
      if (footprints) footprints[n] = f;
      kept[n++] = views[i];
    }
  }
  *kept_count = n;
  return false;
}

// --- one voxel, one ray at a time
// -------------------------------------------------------------------

// Does the DDA of this ray visit the voxel before its point's? The truth itself.
__attribute__((noinline)) bool dda(const Prepared& view, int i, int j, float depth,
                                   const Coord& voxel) {
  bool found = false;
  traverse(view.rays, i, j, double(depth),
           [&](const Coord& ijk) { return !(found = ijk == voxel); });
  return found;
}

// Pixels whose rays may pass a voxel that lies across the image plane, or nearly.
void clipFootprint(const Prepared& view, const Coord& voxel, Footprint& f) {
  const Camera& camera = view.rays.camera;
  f.u0 = f.v0 = 0, f.u1 = camera.width, f.v1 = camera.height;
  // Rays nearer than `plane` stay within this distance of the camera.
  const double plane = 1e-3 * view.rays.voxel_m;
  const double apex = 1.01 * view.apex_reach * 1e-3 + kSlack;
  double gap = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double low = voxel[axis] - view.origin[axis], high = -1 - low;
    gap = std::max(gap, std::max(low, high));
  }
  if (gap <= apex) return;
  Vector3d corners[8];
  for (int c = 0; c < 8; ++c) {
    corners[c].setZero();
    for (int axis = 0; axis < 3; ++axis) {
      const double p =
          voxel[axis] - view.origin[axis] + ((c >> (2 - axis) & 1) ? 1 + kSlack : -kSlack);
      for (int n = 0; n < 3; ++n) corners[c][n] += p * view.project[axis][n];
    }
  }
  double u0 = DBL_MAX, u1 = -DBL_MAX, v0 = DBL_MAX, v1 = -DBL_MAX;
  const auto add = [&](const Vector3d& p, double z) {
    u0 = std::min(u0, p.x() / z), u1 = std::max(u1, p.x() / z);
    v0 = std::min(v0, p.y() / z), v1 = std::max(v1, p.y() / z);
  };
  for (int c = 0; c < 8; ++c) {
    if (corners[c].z() >= plane) add(corners[c], corners[c].z());
    for (int bit : {1, 2, 4}) {
      const Vector3d &p = corners[c], &q = corners[c ^ bit];
      if (p.z() < plane && q.z() > plane) {
        add(p + (q - p) * ((plane - p.z()) / (q.z() - p.z())), plane);
      }
    }
  }
  // Rounding of the cut, far to the side where it is largest, is far below a pixel within the
  // image.
  f.u0 = std::max(f.u0, u0 - 0.01), f.u1 = std::min(f.u1, u1 + 0.01);
  f.v0 = std::max(f.v0, v0 - 0.01), f.v1 = std::min(f.v1, v1 + 0.01);
}

// Does any ray of the view visit the voxel (which holds no point) before its point's voxel?
VDBC_CLONES bool passes(const Prepared& view, int vx, int vy, int vz, const Footprint& f) {
  const int width = view.rays.camera.width, height = view.rays.camera.height;
  const int voxel[3] = {vx, vy, vz};
  const PixelRange pixels(f, width, height);

  // Planes of entry and exit relative to the camera. Along an axis where the camera's voxel is this
  // one there is no entry, and the exit depends on the ray's sign.
  double entry[3], exit_up[3], exit_down[3];
  bool at_start = true;
  for (int axis = 0; axis < 3; ++axis) {
    const double low = voxel[axis] - view.origin[axis], high = low + 1;
    const int side = voxel[axis] - view.rays.start[axis];
    at_start &= side == 0;
    entry[axis] = side > 0 ? low : side < 0 ? high : 0;  // 0 / direction: no later than the camera
    exit_up[axis] = side >= 0 ? high : low;
    exit_down[axis] = side > 0 ? high : low;
  }
  const double tiny = 1e-9 / view.rays.voxel_m;
  const float nearest = float(f.z0) * (f.z0 > 0 ? 0.999999f : 1.000001f);
  // From the middle down, then the rest: a footprint's middle row is where rays pass most likely.
  const int rows = pixels.j1 - pixels.j0 + 1, middle = pixels.j0 + rows / 2;
  for (int n = 0; n < rows; ++n) {
    const int j = middle + n <= pixels.j1 ? middle + n : middle + n - rows;
    const float* row = view.depth.data() + size_t(j) * width;
    double start[3];
    for (int axis = 0; axis < 3; ++axis) start[axis] = view.corner[axis] + j * view.down[axis];
    for (int i = pixels.i0; i <= pixels.i1; ++i) {
      const float d = row[i];
      if (!(d > 0.f) || d < nearest) continue;
      if (at_start) return true;
      double in = 0, out = DBL_MAX, widest = 0;
      bool parallel = false;
      for (int axis = 0; axis < 3; ++axis) {
        const double q = start[axis] + i * view.across[axis];
        const double inverse = 1 / q;
        in = std::max(in, entry[axis] * inverse);
        out = std::min(out, (q > 0 ? exit_up[axis] : exit_down[axis]) * inverse);
        widest = std::max(widest, std::abs(inverse));
        parallel |= std::abs(q) < tiny;
      }
      const double slack = 2 * kSlack * widest, end = double(d);
      if (!parallel) {
        if (out - in > slack && in + slack < end * (1 - 1e-10)) return true;
        if (in - out > slack || in - slack > end * (1 + 1e-10)) continue;
      }
      if (dda(view, i, j, d, Coord(vx, vy, vz))) return true;
    }
  }
  return false;
}

// --- seen empty, block by block
// ---------------------------------------------------------------------

// 64 voxels of a node of 4^3: byte = latent slot, bit = voxel slot, as in OpenVDB's masks.
struct Block {
  Coord origin;
  uint64_t voxels;
};

constexpr int kRootSize = 32;  // voxels; a unit of parallel work

class EmptySearch {
 public:
  EmptySearch(const TokenMask& filled, const CoordBBox& bounds, size_t views)
      : filled_(filled), bounds_(bounds), arena_(views * 8), footprints_(views) {}

  /// Appends the blocks of the box that hold seen-empty voxels.
  void search(const Box& box, const std::vector<const Prepared*>& views,
              std::vector<Block>& blocks) {
    blocks_ = &blocks;
    views_ = views;
    descend(box, views_.data(), int(views_.size()), 0);
  }

 private:
  using Node4 = TokenMask::RootNodeType::ChildNodeType::ChildNodeType;

  CoordBBox bbox(const Box& b) const { return CoordBBox::createCube(Coord(b.x, b.y, b.z), b.size); }

  void descend(const Box& box, const Prepared** views, int count, int depth) {
    if (!bounds_.hasOverlap(bbox(box))) return;
    const Prepared** kept = arena_.data() + size_t(depth) * footprints_.size();
    int kept_count = 0;
    if (classifyViews(views, count, box, kept, nullptr, &kept_count)) return addAll(box);
    if (kept_count == 0) return;
    if (box.size > 4) {
      const int half = box.size / 2;
      for (int slot = 0; slot < 8; ++slot) {
        descend(child(box, half, slot), kept, kept_count, depth + 1);
      }
      return;
    }
    const Coord origin(box.x, box.y, box.z);
    const uint64_t skip = ~inBounds(origin) | filledIn(origin);
    if (skip == ~uint64_t(0)) return;
    uint64_t empty = 0;
    for (int slot = 0; slot < 8; ++slot) {
      const uint64_t skip8 = skip >> (8 * slot) & 0xff;
      if (skip8 != 0xff)
        empty |= latent(child(box, 2, slot), skip8, kept, kept_count, depth + 1) << (8 * slot);
    }
    if (empty) blocks_->push_back({origin, empty});
  }

  static Box child(const Box& b, int half, int slot) {
    return {b.x + (slot >> 2 & 1) * half, b.y + (slot >> 1 & 1) * half, b.z + (slot & 1) * half,
            half};
  }

  // Seen-empty voxels of a node of 2^3, but for those to skip.
  uint64_t latent(const Box& box, uint64_t skip, const Prepared** views, int count, int depth) {
    const Prepared** kept = arena_.data() + size_t(depth) * footprints_.size();
    int kept_count = 0;
    if (classifyViews(views, count, box, kept, nullptr, &kept_count)) return ~skip & 0xff;
    if (kept_count == 0) return 0;
    uint64_t empty = 0;
    const Prepared** unsure = arena_.data() + size_t(depth + 1) * footprints_.size();
    for (int slot = 0; slot < 8; ++slot) {
      if (skip >> slot & 1) continue;
      const Box voxel = child(box, 1, slot);
      int unsure_count = 0;
      bool seen = classifyViews(kept, kept_count, voxel, unsure, footprints_.data(), &unsure_count);
      for (int i = 0; i < unsure_count && !seen; ++i) {
        const Prepared& view = *unsure[i];
        Footprint& f = footprints_[size_t(i)];
        if (f.z0 < 0.5 * view.rays.voxel_m) clipFootprint(view, {voxel.x, voxel.y, voxel.z}, f);
        seen = passes(view, voxel.x, voxel.y, voxel.z, f);
      }
      if (seen) empty |= uint64_t(1) << slot;
    }
    return empty;
  }

  void addAll(const Box& box) {
    for (int x = box.x; x < box.x + box.size; x += 4) {
      for (int y = box.y; y < box.y + box.size; y += 4) {
        for (int z = box.z; z < box.z + box.size; z += 4) {
          const Coord origin(x, y, z);
          const uint64_t empty = inBounds(origin) & ~filledIn(origin);
          if (empty) blocks_->push_back({origin, empty});
        }
      }
    }
  }

  uint64_t inBounds(const Coord& origin) const {
    const CoordBBox box = CoordBBox::createCube(origin, 4);
    if (bounds_.isInside(box)) return ~uint64_t(0);
    uint64_t inside = 0;
    for (auto c = box.begin(); c; ++c) {
      if (bounds_.isInside(*c)) {
        inside |= uint64_t(1) << (8 * childSlot(tokenCoord(*c, 1)) + childSlot(*c));
      }
    }
    return inside;
  }

  uint64_t filledIn(const Coord& origin) {
    const Node4* node = filled_.probeConstNode<Node4>(origin);
    if (!node) return 0;
    uint64_t voxels = 0;
    for (auto leaf = node->cbeginChildOn(); leaf; ++leaf) {
      for (auto v = leaf->cbeginValueOn(); v; ++v) {
        voxels |= uint64_t(1) << (8 * leaf.pos() + v.pos());
      }
    }
    return voxels;
  }

  openvdb::tree::ValueAccessor<const TokenMask> filled_;
  const CoordBBox bounds_;
  std::vector<const Prepared*> arena_;  // a list of views per depth of the descent
  std::vector<const Prepared*> views_;  // of the whole search
  std::vector<Footprint> footprints_;
  std::vector<Block>* blocks_ = nullptr;
};

void addVoxels(TokenMask& mask, const std::vector<Block>& blocks) {
  openvdb::tree::ValueAccessor<TokenMask> accessor(mask);
  for (const Block& block : blocks) {
    if (block.voxels == ~uint64_t(0)) {
      accessor.addTile(2, block.origin, true, true);
      continue;
    }
    for (int slot = 0; slot < 8; ++slot) {
      const uint64_t voxels = block.voxels >> (8 * slot) & 0xff;
      if (!voxels) continue;
      const Coord origin =
          block.origin + Coord((slot >> 2 & 1) * 2, (slot >> 1 & 1) * 2, (slot & 1) * 2);
      if (voxels == 0xff) {
        accessor.addTile(1, origin, true, true);
        continue;
      }
      auto* leaf = accessor.touchLeaf(origin);
      for (openvdb::Index n = 0; n < 8; ++n) {
        if (voxels >> n & 1) leaf->setValueOn(n);
      }
    }
  }
}

TokenMask tokenMask(const std::vector<const MaskTree*>& masks) {
  TokenMask result;
  openvdb::tree::ValueAccessor<TokenMask> accessor(result);
  for (const MaskTree* mask : masks) {
    for (auto leaf = mask->cbeginLeaf(); leaf; ++leaf) {
      for (auto v = leaf->cbeginValueOn(); v; ++v) accessor.setValueOn(v.getCoord());
    }
  }
  return result;
}

// Voxels of the view's points, rows [begin, end), into `filled`.
void fillRows(const Prepared& view, const CoordBBox& bounds, int begin, int end, MaskTree& filled) {
  const int width = view.rays.camera.width;
  std::vector<int> x(static_cast<size_t>(width)), y(x), z(x);
  std::vector<uint8_t> sure(x.size());
  openvdb::tree::ValueAccessor<MaskTree> accessor(filled);
  Coord last = Coord::max();  // neighbouring pixels mostly share a voxel
  for (int j = begin; j < end; ++j) {
    const float* depth = view.depth.data() + size_t(j) * width;
    double first[3];
    for (int axis = 0; axis < 3; ++axis) first[axis] = view.corner[axis] + j * view.down[axis];
    voxelsOfRow(depth, width, view.origin, first, view.across, x.data(), y.data(), z.data(),
                sure.data());
    for (int i = 0; i < width; ++i) {
      if (!(depth[i] > 0.f)) continue;
      const size_t n = size_t(i);
      const Coord ijk =
          sure[n] ? Coord(x[n], y[n], z[n]) : floorCoord(view.rays.point(i, j, double(depth[i])));
      if (ijk == last) continue;
      last = ijk;
      if (bounds.isInside(ijk)) accessor.setValueOn(ijk);
    }
  }
}

}  // namespace

std::vector<float> usableDepth(const DepthView& view, const CarveSettings& settings) {
  const int width = view.camera.width, height = view.camera.height;
  require(view.depth != nullptr && width > 0 && height > 0,
          "usableDepth: expected a depth image, found none");
  std::vector<float> usable(size_t(width) * size_t(height));
  for (int j = 0; j < height; ++j) {
    const float* row = view.depth + size_t(j) * width;
    usableRow(row, j > 0 ? row - width : nullptr, j + 1 < height ? row + width : nullptr, width,
              settings.max_depth_m, settings.flying_pixel_ratio, &usable[size_t(j) * width]);
  }
  return usable;
}

SeenSpace carve(const VoxelFrame& frame, const std::vector<DepthView>& views,
                const CarveSettings& settings, Progress& progress) {
  SeenSpace space;
  space.box = frame.bounds;
  if (frame.bounds.empty() || views.empty()) return space;
  report(progress, 0);

  // F: the voxels of all points.
  std::vector<std::unique_ptr<Prepared>> prepared(views.size());
  tbb::enumerable_thread_specific<MaskTree> filled;
  tbb::parallel_for(size_t(0), views.size(), [&](size_t n) {
    prepared[n] = std::make_unique<Prepared>(frame, views[n], n, settings);
    const Prepared& view = *prepared[n];
    tbb::parallel_for(tbb::blocked_range<int>(0, view.rays.camera.height, 64),
                      [&](const tbb::blocked_range<int>& rows) {
                        fillRows(view, frame.bounds, rows.begin(), rows.end(), filled.local());
                      });
  });
  std::vector<const MaskTree*> masks;
  for (const MaskTree& mask : filled) masks.push_back(&mask);
  space.filled.root() = tokenMask(masks).root();
  report(progress, 30);

  // E: blocks of voxels against all views.
  std::vector<const Prepared*> all;
  for (const auto& view : prepared) {
    if (view->farthest > 0) all.push_back(view.get());
  }
  std::vector<Box> roots;
  const CoordBBox& b = frame.bounds;
  constexpr int kMask = ~(kRootSize - 1);
  for (int64_t x = b.min().x() & kMask; x <= b.max().x(); x += kRootSize) {
    for (int64_t y = b.min().y() & kMask; y <= b.max().y(); y += kRootSize) {
      for (int64_t z = b.min().z() & kMask; z <= b.max().z(); z += kRootSize) {
        roots.push_back({int(x), int(y), int(z), kRootSize});
      }
    }
  }
  std::vector<std::vector<Block>> found(roots.size());
  std::atomic<bool> cancelled{false};
  tbb::parallel_for(tbb::blocked_range<size_t>(0, roots.size(), 1),
                    [&](const tbb::blocked_range<size_t>& range) {
                      EmptySearch search(space.filled, b, std::max<size_t>(all.size(), 1));
                      for (size_t i = range.begin(); i != range.end(); ++i) {
                        if (cancelled || progress.wasInterrupted()) {
                          cancelled = true;
                          return;
                        }
                        search.search(roots[i], all, found[i]);
                      }
                    });
  if (cancelled) throw Cancelled();
  for (const auto& blocks : found) addVoxels(space.empty, blocks);
  openvdb::tools::prune(space.empty);
  report(progress, 100);
  return space;
}

SeenSpace carveByTraversal(const VoxelFrame& frame, const std::vector<DepthView>& views,
                           const CarveSettings& settings) {
  MaskTree filled, empty;
  openvdb::tree::ValueAccessor<MaskTree> filled_voxels(filled), empty_voxels(empty);
  for (size_t n = 0; n < views.size(); ++n) {
    const Rays rays(frame, views[n], n);
    const std::vector<float> depth = rayDepth(views[n], rays, settings);
    for (int j = 0; j < rays.camera.height; ++j) {
      for (int i = 0; i < rays.camera.width; ++i) {
        const float d = depth[size_t(j) * rays.camera.width + i];
        if (!(d > 0.f)) continue;
        const Coord hit = traverse(rays, i, j, double(d), [&](const Coord& ijk) {
          if (frame.bounds.isInside(ijk)) empty_voxels.setValueOn(ijk);
          return true;
        });
        if (frame.bounds.isInside(hit)) filled_voxels.setValueOn(hit);
      }
    }
  }
  empty.topologyDifference(filled);
  SeenSpace space;
  space.box = frame.bounds;
  space.filled.root() = tokenMask({&filled}).root();
  space.empty.root() = tokenMask({&empty}).root();
  openvdb::tools::prune(space.empty);
  return space;
}

}  // namespace vdbc
