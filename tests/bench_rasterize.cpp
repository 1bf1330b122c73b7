// rasterize/forward and rasterize/both: the scene of a furnished room, N Gaussians on its surfaces.
// machine/fma and machine/triad: what two threads can do, measured in the same run, to compare with
// figures of other machines.
#include <benchmark/benchmark.h>
#include <malloc.h>
#include <tbb/global_control.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <chrono>
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

/// The order in which our .points.vdb files hold them: by leaf of 8^3 voxels, then by voxel; voxels
/// of about 8 Gaussians.
Gaussians inLeafOrder(const Gaussians& g) {
  constexpr double kArea = 120;  // m^2, all faces
  const double voxel = std::sqrt(8 * kArea / double(g.size()));
  std::vector<std::pair<uint64_t, size_t>> order;
  for (size_t i = 0; i < size_t(g.size()); ++i) {
    uint64_t leaf = 0, in_leaf = 0;
    for (int j = 0; j < 3; ++j) {
      const uint64_t at = uint64_t(double(g.mean[i][j]) / voxel + 1024);
      leaf = leaf << 16 | at >> 3, in_leaf = in_leaf << 3 | (at & 7);
    }
    order.emplace_back(leaf << 9 | in_leaf, i);
  }
  std::sort(order.begin(), order.end());
  Gaussians out;
  out.resize(g.size(), 0);
  for (size_t i = 0; i < order.size(); ++i) {
    const size_t from = order[i].second;
    out.mean[i] = g.mean[from], out.log_scale[i] = g.log_scale[from];
    out.rotation[i] = g.rotation[from], out.opacity_logit[i] = g.opacity_logit[from];
    for (size_t j = 0; j < 3; ++j) out.sh[3 * i + j] = g.sh[3 * from + j];
  }
  return out;
}

/// 70 degrees wide, in a corner at eye height, looking across the room: 151 k of 300 k Gaussians
/// are visible, with 52 pairs a pixel at 224 x 224.
Camera roomCamera(int width, int height) {
  Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = camera.fy = 0.5 * width / std::tan(35 * M_PI / 180);
  camera.cx = 0.5 * width, camera.cy = 0.5 * height;
  const Eigen::Vector3d eye(0.3, 0.18, 1.35), forward(0.67, 0.74, 0.07);
  camera.world_from_camera = lookAt(eye, eye + forward, Eigen::Vector3d::UnitZ());
  return camera;
}

// --- machine
// -------------------------------------------------------------------------------------

constexpr int kThreads = 2;  // as the figures to compare with

double seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

/// 2 * 16 * 12 floating-point operations a round, twelve independent chains. Each starts elsewhere
/// and not at the fixed point 1: of equal chains the compiler computes one, a constant one not at
/// all.
typedef float Vector __attribute__((vector_size(64)));
#if defined(__x86_64__)
#define VDBC_WIDE __attribute__((target("avx512f")))
#define VDBC_NARROW __attribute__((target("avx2,fma")))
bool wide() { return __builtin_cpu_supports("avx512f"); }
#else
#define VDBC_WIDE
#define VDBC_NARROW
bool wide() { return true; }
#endif
#define VDBC_FMA_CHAINS                                                                  \
  Vector v[12];                                                                          \
  _Pragma("GCC unroll 12") for (int k = 0; k < 12; ++k) v[k] = Vector{} + float(k + 2);  \
  for (int64_t i = 0; i < rounds; ++i)                                                   \
    _Pragma("GCC unroll 12") for (int k = 0; k < 12; ++k) v[k] = v[k] * 0.999f + 0.001f; \
  float sum = 0;                                                                         \
  _Pragma("GCC unroll 12") for (int k = 0; k < 12; ++k) sum += v[k][0];                  \
  return sum;
VDBC_WIDE float fmaWide(int64_t rounds){VDBC_FMA_CHAINS} VDBC_NARROW
    float fmaNarrow(int64_t rounds) {
  VDBC_FMA_CHAINS
}

