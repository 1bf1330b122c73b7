#include "splat/rasterize.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>

#include "vdb/error.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace vdbc {
namespace {

constexpr int kTile = 16;         // pixels
constexpr int kLanes = 16;        // floats in a vector; pixels in a block of 4 x 4
constexpr int kChunk = 128;       // splats a tile holds at a time
constexpr int kRange = 4096;      // Gaussians projected by one task
constexpr float kOpaque = 1e-4f;  // a block whose transmittance is below is finished, as in 3DGS
constexpr float kLog2E = 1.44269504f, kLn2 = 0.693147181f;

/// Memory that is not cleared first.
template <typename T>
struct Buffer {
  T* data = nullptr;
  explicit Buffer(size_t count = 0) { reset(count); }
  ~Buffer() { ::operator delete(data, std::align_val_t(64)); }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  void reset(size_t count) {
    ::operator delete(data, std::align_val_t(64));
    data = nullptr;
    if (count) data = static_cast<T*>(::operator new(count * sizeof(T), std::align_val_t(64)));
  }
  T& operator[](size_t i) { return data[i]; }
  const T& operator[](size_t i) const { return data[i]; }
};

/// Camera and settings in the form the kernels take.
struct RasterView {
  float camera_from_world[9];        // row-major
  float eye[3], eye_rest[3];         // camera centre = eye + eye_rest, metres
  float fx, fy, cx, cy;              // pixels
  float x_min, x_max, y_min, y_max;  // where the Jacobian's x / z and y / z are clamped
  float near_m, low_pass, log2_min_alpha, max_alpha;
  float background[3];
  int width, height, tiles_x, tiles_y;
};

/// A Gaussian in the image: alpha = 2^(log2_opacity - (a dx^2 + b dx dy + c dy^2)).
struct Splat {
  float x, y;  // pixels
  float a, b, c;
  float log2_opacity, cut;  // cut: log2(opacity / min_alpha)
  float z;                  // metres
  float colour[3];
  float unused;
};

struct TileBox {
  uint16_t x0, y0, x1, y1;  // tiles, end exclusive
};

/// Sums over the pixels of one tile for one splat; h = dL/dalpha * alpha, d = pixel - mean.
struct alignas(64) GradientRow {
  float v[16];
};
// Columns as the transposing sum of blendTileBackward leaves them.
enum GradientColumn {
  kSumH = 0,
  kSumHx = 4,
  kSumHy = 1,
  kSumHxx = 5,
  kSumHxy = 2,
  kSumHyy = 6,
  kSumRed = 3,
  kSumGreen = 7,
  kSumBlue = 8,
  kSumZ = 12
};

/// The image under one tile by block: red, green, blue, alpha, depth.
struct alignas(64) TilePixels {
  float v[16][5][16];
};

struct GaussianArrays {
  const float *mean, *log_scale, *rotation, *opacity_logit, *sh;
  int sh_degree;
};

struct GradientArrays {
  float *mean, *log_scale, *rotation, *opacity_logit, *sh;
};

struct TileJob {
  const RasterView* view;
  const Splat* splats;
  const int32_t* list;  // slots, front to back
  int count;
  int x0, y0;  // pixels
  float *colour, *alpha, *depth;
};

struct TileBackwardJob {
  const RasterView* view;
  const Splat* splats;
  const TileBox* boxes;
  const uint32_t* first_row;
  const int32_t* list;
  const uint16_t* masks;
  const int32_t* stops;
  const TilePixels* saved;
  int count;
  int x0, y0;
  const float *d_colour, *d_alpha, *d_depth;  // the last two may be null
  GradientRow* rows;
};

struct RasterKernels {
  int (*projectRange)(const GaussianArrays&, const RasterView&, int64_t begin, int64_t end, Splat*,
                      TileBox*, int32_t* index);
  void (*projectRangeBackward)(const GaussianArrays&, const RasterView&, const int32_t* index,
                               int count, const TileBox*, const uint32_t* first_row,
                               const GradientRow*, const GradientArrays&);
  void (*blendTile)(const TileJob&, uint16_t* masks, int32_t* stops, TilePixels* saved);
  void (*blendTileBackward)(const TileBackwardJob&);
};

#pragma GCC diagnostic ignored "-Wpsabi"  // vectors are passed to inlined functions only

namespace baseline {
#include "splat/rasterize_kernels.inl"
}  // namespace baseline

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v3")
namespace avx2 {
#include "splat/rasterize_kernels.inl"
}  // namespace avx2
#pragma GCC pop_options

#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4")
namespace avx512 {
#include "splat/rasterize_kernels.inl"
}  // namespace avx512
#pragma GCC pop_options

const RasterKernels& kernels() {
  static const RasterKernels& chosen = __builtin_cpu_supports("x86-64-v4")   ? avx512::kKernels
                                       : __builtin_cpu_supports("x86-64-v3") ? avx2::kKernels
                                                                             : baseline::kKernels;
  return chosen;
}
#else
const RasterKernels& kernels() { return baseline::kKernels; }
#endif

RasterView viewOf(const Camera& camera, const RasterSettings& settings) {
  require(camera.width > 0 && camera.height > 0 && camera.width <= 32768 && camera.height <= 32768,
          "rasterize: expected an image of 1 to 32768 pixels a side, found ", camera.width, " x ",
          camera.height);
  const auto positive = [](double f) { return f > 0 && std::isfinite(f); };
  require(positive(camera.fx) && positive(camera.fy) && std::isfinite(camera.cx) &&
              std::isfinite(camera.cy) && camera.world_from_camera.matrix().allFinite(),
          "rasterize: expected a finite camera with positive focal lengths, found fx ", camera.fx,
          ", fy ", camera.fy, ", cx ", camera.cx, ", cy ", camera.cy);
  require(
      settings.min_alpha >= 1e-6f && settings.min_alpha < 1.f && settings.max_alpha > 0.f &&
          settings.max_alpha <= 0.999f && settings.low_pass >= 0.f &&
          std::isfinite(settings.low_pass) && settings.background.allFinite(),
      "rasterize: expected min_alpha in [1e-6, 1), max_alpha in (0, 0.999], low_pass >= 0 and a "
      "finite background, found ",
      settings.min_alpha, ", ", settings.max_alpha, ", ", settings.low_pass);
  RasterView v;
  const Eigen::Matrix3d world_from_camera = camera.world_from_camera.linear();
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) v.camera_from_world[3 * r + c] = float(world_from_camera(c, r));
  const Eigen::Vector3d eye = camera.world_from_camera.translation();
  for (int j = 0; j < 3; ++j) {
    v.eye[j] = float(eye[j]);
    v.eye_rest[j] = float(eye[j] - double(v.eye[j]));
  }
  v.fx = float(camera.fx), v.fy = float(camera.fy);
  v.cx = float(camera.cx), v.cy = float(camera.cy);
  // The linearisation is taken at most 30 % of half the image outside it, as in 3DGS (1.3 tan).
  const double margin_x = 0.15 * camera.width, margin_y = 0.15 * camera.height;
  v.x_min = float((-camera.cx - margin_x) / camera.fx);
  v.x_max = float((camera.width - camera.cx + margin_x) / camera.fx);
  v.y_min = float((-camera.cy - margin_y) / camera.fy);
  v.y_max = float((camera.height - camera.cy + margin_y) / camera.fy);
  v.near_m = std::max(settings.near_m, 1e-6f);
  v.low_pass = settings.low_pass;
  v.log2_min_alpha = std::log2(settings.min_alpha);
  v.max_alpha = settings.max_alpha;
  for (int j = 0; j < 3; ++j) v.background[j] = settings.background[j];
  v.width = camera.width, v.height = camera.height;
  v.tiles_x = (camera.width + kTile - 1) / kTile;
  v.tiles_y = (camera.height + kTile - 1) / kTile;
  return v;
}

