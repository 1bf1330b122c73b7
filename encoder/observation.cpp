#include "encoder/observation.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace vdbc {
namespace {

// One valid pixel, in grid terms.
struct PixelPoint {
  int32_t voxel;  // row in the token grid
  int32_t patch;
  Eigen::Vector3f index;   // position in voxels
  Eigen::Vector3f colour;  // display sRGB
  Eigen::Vector3f normal;  // grid axes, towards the camera; zero where unknown
};

PatchLattice latticeOf(const View& view, int patches_across, int first) {
  const int rows = std::max(
      1, int(std::lround(double(patches_across) * view.camera.height / view.camera.width)));
  return {patches_across, rows, first};
}

// Points of the pixels of one view with a usable depth that lie in the bounds, in pixel order.
std::vector<PixelPoint> pixelPoints(const View& view, const std::vector<float>& depth,
                                    const PatchLattice& lattice, const Observation& o) {
  const Camera& c = view.camera;
  const Eigen::Isometry3d grid_from_camera =
      o.frame.world_from_grid.inverse() * c.world_from_camera;
  auto point = [&](int x, int y) {
    const double z = depth[size_t(y) * size_t(c.width) + size_t(x)];
    return Eigen::Vector3d(grid_from_camera * Eigen::Vector3d((x + .5 - c.cx) / c.fx * z,
                                                              (y + .5 - c.cy) / c.fy * z, z));
  };
  auto valid = [&](int x, int y) {
    return x >= 0 && y >= 0 && x < c.width && y < c.height &&
           depth[size_t(y) * size_t(c.width) + size_t(x)] > 0;
  };
  // Step of the normal's difference: about 1/100 of the width, so that sensor noise averages out.
  const int step = std::max(1, c.width / 100);
  std::vector<PixelPoint> points;
  points.reserve(depth.size());
  for (int y = 0; y < c.height; ++y)
    for (int x = 0; x < c.width; ++x) {
      if (!valid(x, y)) continue;
      // The same arithmetic as carve(): the voxel of the world point.
      const Eigen::Vector3d world =
          c.unproject(x + .5, y + .5, depth[size_t(y) * size_t(c.width) + size_t(x)]);
      const Eigen::Vector3d index = o.frame.toIndex(world);
      const Coord ijk(int(std::floor(index.x())), int(std::floor(index.y())),
                      int(std::floor(index.z())));
      const int32_t row = o.tokens.row(0, ijk);
      if (row < 0) continue;
      Eigen::Vector3f normal = Eigen::Vector3f::Zero();
      const int sx = valid(x + step, y) ? step : -step, sy = valid(x, y + step) ? step : -step;
      if (valid(x + sx, y) && valid(x, y + sy)) {
        const Eigen::Vector3d p = point(x, y);
        Eigen::Vector3d n = (point(x + sx, y) - p).cross(point(x, y + sy) - p);
        if (n.norm() > 1e-12) {
          n.normalize();
          if (n.dot(p - grid_from_camera.translation()) > 0) n = -n;
          normal = n.cast<float>();
        }
      }
      const int px = std::min(lattice.columns - 1, x * lattice.columns / c.width);
      const int py = std::min(lattice.rows - 1, y * lattice.rows / c.height);
      points.push_back({row,
                        lattice.first + py * lattice.columns + px,
                        index.cast<float>(),
                        {view.colour.at(x, y, 0), view.colour.at(x, y, 1), view.colour.at(x, y, 2)},
                        normal});
    }
  return points;
}

void poolVoxelFeatures(const std::vector<std::vector<PixelPoint>>& points, Observation* o) {
  const size_t n = size_t(o->tokens.size(0));
  o->voxel_features.assign(n * kVoxelFeatures, 0.f);
  std::vector<float> pixels(n, 0.f);
  for (const auto& view : points)
    for (const PixelPoint& p : view) {
      float* f = &o->voxel_features[size_t(p.voxel) * kVoxelFeatures];
      const Eigen::Vector3f place = p.index - p.index.array().floor().matrix();
      const int octant = (place.x() >= .5f) << 2 | (place.y() >= .5f) << 1 | int(place.z() >= .5f);
      for (int c = 0; c < 3; ++c) f[kOctantColours + 4 * octant + c] += p.colour[c];
      f[kOctantColours + 4 * octant + 3] += 1;
      for (int c = 0; c < 3; ++c) f[kMeanColour + c] += p.colour[c];
      for (int c = 0; c < 3; ++c) f[kMeanPlace + c] += place[c] - .5f;
      for (int c = 0; c < 3; ++c) f[kMeanNormal + c] += p.normal[c];
      pixels[size_t(p.voxel)] += 1;
    }
  for (size_t v = 0; v < n; ++v) {
    float* f = &o->voxel_features[v * kVoxelFeatures];
    const float total = std::max(1.f, pixels[v]);
    for (int octant = 0; octant < 8; ++octant) {
      const float share = f[kOctantColours + 4 * octant + 3];
      for (int c = 0; c < 3; ++c) f[kOctantColours + 4 * octant + c] /= std::max(1.f, share);
      f[kOctantColours + 4 * octant + 3] = share / total;
    }
    for (int c = 0; c < 3; ++c) f[kMeanColour + c] /= total;
    f[kPixelCount] = std::log1p(pixels[v]) / 8;
    for (int c = kMeanPlace; c < kVoxelFeatures; ++c) f[c] /= total;
  }
}

// Sorted (token, patch) pairs become compressed sparse rows.
void countPatches(const std::vector<std::vector<PixelPoint>>& points, int level, Observation* o) {
  auto tokenOf = [&](int32_t row) {
    for (int l = 0; l < level; ++l) row = o->tokens.parents(l)[size_t(row)];
    return row;
  };
  std::vector<uint64_t> pairs;
  for (const auto& view : points)
    for (const PixelPoint& p : view)
      pairs.push_back(uint64_t(tokenOf(p.voxel)) << 32 | uint64_t(p.patch));
  std::sort(pairs.begin(), pairs.end());
  o->row_begin.assign(size_t(o->tokens.size(level)) + 1, 0);
  for (size_t i = 0; i < pairs.size();) {
    size_t end = i;
    while (end < pairs.size() && pairs[end] == pairs[i]) ++end;
    o->patch.push_back(int32_t(pairs[i] & 0xffffffff));
    o->count.push_back(float(end - i));
    ++o->row_begin[size_t(pairs[i] >> 32) + 1];
    i = end;
  }
  for (size_t v = 1; v < o->row_begin.size(); ++v) o->row_begin[v] += o->row_begin[v - 1];
}

void meanPatchPoints(const std::vector<View>& views,
                     const std::vector<std::vector<PixelPoint>>& points, Observation* o) {
  o->patch_points.assign(size_t(o->patches) * 4, 0.f);
  for (const auto& view : points)
    for (const PixelPoint& p : view) {
      float* f = &o->patch_points[size_t(p.patch) * 4];
      for (int c = 0; c < 3; ++c) f[c] += p.index[c] * o->frame.voxel_m;
      f[3] += 1;
    }
  for (size_t i = 0; i < views.size(); ++i) {
    const PatchLattice& l = o->lattices[i];
    const float pixels =
        float(views[i].camera.width) * float(views[i].camera.height) / float(l.columns * l.rows);
    for (int p = l.first; p < l.first + l.columns * l.rows; ++p) {
      float* f = &o->patch_points[size_t(p) * 4];
      for (int c = 0; c < 3; ++c) f[c] /= std::max(1.f, f[3]);
      f[3] /= pixels;
    }
  }
}

// Voxels that lie within `radius_m` of a camera as a whole become seen empty, unless they are
// filled.
void openLenses(const std::vector<View>& views, const VoxelFrame& frame, float radius_m,
                SeenSpace* seen) {
  const double radius = double(radius_m) / double(frame.voxel_m);
  for (const View& v : views) {
    const Eigen::Vector3d lens = frame.toIndex(v.camera.world_from_camera.translation());
    CoordBBox ball;
    for (int axis = 0; axis < 3; ++axis) {
      // A camera far outside of the volume must not leave the range of coordinates.
      const auto inside = [&](double c) {
        return int(
            std::clamp(c, double(seen->box.min()[axis]) - 1, double(seen->box.max()[axis]) + 1));
      };
      ball.min()[axis] = inside(std::floor(lens[axis] - radius));
      ball.max()[axis] = inside(std::floor(lens[axis] + radius));
    }
    ball.intersect(seen->box);
    for (const Coord& ijk : ball) {
      const Eigen::Vector3d middle(ijk.x() + .5, ijk.y() + .5, ijk.z() + .5);
      const Eigen::Vector3d corner = (middle - lens).cwiseAbs().array() + .5;
      if (corner.norm() <= radius && !seen->filled.isValueOn(ijk)) seen->empty.setValueOn(ijk);
    }
  }
  seen->empty.prune();
}

}  // namespace

