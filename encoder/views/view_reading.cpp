#include "encoder/views/view_reading.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <set>

namespace vdbc {
namespace {

constexpr double kRigidTolerance = 5e-3;

}  // namespace

Eigen::Isometry3d rigid(const Eigen::Matrix4d& m, const std::string& path,
                        const std::string& what) {
  Eigen::Matrix3d r = m.topLeftCorner<3, 3>();
  require(m.allFinite(), kReadViews, ": ", path, ": ", what, " is not finite");
  const double skew = (r.transpose() * r - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff();
  require(skew <= kRigidTolerance, kReadViews, ": ", path, ": ", what,
          " is singular or not rigid (expected a rotation, found R^T R off identity by ", skew,
          ")");
  const double determinant = r.determinant();
  require(determinant > 0, kReadViews, ": ", path, ": ", what,
          " mirrors (expected determinant 1, found ", determinant, ")");
  const Eigen::RowVector4d last(0, 0, 0, 1);
  require((m.row(3) - last).cwiseAbs().maxCoeff() <= 1e-6, kReadViews, ": ", path, ": ", what,
          " is not affine (expected last row 0 0 0 1)");
  for (int i = 0; i < 4; ++i) r = 0.5 * (r + r.inverse().transpose()).eval();  // Newton, quadratic
  Eigen::Isometry3d result = Eigen::Isometry3d::Identity();
  result.linear() = r;
  result.translation() = m.topRightCorner<3, 1>();
  return result;
}

std::vector<float> depthFromPositions(const Image& positions, const Camera& camera) {
  std::vector<float> depth(size_t(camera.width) * size_t(camera.height), 0.f);
  const Eigen::Isometry3d camera_from_world = camera.world_from_camera.inverse();
  constexpr double kHalfPixel = 0.5 + 1e-3;  // float rounding of a position at the pixel's border
  for (int y = 0; y < camera.height; ++y) {
    for (int x = 0; x < camera.width; ++x) {
      const Eigen::Vector3d world(positions.at(x, y, 0), positions.at(x, y, 1),
                                  positions.at(x, y, 2));
      if (!world.allFinite()) continue;
      const Eigen::Vector3d p = camera_from_world * world;
      if (!(p.z() > 0 && p.z() < double(kFarDepth))) continue;
      const double u = camera.fx * p.x() / p.z() + camera.cx;
      const double v = camera.fy * p.y() / p.z() + camera.cy;
      if (std::abs(u - (x + 0.5)) > kHalfPixel || std::abs(v - (y + 0.5)) > kHalfPixel) continue;
      depth[size_t(y) * size_t(camera.width) + size_t(x)] = float(p.z());
    }
  }
  return depth;
}

void requireDepth(const View& view, const std::string& path) {
  const bool measured =
      std::any_of(view.depth.begin(), view.depth.end(), [](float z) { return z > 0; });
  require(measured, kReadViews, ": ", path, ": depth of ", view.name, " has no valid pixel");
}

std::vector<size_t> selectFrames(const ReadViewsSettings& settings, size_t count,
                                 const std::string& path) {
  require(count > 0, kReadViews, ": ", path, ": no frames");
  std::vector<size_t> selected;
  std::set<int> taken;
  for (int frame : settings.frames) {
    require(frame >= 0 && size_t(frame) < count, kReadViews, ": ", path, ": frame ", frame,
            " is out of range (expected 0 to ", count - 1, ")");
    require(taken.insert(frame).second, kReadViews, ": ", path, ": frame ", frame,
            " is named twice (expected different ones)");
    selected.push_back(size_t(frame));
  }
  if (selected.empty()) {
    for (size_t i = 0; i < count; ++i) selected.push_back(i);
  }
  return selected;
}

Image threeChannels(Image image) {
  if (image.channels == 3) return image;
  Image rgb(image.width, image.height, 3);
  for (size_t i = 0; i < image.data.size(); ++i) {
    for (size_t c = 0; c < 3; ++c) rgb.data[3 * i + c] = image.data[i];
  }
  return rgb;
}

}  // namespace vdbc