GaussianArrays arraysOf(const Gaussians& g) {
  const size_t n = g.mean.size();
  if (n == 0) return {nullptr, nullptr, nullptr, nullptr, nullptr, g.sh_degree};
  return {g.mean[0].data(),       g.log_scale[0].data(), g.rotation[0].data(),
          g.opacity_logit.data(), g.sh.data(),           g.sh_degree};
}

/// Stable radix sort of the keys with their slots, 11 bits a pass, as many passes as the keys need.
void sortByKey(std::vector<uint32_t>* keys, std::vector<int32_t>* slots) {
  const size_t n = keys->size();
  if (n == 0) return;
  const auto [low, high] = std::minmax_element(keys->begin(), keys->end());
  const uint32_t base = *low, span = *high - *low;
  std::vector<uint32_t> keys2(n);
  std::vector<int32_t> slots2(n);
  for (int shift = 0; shift < 32 && (span >> shift) != 0; shift += 11) {
    std::array<uint32_t, 2048> at{};
    for (size_t i = 0; i < n; ++i) ++at[(((*keys)[i] - base) >> shift) & 2047];
    uint32_t sum = 0;
    for (uint32_t& a : at) sum += std::exchange(a, sum);
    for (size_t i = 0; i < n; ++i) {
      const uint32_t to = at[(((*keys)[i] - base) >> shift) & 2047]++;
      keys2[to] = (*keys)[i];
      slots2[to] = (*slots)[i];
    }
    keys->swap(keys2);
    slots->swap(slots2);
  }
}

}  // namespace

