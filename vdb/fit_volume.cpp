#include "vdb/fit_volume.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr int kCoarseVoxels = 1 << (kTokenLevels - 1);
constexpr int kSamplesPerView = 20000;  // pixels looked at; thousands would do
constexpr double kTrim = 0.005;         // outliers at each side of each axis

/// What one view contributes: points and normals of walls, world frame.
struct ViewSamples {
  std::vector<Vector3d> points, wall_normals;
};

ViewSamples sampleView(const DepthView& view, const Vector3d& up, const CarveSettings& carving) {
  const Camera& camera = view.camera;
  const std::vector<float> depth = usableDepth(view, carving);
  const int w = camera.width, h = camera.height;
  const int stride = std::max(1, int(std::sqrt(double(w) * h / kSamplesPerView)));
  // Normals come from differences over a patch: neighbouring pixels of a depth sensor are noise.
  const int patch = std::max(1, w / 48);
  constexpr double kMaxSlope = 0.1;  // depth change over the patch; more is a jump, not a wall
  constexpr double kMaxTilt = 0.3;   // sine of a wall's inclination

  ViewSamples samples;
  for (int y = stride / 2; y < h; y += stride)
    for (int x = stride / 2; x < w; x += stride) {
      const auto at = [&](int i, int j) {
        return double(depth[size_t(j) * size_t(w) + size_t(i)]);
      };
      const double z = at(x, y);
      if (!(z > 0)) continue;
      const Vector3d p = camera.unproject(x + 0.5, y + 0.5, z);
      samples.points.push_back(p);
      if (x + patch >= w || y + patch >= h) continue;
      const double zx = at(x + patch, y), zy = at(x, y + patch);
      if (!(zx > 0) || !(zy > 0) || std::abs(zx - z) > kMaxSlope * z ||
          std::abs(zy - z) > kMaxSlope * z)
        continue;
      const Vector3d normal = (camera.unproject(x + patch + 0.5, y + 0.5, zx) - p)
                                  .cross(camera.unproject(x + 0.5, y + patch + 0.5, zy) - p);
      if (std::abs(normal.dot(up)) < kMaxTilt * normal.norm())
        samples.wall_normals.push_back(normal.normalized());
    }
  return samples;
}

/// Angle (radians, within 45 degrees) from the first horizontal axis to the strongest direction of
/// the walls modulo 90 degrees; 0 where no direction stands out. Columns of `axes`: horizontal,
/// horizontal, up.
double wallYaw(const std::vector<ViewSamples>& samples, const Matrix3d& axes) {
  constexpr int kBins = 90;           // one degree each
  constexpr double kWindow = 5.5;     // degrees at both sides that belong to the peak
  constexpr double kMinShare = 0.25;  // of all normals; chance alone gives 11 / 90 = 0.12
  constexpr double kDegree = M_PI / 180;
  std::vector<double> angles;  // degrees, [0, 90)
  std::array<double, kBins> histogram{};
  for (const ViewSamples& view : samples)
    for (const Vector3d& n : view.wall_normals) {
      double angle = std::atan2(n.dot(axes.col(1)), n.dot(axes.col(0))) / kDegree;
      angle -= 90 * std::floor(angle / 90);
      if (angle >= 90) angle = 0;
      angles.push_back(angle);
      histogram[size_t(angle)] += 1;
    }
  if (angles.empty()) return 0;

  int peak = 0;
  double best = -1;
  for (int bin = 0; bin < kBins; ++bin) {
    double sum = 0;  // smoothed: a wall's normals spread over a few bins
    for (int d = -4; d <= 4; ++d)
      sum += std::exp(-d * d / 4.5) * histogram[size_t((bin + d + kBins) % kBins)];
    if (sum > best) best = sum, peak = bin;
  }
  // The mean of what is near, first widely, then closely: furniture a few degrees off must not
  // pull.
  double centre = peak + 0.5;
  for (double window : {kWindow, kWindow / 2}) {
    double offset_sum = 0;
    int64_t inside = 0;
    for (double angle : angles) {
      const double offset = std::remainder(angle - centre, 90);
      if (std::abs(offset) > window) continue;
      offset_sum += offset;
      ++inside;
    }
    if (window == kWindow && double(inside) < kMinShare * double(angles.size())) return 0;
    if (inside > 0) centre += offset_sum / double(inside);
  }
  return std::remainder(centre, 90) * kDegree;
}

/// Rotation whose columns are the grid's axes: z up, x the world's x (or y, where x is up) made
/// horizontal. The identity for up = +z.
Matrix3d uprightAxes(const Vector3d& up) {
  const Vector3d forward = std::abs(up.x()) < 0.9 ? Vector3d::UnitX() : Vector3d::UnitY();
  Matrix3d axes;
  axes.col(2) = up;
  axes.col(0) = (forward - up * up.dot(forward)).normalized();
  axes.col(1) = up.cross(axes.col(0));
  return axes;
}