/// A median, as the rows have.
template <typename Work>
double medianSeconds(Work work) {
  std::array<double, 11> times;
  for (double& time : times) {
    const double start = seconds();
    tbb::parallel_for(0, kThreads, work, tbb::static_partitioner());
    time = seconds() - start;
  }
  std::nth_element(times.begin(), times.begin() + times.size() / 2, times.end());
  return times[times.size() / 2];
}

struct Machine {
  double fma_gflops, triad_gbs;
};
/// Measured anew for each row: what neighbours take on a shared machine changes within seconds.
Machine measureMachine() {
  constexpr int64_t kRounds = 2000000, kCount = 1 << 24;
  const double fma_s = medianSeconds(
      [](int) { benchmark::DoNotOptimize(wide() ? fmaWide(kRounds) : fmaNarrow(kRounds)); });
  std::vector<float> a(kCount), b(kCount, 1.f), c(kCount, 2.f);
  const double triad_s = medianSeconds([&](int thread) {
    const int64_t end = kCount * (thread + 1) / kThreads;
    for (int64_t i = kCount * thread / kThreads; i < end; ++i)
      a[size_t(i)] = b[size_t(i)] + 3.f * c[size_t(i)];
    benchmark::ClobberMemory();
  });
  return {kThreads * 2. * 16 * 12 * double(kRounds) / fma_s / 1e9,
          3. * 4 * double(kCount) / triad_s / 1e9};
}

void machineRate(benchmark::State& state, double Machine::*rate, const char* unit) {
  Machine machine;
  for (auto _ : state) machine = measureMachine();
  state.counters[unit] = machine.*rate;
}

// --- rows
// ----------------------------------------------------------------------------------------

/// The probe of docs/notes/performance.md: ms on two cores with 332 GFLOP/s and 22 GB/s; 0 where it
/// has no figure.
struct Row {
  int n, width, height;
  double probe_forward, probe_both;
};
constexpr double kProbeGflops = 332, kProbeGbs = 22;
constexpr Row kRows[] = {{20000, 224, 224, 1.15, 2.4},   {100000, 224, 224, 4.0, 9.0},
                         {300000, 224, 224, 10.8, 18.7}, {650000, 224, 224, 21.1, 39.7},
                         {20000, 640, 480, 0, 0},        {100000, 640, 480, 9.1, 21.3},
                         {300000, 640, 480, 18.9, 45.5}, {650000, 640, 480, 0, 0}};

/// Bytes that must move and floating-point operations, from the counts: what each loop reads,
/// writes and computes for one item; caches are not counted on.
struct Cost {
  double bytes, flops;
};
Cost costOf(const RasterWork& w, const Row& row, bool both) {
  const double n = row.n, visible = double(w.visible), instances = double(w.instances),
               blocks = double(w.blocks), pixels = double(row.width) * row.height;
  Cost c;
  // Cull; project; bin; sort; block masks; blend.
  c.bytes =
      24 * n + (32 + 80) * visible + 8 * instances + 12 * instances + 66 * instances + 20 * pixels;
  c.flops = 60 * n + 330 * visible + 230 * instances + 16 * 36 * blocks;
  if (!both) return c;
  // Replay and row sums; gather and the chain rule; gradients.
  c.bytes += 20 * pixels * 2 + 64 * instances + 2 * (64 + 4) * instances + 56 * visible + 56 * n;
  c.flops += 16 * 70 * blocks + 16 * instances + 330 * visible + 400 * visible;
  return c;
}