/// Visible Gaussians live in slots: range r of kRange Gaussians fills the slots from r * kRange on.
struct RasterState {
  RasterView view;
  int64_t gaussians = 0;
  int sh_degree = 0;
  std::vector<int> visible;          // per range
  Buffer<Splat> splats;              // per slot
  Buffer<TileBox> boxes;             // per slot
  Buffer<int32_t> index;             // per slot: which Gaussian
  Buffer<uint32_t> first_row;        // per slot: its first gradient row, one per tile it touches
  std::vector<uint32_t> tile_begin;  // [tiles + 1], into list
  Buffer<int32_t> list;              // slots by tile, front to back
  Buffer<uint16_t> masks;            // beside list: which 4 x 4 blocks of the tile it may touch
  Buffer<int32_t> stops;             // [tiles * 16] how many of the tile's list the block looked at
  Buffer<TilePixels> pixels;         // [tiles]
};

void RasterStateDeleter::operator()(RasterState* state) const { delete state; }

namespace {

/// Fills visible, splats, boxes, index, first_row.
void project(const GaussianArrays& g, int64_t n, RasterState* state) {
  const size_t ranges = size_t((n + kRange - 1) / kRange), slots = ranges * kRange;
  state->visible.assign(ranges, 0);
  state->splats.reset(slots);
  state->boxes.reset(slots);
  state->index.reset(slots);
  state->first_row.reset(slots);
  std::vector<uint64_t> rows(ranges + 1, 0);
  tbb::parallel_for(size_t(0), ranges, [&](size_t r) {
    const size_t slot = r * kRange;
    const int64_t begin = int64_t(slot), end = std::min(n, begin + kRange);
    const int count = kernels().projectRange(g, state->view, begin, end, &state->splats[slot],
                                             &state->boxes[slot], &state->index[slot]);
    state->visible[r] = count;
    uint64_t sum = 0;
    for (size_t s = slot; s < slot + size_t(count); ++s) {
      const TileBox& box = state->boxes[s];
      state->first_row[s] = uint32_t(sum);
      sum += uint64_t(box.x1 - box.x0) * uint64_t(box.y1 - box.y0);
    }
    rows[r + 1] = sum;
  });
  for (size_t r = 0; r < ranges; ++r) rows[r + 1] += rows[r];
  require(rows[ranges] < uint64_t(1) << 31,
          "rasterize: expected fewer than 2^31 splats in tiles, found ", rows[ranges]);
  for (size_t r = 1; r < ranges; ++r)
    for (size_t s = r * kRange; s < r * kRange + size_t(state->visible[r]); ++s)
      state->first_row[s] += uint32_t(rows[r]);
}

/// Fills tile_begin and list: one sort by depth of all that is visible, then a counting sort into
/// tiles, which keeps that order.
void bin(RasterState* state) {
  size_t total = 0;
  for (int count : state->visible) total += size_t(count);
  std::vector<uint32_t> keys(total);
  std::vector<int32_t> slots(total);
  size_t at = 0;
  for (size_t r = 0; r < state->visible.size(); ++r)
    for (size_t s = r * kRange; s < r * kRange + size_t(state->visible[r]); ++s, ++at) {
      std::memcpy(&keys[at], &state->splats[s].z, 4);  // positive floats sort as their bits
      slots[at] = int32_t(s);
    }
  sortByKey(&keys, &slots);

  // Runs of the sorted array are counted, then placed, in parallel.
  const RasterView& v = state->view;
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y);
  const size_t runs = std::clamp<size_t>(total / 8192, 1, 16);
  std::vector<uint32_t> offsets(runs * tiles, 0);
  const auto eachTile = [&](size_t run, auto&& visit) {
    for (size_t i = total * run / runs; i < total * (run + 1) / runs; ++i) {
      const TileBox box = state->boxes[size_t(slots[i])];
      for (int y = box.y0; y < box.y1; ++y)
        for (int x = box.x0; x < box.x1; ++x)
          visit(size_t(y) * size_t(v.tiles_x) + size_t(x), slots[i]);
    }
  };
  tbb::parallel_for(size_t(0), runs, [&](size_t run) {
    uint32_t* count = &offsets[run * tiles];
    eachTile(run, [&](size_t tile, int32_t) { ++count[tile]; });
  });
  state->tile_begin.resize(tiles + 1);
  uint32_t sum = 0;
  for (size_t t = 0; t < tiles; ++t) {
    state->tile_begin[t] = sum;
    for (size_t run = 0; run < runs; ++run) sum += std::exchange(offsets[run * tiles + t], sum);
  }
  state->tile_begin[tiles] = sum;
  state->list.reset(sum);
  tbb::parallel_for(size_t(0), runs, [&](size_t run) {
    uint32_t* to = &offsets[run * tiles];
    eachTile(run, [&](size_t tile, int32_t slot) { state->list[to[tile]++] = slot; });
  });
}

}  // namespace

