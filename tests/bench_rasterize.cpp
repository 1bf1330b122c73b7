// rasterize/forward and rasterize/both: the scene of a furnished room, N Gaussians on its surfaces.
#include <benchmark/benchmark.h>

#include <cmath>
#include <random>
#include <string>

#include "splat/rasterize.h"

namespace vdbc {
namespace {

/// Gaussians uniform by area on the walls of a 5 x 5 x 2.7 m room with boxes in it: sigma 1.5-3 cm,
/// random rotation, opacity 0.5-0.99, SH degree 0.
Gaussians roomScene(int n) {
  struct Box {
    Eigen::Vector3d lo, hi;
  };
  const Box boxes[] = {{{0, 0, 0}, {5, 5, 2.7}},       {{0.2, 0.3, 0}, {2.2, 1.2, 0.8}},
                       {{3.5, 0.1, 0}, {4.9, 0.7, 2}}, {{2.2, 3.2, 0}, {3.6, 4.2, 0.75}},
                       {{0.1, 4, 0}, {1, 4.9, 1.6}},   {{4.2, 3, 0}, {4.9, 4.6, 0.5}}};
  std::mt19937 random(7);
  std::uniform_real_distribution<double> unit(0, 1);
  std::normal_distribution<float> normal;
  std::vector<double> areas;
  for (const Box& box : boxes) {
    const Eigen::Vector3d e = box.hi - box.lo;
    for (int axis = 0; axis < 3; ++axis)
      for (int side = 0; side < 2; ++side) areas.push_back(e[(axis + 1) % 3] * e[(axis + 2) % 3]);
  }
  std::discrete_distribution<int> face(areas.begin(), areas.end());
  Gaussians g;
  g.resize(n, 0);
  for (size_t i = 0; i < size_t(n); ++i) {
    const int f = face(random);
    const Box& box = boxes[f / 6];
    const int axis = f / 2 % 3;
    for (int j = 0; j < 3; ++j) {
      const double t = j == axis ? f % 2 : unit(random);
      g.mean[i][j] = float(box.lo[j] + t * (box.hi[j] - box.lo[j]));
      g.log_scale[i][j] = float(std::log(0.015 + 0.015 * unit(random)));
      g.sh[3 * i + size_t(j)] = float((unit(random) - 0.5) / double(kSh0));
    }
    for (int j = 0; j < 4; ++j) g.rotation[i][j] = normal(random);
    const double opacity = 0.5 + 0.49 * unit(random);
    g.opacity_logit[i] = float(std::log(opacity / (1 - opacity)));
  }
  return g;
}

/// 70 degrees wide, in a corner at eye height, looking across the room.
Camera roomCamera(int width, int height) {
  Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = camera.fy = 0.5 * width / std::tan(35 * M_PI / 180);
  camera.cx = 0.5 * width, camera.cy = 0.5 * height;
  const Eigen::Vector3d eye(2.6, 2, 1.5), forward = Eigen::Vector3d(-1, 1.6, -0.3).normalized();
  const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitZ()).normalized();
  camera.world_from_camera.linear() << right, forward.cross(right), forward;
  camera.world_from_camera.translation() = eye;
  return camera;
}

void forward(benchmark::State& state, int n, int width, int height) {
  const Gaussians g = roomScene(n);
  const Camera camera = roomCamera(width, height);
  for (auto _ : state)
    benchmark::DoNotOptimize(rasterize(g, camera, RasterSettings()).colour.data.data());
}

void both(benchmark::State& state, int n, int width, int height) {
  const Gaussians g = roomScene(n);
  const Camera camera = roomCamera(width, height);
  const Image d_colour(width, height, 3, 1.f / float(width * height));
  for (auto _ : state) {
    RasterStatePtr saved;
    benchmark::DoNotOptimize(rasterize(g, camera, RasterSettings(), &saved).colour.data.data());
    benchmark::DoNotOptimize(rasterizeBackward(g, camera, *saved, d_colour).mean.data());
  }
}

[[maybe_unused]] const bool kRegistered = [] {
  const int sizes[][2] = {{224, 224}, {640, 480}};
  for (const auto& [width, height] : sizes)
    for (int n : {20000, 100000, 300000, 650000}) {
      const std::string suffix =
          "/" + std::to_string(n) + "/" + std::to_string(width) + "x" + std::to_string(height);
      const int w = width, h = height;
      benchmark::RegisterBenchmark(("rasterize/forward" + suffix).c_str(), forward, n, w, h)
          ->Unit(benchmark::kMillisecond)
          ->UseRealTime();
      benchmark::RegisterBenchmark(("rasterize/both" + suffix).c_str(), both, n, w, h)
          ->Unit(benchmark::kMillisecond)
          ->UseRealTime();
    }
  return true;
}();

}  // namespace
}  // namespace vdbc
