#pragma once
// Pinhole camera: OpenCV axes (x right, y down, z forward), camera-to-world, metres.
#include <Eigen/Geometry>
#include <cstdint>

namespace vdbc {

/// Pinhole camera without distortion. Pixel (i, j) covers [i, i+1] x [j, j+1]: centres at +0.5.
struct Camera {
  int width = 0, height = 0;  // pixels
  double fx = 0, fy = 0;      // focal lengths, pixels
  double cx = 0, cy = 0;      // principal point, pixels, corner-based (pixel centres at +0.5)
  /// Camera (x right, y down, z forward) to world, metres.
  Eigen::Isometry3d world_from_camera = Eigen::Isometry3d::Identity();

  /// World point -> (u, v, z): pixel position and planar depth (metres). z <= 0 is behind the
  /// camera; u and v are then meaningless.
  Eigen::Vector3d project(const Eigen::Vector3d& p_world) const {
    const Eigen::Vector3d p = world_from_camera.inverse() * p_world;
    return {fx * p.x() / p.z() + cx, fy * p.y() / p.z() + cy, p.z()};
  }
  /// The pixel that shows a projected point (project()): y * width + x; -1 where none does.
  int64_t pixelAt(const Eigen::Vector3d& uvz) const {
    if (!(uvz.z() > 0) || !(uvz.x() >= 0) || !(uvz.y() >= 0) || !(uvz.x() < width) ||
        !(uvz.y() < height))
      return -1;
    return int64_t(uvz.y()) * width + int64_t(uvz.x());
  }
  /// Pixel position and planar depth z (metres) -> world point.
  Eigen::Vector3d unproject(double u, double v, double z) const {
    return world_from_camera * Eigen::Vector3d((u - cx) / fx * z, (v - cy) / fy * z, z);
  }
};

/// Rotation of a camera that looks along the unit vector `forward`, level with `up`; where the two
/// are parallel, with any one side up.
inline Eigen::Matrix3d lookAlong(const Eigen::Vector3d& forward, const Eigen::Vector3d& up) {
  const Eigen::Vector3d side = forward.cross(up);
  const Eigen::Vector3d right =
      side.norm() > 1e-3 * up.norm() ? side.normalized() : forward.unitOrthogonal();
  Eigen::Matrix3d rotation;
  rotation << right, forward.cross(right), forward;
  return rotation;
}

/// Pose of a camera at `eye` that looks at `target`.
inline Eigen::Isometry3d lookAt(const Eigen::Vector3d& eye, const Eigen::Vector3d& target,
                                const Eigen::Vector3d& up) {
  Eigen::Isometry3d world_from_camera = Eigen::Isometry3d::Identity();
  world_from_camera.linear() = lookAlong((target - eye).normalized(), up);
  world_from_camera.translation() = eye;
  return world_from_camera;
}

/// The camera with places counted from `origin`, to a 2^20th of a metre: the same one for the same
/// place, wherever in the world it lies.
inline Camera cameraFrom(const Eigen::Vector3d& origin, Camera camera) {
  constexpr double kSteps = 1 << 20;
  const Eigen::Vector3d eye = (camera.world_from_camera.translation() - origin) * kSteps;
  camera.world_from_camera.translation() = eye.array().round() / kSteps;
  return camera;
}

/// The same camera for an image resized to width x height.
inline Camera resized(const Camera& camera, int width, int height) {
  Camera c = camera;
  const double sx = double(width) / camera.width, sy = double(height) / camera.height;
  c.width = width, c.height = height;
  c.fx *= sx, c.cx *= sx, c.fy *= sy, c.cy *= sy;
  return c;
}

}  // namespace vdbc