/// The box (metres, grid frame) of all points but the outliers.
Eigen::AlignedBox3d trimmedBox(const std::vector<ViewSamples>& samples, const Matrix3d& axes) {
  Eigen::AlignedBox3d box(Vector3d::Zero(), Vector3d::Zero());
  std::vector<double> values;
  for (int axis = 0; axis < 3; ++axis) {
    values.clear();
    for (const ViewSamples& view : samples)
      for (const Vector3d& p : view.points) values.push_back(axes.col(axis).dot(p));
    const auto cut = std::ptrdiff_t(kTrim * double(values.size()));
    std::nth_element(values.begin(), values.begin() + cut, values.end());
    box.min()[axis] = values[size_t(cut)];
    std::nth_element(values.begin(), values.end() - 1 - cut, values.end());
    box.max()[axis] = *(values.end() - 1 - cut);
  }
  return box;
}

/// Voxels from 0 on, whole coarse nodes, that reach over `size` metres.
CoordBBox voxelBounds(const Vector3d& size, double voxel_m) {
  // A box that ends on a voxel's face ends there: the division must not add a node.
  constexpr double kSlack = 1e-4;  // voxels
  CoordBBox bounds(Coord(0), Coord(0));
  for (int axis = 0; axis < 3; ++axis) {
    const double nodes = std::ceil((size[axis] / voxel_m - kSlack) / kCoarseVoxels);
    require(nodes * kCoarseVoxels <= kMaxVolumeSide, "fitVolume: the volume is too large (",
            size.x(), " x ", size.y(), " x ", size.z(), " m in voxels of ", voxel_m,
            " m, expected at most ", kMaxVolumeSide,
            " a side): take a larger voxel or give bounds");
    bounds.max()[axis] = std::max(int(nodes), 1) * kCoarseVoxels - 1;
  }
  return bounds;
}

}  // namespace

VoxelFrame fitVolume(const std::vector<DepthView>& views, const VolumeSettings& settings,
                     const CarveSettings& carving) {
  require(std::isfinite(settings.voxel_m) && settings.voxel_m > 0,
          "fitVolume: expected a positive voxel size, found ", settings.voxel_m, " m");
  require(settings.margin_m >= 0 && settings.vertical_margin_m >= 0 &&
              std::isfinite(settings.margin_m) && std::isfinite(settings.vertical_margin_m),
          "fitVolume: expected margins of 0 or more, found ", settings.margin_m, " and ",
          settings.vertical_margin_m, " m");
  require(settings.up.allFinite() && settings.up.norm() > 1e-6,
          "fitVolume: expected a direction for up, found ", settings.up.transpose());
  const Vector3d up = settings.up.normalized();

  std::vector<ViewSamples> samples(views.size());
  tbb::parallel_for(size_t(0), views.size(),
                    [&](size_t i) { samples[i] = sampleView(views[i], up, carving); });
  size_t points = 0;
  for (const ViewSamples& view : samples) points += view.points.size();
  require(points > 0, "fitVolume: none of ", views.size(), " views has a usable depth");

  VoxelFrame frame;
  frame.voxel_m = settings.voxel_m;
  Matrix3d axes = uprightAxes(up);
  Eigen::AlignedBox3d box;
  if (settings.bounds) {
    // The grid follows the user's box, not the walls: a turned one would be larger than was asked
    // for.
    require(!settings.bounds->isEmpty() && settings.bounds->min().allFinite() &&
                settings.bounds->max().allFinite(),
            "fitVolume: expected bounds as minimum and maximum corner, found ",
            settings.bounds->min().transpose(), " and ", settings.bounds->max().transpose());
    for (int corner = 0; corner < 8; ++corner)
      box.extend(axes.transpose() *
                 settings.bounds->corner(Eigen::AlignedBox3d::CornerType(corner)));
  } else {
    if (settings.align_walls)
      axes = Eigen::AngleAxisd(wallYaw(samples, axes), up).toRotationMatrix() * axes;
    box = trimmedBox(samples, axes);
    for (const DepthView& view : views)
      box.extend(axes.transpose() * view.camera.world_from_camera.translation());
    // A margin of whole voxels and a quarter: what bounds the place lies amid voxels and amid their
    // octants, not on faces, where rounding and noise would tear it in two.
    const Vector3d margin(settings.margin_m, settings.margin_m, settings.vertical_margin_m);
    const double voxel_m = double(settings.voxel_m);
    box.min() -= Vector3d((margin / voxel_m).array().ceil() + .25) * voxel_m;
    box.max() += margin;
  }
  frame.world_from_grid.linear() = axes;
  require(
      box.min().cwiseAbs().maxCoeff() < kMaxWorldM && box.max().cwiseAbs().maxCoeff() < kMaxWorldM,
      "fitVolume: the scene lies too far from the world's origin (expected coordinates below ",
      kMaxWorldM, " m, found ", box.min().transpose(), " to ", box.max().transpose(), " m)");
  frame.world_from_grid.translation() = axes * box.min();
  frame.bounds = voxelBounds(box.sizes(), double(settings.voxel_m));
  return frame;
}

}  // namespace vdbc