RasterOutput rasterize(const Gaussians& gaussians, const Camera& camera,
                       const RasterSettings& settings, RasterStatePtr* saved) {
  requireConsistent(gaussians);
  require(gaussians.size() < int64_t(1) << 30,
          "rasterize: expected fewer than 2^30 Gaussians, found ", gaussians.size());
  RasterStatePtr state(new RasterState);
  state->view = viewOf(camera, settings);
  state->gaussians = gaussians.size();
  state->sh_degree = gaussians.sh_degree;
  project(arraysOf(gaussians), gaussians.size(), state.get());
  bin(state.get());

  const RasterView& v = state->view;
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y);
  state->stops.reset(tiles * 16);
  if (saved) {
    state->masks.reset(state->tile_begin[tiles] + kLanes);  // read sixteen at a time
    state->pixels.reset(tiles);
  }
  RasterOutput out{Image(v.width, v.height, 3), Image(v.width, v.height, 1),
                   Image(v.width, v.height, 1)};
  tbb::parallel_for(size_t(0), tiles, [&](size_t tile) {
    const uint32_t begin = state->tile_begin[tile];
    TileJob job;
    job.view = &v;
    job.splats = state->splats.data;
    job.list = state->list.data + begin;
    job.count = int(state->tile_begin[tile + 1] - begin);
    job.x0 = int(tile % size_t(v.tiles_x)) * kTile;
    job.y0 = int(tile / size_t(v.tiles_x)) * kTile;
    job.colour = out.colour.data.data();
    job.alpha = out.alpha.data.data();
    job.depth = out.depth.data.data();
    kernels().blendTile(job, saved ? state->masks.data + begin : nullptr, &state->stops[tile * 16],
                        saved ? &state->pixels[tile] : nullptr);
  });
  if (saved) *saved = std::move(state);
  return out;
}

