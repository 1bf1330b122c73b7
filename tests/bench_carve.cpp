// Carving: voxel-driven against openvdb::math::DDA along every ray, single-threaded both; compare
// the ratios of one run (docs/notes/performance.md: 25x at 10 cm, 50x at 2.5 cm). The sets must be
// equal.
#include <benchmark/benchmark.h>
#include <tbb/global_control.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <string>

#include "encoder/views/read_views.h"
#include "splat/view.h"
#include "vdb/carve.h"

namespace vdbc {
namespace {

// A box room of 5 x 4 x 2.7 m with a box in it, from eight cameras; used where the frames are
// absent.
std::vector<View> syntheticViews() {
  std::vector<View> views(8);
  const Eigen::Vector3d low[] = {{0, 0, 0}, {1.5, 1.2, 0}}, high[] = {{5, 4, 2.7}, {2.8, 2, 0.9}};
  for (size_t n = 0; n < views.size(); ++n) {
    Camera& c = views[n].camera;
    c.width = 640, c.height = 480, c.fx = c.fy = 585, c.cx = 320, c.cy = 240;
    const double yaw = double(n) * M_PI / 4;
    const Eigen::Vector3d z = Eigen::Vector3d(std::cos(yaw), std::sin(yaw), -0.2).normalized();
    c.world_from_camera.linear() = lookAlong(z, Eigen::Vector3d::UnitZ());
    c.world_from_camera.translation() =
        Eigen::Vector3d(2.5, 2, 1.5) - 0.8 * Eigen::Vector3d(std::cos(yaw), std::sin(yaw), 0);
    views[n].depth.resize(size_t(c.width) * c.height);
    const Eigen::Vector3d eye = c.world_from_camera.translation();
    for (int p = 0; p < c.width * c.height; ++p) {
      const Eigen::Vector3d d = c.unproject(p % c.width + 0.5, p / c.width + 0.5, 1) - eye;
      double nearest = HUGE_VAL;
      for (int box = 0; box < 2; ++box) {
        double in = -HUGE_VAL, out = HUGE_VAL;
        for (int k = 0; k < 3; ++k) {
          const double a = (low[box][k] - eye[k]) / d[k], b = (high[box][k] - eye[k]) / d[k];
          in = std::max(in, std::min(a, b)), out = std::min(out, std::max(a, b));
        }
        const double t = in > 0 ? in : out;
        if (in <= out && t > 0) nearest = std::min(nearest, t);
      }
      views[n].depth[size_t(p)] = float(nearest);
    }
  }
  return views;
}

const std::vector<View>& benchViews() {
  static const std::vector<View> views = [] {
    const char* shared = std::getenv("VDBC_SHARED");
    const std::string folder =
        (shared ? std::string(shared) : VDBC_SOURCE_DIR "/../shared") + "/data/rgbd_redkitchen";
    return std::filesystem::exists(folder) ? readViews(folder) : syntheticViews();
  }();
  return views;
}

template <typename Carve>
void run(benchmark::State& state, float voxel_m, const Carve& carve_views) {
  const CarveSettings settings;
  std::vector<DepthView> views;
  Eigen::AlignedBox3d seen;
  int64_t rays = 0;
  for (const View& view : benchViews()) {
    views.push_back(view.depthView());
    const std::vector<float> depth = usableDepth(views.back(), settings);
    const Camera& c = view.camera;
    for (int p = 0; p < c.width * c.height; ++p) {
      if (depth[size_t(p)] == 0) continue;
      seen.extend(c.unproject(p % c.width + 0.5, p / c.width + 0.5, depth[size_t(p)]));
      ++rays;
    }
  }
  VoxelFrame frame;
  frame.voxel_m = voxel_m;
  const auto corner = [&](const Eigen::Vector3d& p) {
    return Coord::floor(openvdb::Vec3d(p.x(), p.y(), p.z()) / double(voxel_m));
  };
  frame.bounds = CoordBBox(corner(seen.min()), corner(seen.max()));

  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  double filled = 0, empty = 0;
  for (auto _ : state) {
    const SeenSpace space = carve_views(frame, views, settings);
    filled = double(space.filled.activeVoxelCount());
    empty = double(space.empty.activeVoxelCount());
  }
  state.SetItemsProcessed(state.iterations() * rays);  // rays
  state.counters["F"] = filled;
  state.counters["E"] = empty;
}

SeenSpace voxelDriven(const VoxelFrame& frame, const std::vector<DepthView>& views,
                      const CarveSettings& settings) {
  Progress progress;
  return carve(frame, views, settings, progress);
}

void carveVoxelDriven(benchmark::State& state, float voxel_m) { run(state, voxel_m, voxelDriven); }
void carveTraversal(benchmark::State& state, float voxel_m) {
  run(state, voxel_m, carveByTraversal);
}

BENCHMARK_CAPTURE(carveVoxelDriven, 10cm, 0.1f)
    ->Name("carve/voxel_driven/10cm")
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(carveVoxelDriven, 2.5cm, 0.025f)
    ->Name("carve/voxel_driven/2.5cm")
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(carveTraversal, 10cm, 0.1f)
    ->Name("carve/traversal/10cm")
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(carveTraversal, 2.5cm, 0.025f)
    ->Name("carve/traversal/2.5cm")
    ->Unit(benchmark::kMillisecond)
    ->Iterations(1);

}  // namespace
}  // namespace vdbc
