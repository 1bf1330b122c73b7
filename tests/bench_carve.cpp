// Carving and fusion: voxel-driven against openvdb::math::DDA along every ray, single-threaded
// both; compare the ratios of one run (docs/performance.md). The carved sets must be equal.
#include <benchmark/benchmark.h>
#include <openvdb/math/DDA.h>
#include <openvdb/math/Ray.h>
#include <tbb/global_control.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <string>

#include "encoder/views/read_views.h"
#include "splat/view.h"
#include "vdb/carve.h"
#include "vdb/fuse.h"

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

// The views' depths, and the box of what they measured.
struct Measured {
  std::vector<DepthView> views;
  std::vector<std::vector<float>> depths;  // usable ones; 0 elsewhere
  VoxelFrame frame;
  int64_t rays = 0;

  explicit Measured(float voxel_m) {
    Eigen::AlignedBox3d seen;
    for (const View& view : benchViews()) {
      views.push_back(view.depthView());
      depths.push_back(usableDepth(views.back(), CarveSettings()));
      const Camera& c = view.camera;
      for (int p = 0; p < c.width * c.height; ++p) {
        const float depth = depths.back()[size_t(p)];
        if (depth == 0) continue;
        seen.extend(c.unproject(p % c.width + 0.5, p / c.width + 0.5, depth));
        ++rays;
      }
    }
    frame.voxel_m = voxel_m;
    const auto corner = [&](const Eigen::Vector3d& p) {
      return Coord::floor(openvdb::Vec3d(p.x(), p.y(), p.z()) / double(voxel_m));
    };
    frame.bounds = CoordBBox(corner(seen.min()), corner(seen.max()));
  }
};

template <typename Carve>
void runCarving(benchmark::State& state, float voxel_m, const Carve& carve_views) {
  const Measured m(voxel_m);
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  double filled = 0, empty = 0;
  for (auto _ : state) {
    const SeenSpace space = carve_views(m.frame, m.views, CarveSettings());
    filled = double(space.filled.activeVoxelCount());
    empty = double(space.empty.activeVoxelCount());
  }
  state.SetItemsProcessed(state.iterations() * m.rays);
  state.counters["F"] = filled;
  state.counters["E"] = empty;
}

SeenSpace voxelDriven(const VoxelFrame& frame, const std::vector<DepthView>& views,
                      const CarveSettings& settings) {
  Progress progress;
  return carve(frame, views, settings, progress);
}

void carveVoxelDriven(benchmark::State& state, float voxel_m) {
  runCarving(state, voxel_m, voxelDriven);
}
void carveTraversal(benchmark::State& state, float voxel_m) {
  runCarving(state, voxel_m, carveByTraversal);
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

// --- fusion
// ---------------------------------------------------------------------------------------

constexpr float kCoarseM = .1f, kDetailM = .025f;

// How tools without our tree do it: each ray runs from its camera (with `whole`) or from a band
// before its depth to a band behind it, and every voxel on it keeps a running mean of distances.
FloatGrid::Ptr fuseByTraversal(const Measured& m, bool whole) {
  const double band = kDetailBand * double(kDetailM);
  auto distance = FloatGrid::create(float(band)), weight = FloatGrid::create(0);
  auto d = distance->getUnsafeAccessor(), w = weight->getUnsafeAccessor();
  for (size_t v = 0; v < m.views.size(); ++v) {
    const Camera& c = m.views[v].camera;
    const Eigen::Vector3d eye = c.world_from_camera.translation();
    for (int p = 0; p < c.width * c.height; ++p) {
      const double z = double(m.depths[v][size_t(p)]);
      if (z == 0) continue;
      const Eigen::Vector3d along = c.unproject(p % c.width + .5, p / c.width + .5, z) - eye;
      const double length = along.norm();
      const Eigen::Vector3d step = along / length;
      const openvdb::math::Ray<double> ray(
          openvdb::Vec3d(eye.x(), eye.y(), eye.z()) / double(kDetailM),
          openvdb::Vec3d(step.x(), step.y(), step.z()),
          whole ? 0 : std::max(0., length - band) / double(kDetailM),
          (length + band) / double(kDetailM));
      openvdb::math::DDA<openvdb::math::Ray<double>> dda(ray);
      do {
        const Coord ijk = dda.voxel();
        const Eigen::Vector3d at(ijk.x() + .5, ijk.y() + .5, ijk.z() + .5);
        const double off = length - (at * double(kDetailM) - eye).dot(step);
        if (off < -band) continue;
        const float before = w.getValue(ijk);
        d.setValueOn(ijk, (d.getValue(ijk) * before + float(std::min(off, band))) / (before + 1));
        w.setValueOn(ijk, before + 1);
      } while (dda.step());
    }
  }
  return distance;
}

template <typename Fuse>
void runFusion(benchmark::State& state, const Fuse& fuse) {
  const Measured m(kCoarseM);
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  double voxels = 0;
  for (auto _ : state) voxels = double(fuse(m)->activeVoxelCount());
  state.SetItemsProcessed(state.iterations() * m.rays);
  state.counters["voxels"] = voxels;
}

// With the carving that it follows in the program.
void fuseVoxelDriven(benchmark::State& state) {
  runFusion(state, [](const Measured& m) {
    FuseSettings settings;
    settings.voxel_m = kDetailM;
    return fuseDepth(m.frame, voxelDriven(m.frame, m.views, settings.carving), m.views, settings);
  });
}
void fuseTraversal(benchmark::State& state, bool whole) {
  runFusion(state, [whole](const Measured& m) { return fuseByTraversal(m, whole); });
}

BENCHMARK(fuseVoxelDriven)->Name("fuse/voxel_driven/2.5cm")->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(fuseTraversal, band, false)
    ->Name("fuse/traversal_of_the_band/2.5cm")
    ->Unit(benchmark::kMillisecond)
    ->Iterations(1);
BENCHMARK_CAPTURE(fuseTraversal, whole, true)
    ->Name("fuse/traversal_of_the_ray/2.5cm")
    ->Unit(benchmark::kMillisecond)
    ->Iterations(1);

}  // namespace
}  // namespace vdbc