GaussianGradients rasterizeBackward(const Gaussians& gaussians, const Camera& camera,
                                    const RasterState& saved, const Image& d_colour,
                                    const Image* d_alpha, const Image* d_depth) {
  requireConsistent(gaussians);
  const RasterView& v = saved.view;
  require(gaussians.size() == saved.gaussians && gaussians.sh_degree == saved.sh_degree &&
              camera.width == v.width && camera.height == v.height,
          "rasterizeBackward: expected the Gaussians and the camera of the forward call");
  const auto requireImage = [&](const Image& image, int channels, const char* name) {
    require(image.width == v.width && image.height == v.height && image.channels == channels,
            "rasterizeBackward: ", name, ": expected ", v.width, " x ", v.height, " x ", channels,
            ", found ", image.width, " x ", image.height, " x ", image.channels);
  };
  requireImage(d_colour, 3, "d_colour");
  if (d_alpha) requireImage(*d_alpha, 1, "d_alpha");
  if (d_depth) requireImage(*d_depth, 1, "d_depth");

  GaussianGradients d;
  const size_t n = size_t(saved.gaussians);
  d.mean.resize(n, Eigen::Vector3f::Zero());
  d.log_scale.resize(n, Eigen::Vector3f::Zero());
  d.rotation.resize(n, Eigen::Vector4f::Zero());
  d.opacity_logit.resize(n, 0.f);
  d.sh.resize(gaussians.sh.size(), 0.f);
  if (n == 0) return d;

  // 1. Every tile writes its own rows, one per splat in its list.
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y);
  Buffer<GradientRow> rows(saved.tile_begin[tiles]);
  tbb::parallel_for(size_t(0), tiles, [&](size_t tile) {
    const uint32_t begin = saved.tile_begin[tile];
    TileBackwardJob job;
    job.view = &v;
    job.splats = saved.splats.data;
    job.boxes = saved.boxes.data;
    job.first_row = saved.first_row.data;
    job.list = saved.list.data + begin;
    job.masks = saved.masks.data + begin;
    job.stops = &saved.stops[tile * 16];
    job.saved = &saved.pixels[tile];
    job.count = int(saved.tile_begin[tile + 1] - begin);
    job.x0 = int(tile % size_t(v.tiles_x)) * kTile;
    job.y0 = int(tile / size_t(v.tiles_x)) * kTile;
    job.d_colour = d_colour.data.data();
    job.d_alpha = d_alpha ? d_alpha->data.data() : nullptr;
    job.d_depth = d_depth ? d_depth->data.data() : nullptr;
    job.rows = rows.data;
    kernels().blendTileBackward(job);
  });

  // 2. Every Gaussian gathers its rows in tile order.
  const GaussianArrays g = arraysOf(gaussians);
  const GradientArrays out = {d.mean[0].data(), d.log_scale[0].data(), d.rotation[0].data(),
                              d.opacity_logit.data(), d.sh.data()};
  tbb::parallel_for(size_t(0), saved.visible.size(), [&](size_t r) {
    const size_t slot = r * kRange;
    kernels().projectRangeBackward(g, v, &saved.index[slot], saved.visible[r], &saved.boxes[slot],
                                   &saved.first_row[slot], rows.data, out);
  });
  return d;
}

}  // namespace vdbc