void runRow(benchmark::State& state, const Row& row, bool both, bool everything) {
  tbb::global_control limit(tbb::global_control::max_allowed_parallelism, kThreads);
  const Gaussians g = inLeafOrder(roomScene(row.n));
  const Camera camera = roomCamera(row.width, row.height);
  const float scale = 1.f / float(row.width * row.height);
  const Image d_colour(row.width, row.height, 3, scale), d_one(row.width, row.height, 1, scale),
      d_channels(row.width, row.height, 4, scale);
  const std::vector<float> channels(size_t(row.n) * 4, 0.5f);
  RasterSettings settings;
  BackwardExtras extras;
  if (everything) {
    settings.median_depth = settings.antialias = true;
    extras.extra = {4, channels.data()};
    extras.d_channels = &d_channels, extras.d_median_depth = &d_one, extras.camera = true;
  }
  std::vector<double> times;
  for (auto _ : state) {
    const double start = seconds();
    {
      RasterStatePtr saved;
      benchmark::DoNotOptimize(
          rasterize(g, camera, settings, both ? &saved : nullptr, extras.extra).colour.data.data());
      if (both)
        benchmark::DoNotOptimize(rasterizeBackward(g, camera, *saved, d_colour,
                                                   everything ? &d_one : nullptr,
                                                   everything ? &d_one : nullptr, extras)
                                     .mean.data());
    }
    times.push_back(seconds() - start);
  }
  std::sort(times.begin(), times.end());
  const double ms = 1e3 * times[times.size() / 2];
  RasterStatePtr saved;
  rasterize(g, camera, settings, &saved);
  const RasterWork work = workOf(*saved);
  const auto rounded = [](double x) { return std::round(x * 1000) / 1000; };
  state.counters["median_ms"] = rounded(ms);
  state.counters["min_ms"] = rounded(1e3 * times.front());
  state.counters["visible"] = double(work.visible);
  state.counters["instances"] = double(work.instances);
  state.counters["blocks"] = double(work.blocks);
  state.counters["pairs_per_pixel"] = rounded(double(work.pairs) / (row.width * row.height));
  if (everything) return;
  const Machine machine = measureMachine();
  const Cost cost = costOf(work, row, both);
  const double floor_ms =
      std::max(cost.bytes / machine.triad_gbs, cost.flops / machine.fma_gflops) / 1e6;
  state.counters["MB"] = rounded(cost.bytes / 1e6);
  state.counters["MFLOP"] = rounded(cost.flops / 1e6);
  state.counters["share_of_floor"] = rounded(floor_ms / ms);
  const double probe = both ? row.probe_both : row.probe_forward;
  if (probe == 0) return;
  // The gate: not slower than the probe scaled by whichever rate leaves it the shorter time.
  const double by_fma = probe * kProbeGflops / machine.fma_gflops,
               by_triad = probe * kProbeGbs / machine.triad_gbs,
               ratio = ms / std::min(by_fma, by_triad);
  state.counters["probe_by_fma_ms"] = rounded(by_fma);
  state.counters["probe_by_triad_ms"] = rounded(by_triad);
  state.counters["ratio"] = rounded(ratio);
  state.SetLabel(ratio <= 1 ? "gate met" : "gate MISSED");
}

[[maybe_unused]] const bool kRegistered = [] {
  mallopt(M_MMAP_THRESHOLD, 1 << 30);  // as the program does: freed pages are kept
  mallopt(M_TRIM_THRESHOLD, 1 << 30);
  benchmark::RegisterBenchmark("machine/fma", machineRate, &Machine::fma_gflops, "GFLOP/s")
      ->Iterations(1);
  benchmark::RegisterBenchmark("machine/triad", machineRate, &Machine::triad_gbs, "GB/s")
      ->Iterations(1);
  const auto add = [](const char* name, const Row& row, bool both, bool everything) {
    const std::string full = std::string("rasterize/") + name + "/" + std::to_string(row.n) + "/" +
                             std::to_string(row.width) + "x" + std::to_string(row.height);
    benchmark::RegisterBenchmark(full.c_str(), runRow, row, both, everything)
        ->Unit(benchmark::kMillisecond)
        ->UseRealTime();
  };
  for (const Row& row : kRows) {
    add("forward", row, false, false);
    add("both", row, true, false);
  }
  add("everything", kRows[2], true, true);  // four channels, all outputs, all gradients
  return true;
}();

}  // namespace
}  // namespace vdbc
