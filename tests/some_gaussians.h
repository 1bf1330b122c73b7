#pragma once
// Gaussians for tests of files, and how they are seen.
#include <random>

#include "splat/gaussians.h"
#include "vdb/camera.h"

namespace vdbc {

/// Gaussians on the floor and a wall of a room, as trained ones lie, with random shapes.
inline Gaussians someGaussians(int64_t n, int degree, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> uniform(-1.f, 1.f);
  std::normal_distribution<float> normal;
  Gaussians g;
  g.resize(n, degree);
  for (size_t i = 0; i < size_t(n); ++i) {
    const float u = 2.5f * uniform(random), v = 2.5f * uniform(random);
    g.mean[i] = i % 2 ? Eigen::Vector3f(u, v, 0) : Eigen::Vector3f(u, 2.5f, v);
    for (int k = 0; k < 3; ++k) g.log_scale[i][k] = -4.f + uniform(random);
    for (int k = 0; k < 4; ++k) g.rotation[i][k] = normal(random);
    g.rotation[i].normalize();
    g.opacity_logit[i] = 4 * normal(random);
  }
  for (float& v : g.sh) v = 0.5f * normal(random);
  return g;
}

/// Many of them with a camera that sees them; quaternions are not normalised.
inline Gaussians visibleGaussians(int degree) {
  Gaussians g = someGaussians(20000, degree, 30);
  for (size_t i = 0; i < g.rotation.size(); ++i) g.rotation[i] *= float(1 + i % 3);
  for (float& v : g.sh) v *= 0.5f;
  // On an exact plane before the camera, only the order in the file would tell what is in front.
  std::mt19937 random(31);
  for (auto& mean : g.mean) mean.y() += 0.05f * float(random()) / float(random.max());
  return g;
}
inline Camera visibleGaussiansCamera() {
  Camera c;
  c.width = c.height = 160;
  c.fx = c.fy = 120, c.cx = c.cy = 80;
  c.world_from_camera.linear() << 1, 0, 0, 0, 0, 1, 0, -1, 0;  // looks along +y
  c.world_from_camera.translation() = Eigen::Vector3d(0, -2, 1);
  return c;
}

}  // namespace vdbc