Observation observe(const std::vector<View>& views, const ObserveSettings& settings,
                    Progress& progress) {
  // Which depth is usable is decided once; what follows takes it as it is.
  std::vector<std::vector<float>> depth(views.size());
  std::vector<DepthView> usable(views.size());
  tbb::parallel_for(size_t(0), views.size(), [&](size_t i) {
    depth[i] = usableDepth(views[i].depthView(), settings.carving);
    usable[i] = {views[i].camera, depth[i].data()};
  });
  constexpr CarveSettings kAsItIs{std::numeric_limits<float>::infinity(), 0};
  Observation o;
  o.frame = settings.frame ? *settings.frame : fitVolume(usable, settings.volume, kAsItIs);
  const auto seen = std::make_shared<SeenSpace>(carve(o.frame, usable, kAsItIs, progress));
  openLenses(views, o.frame, settings.lens_m, seen.get());
  o.seen = seen;
  o.tokens = TokenGrid(o.seen->filled);
  require(o.tokens.size(0) > 0,
          "observe: the views: no valid depth falls into the volume (expected at least one pixel)");
  for (const View& v : views) {
    o.lattices.push_back(latticeOf(v, settings.patches_across, o.patches));
    o.patches += o.lattices.back().columns * o.lattices.back().rows;
  }
  std::vector<std::vector<PixelPoint>> points(views.size());
  tbb::parallel_for(size_t(0), views.size(), [&](size_t i) {
    points[i] = pixelPoints(views[i], depth[i], o.lattices[i], o);
  });
  report(progress, -1);
  poolVoxelFeatures(points, &o);
  countPatches(points, settings.level, &o);
  meanPatchPoints(views, points, &o);
  return o;
}

std::vector<uint8_t> observedPixels(const View& view, const Observation& o, int level,
                                    const CarveSettings& carving) {
  const Camera& c = view.camera;
  const std::vector<float> depth = usableDepth(view.depthView(), carving);
  std::vector<uint8_t> observed(depth.size(), 0);
  tbb::parallel_for(0, c.height, [&](int y) {
    for (int x = 0; x < c.width; ++x) {
      const size_t i = size_t(y) * size_t(c.width) + size_t(x);
      if (depth[i] <= 0) continue;
      const Eigen::Vector3d p = o.frame.toIndex(c.unproject(x + .5, y + .5, depth[i]));
      const Coord ijk(int(std::floor(p.x())), int(std::floor(p.y())), int(std::floor(p.z())));
      observed[i] = o.tokens.row(level, tokenCoord(ijk, level)) >= 0;
    }
  });
  return observed;
}

}  // namespace vdbc
