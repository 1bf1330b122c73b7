#include "splat/rasterize.h"

#include <tbb/parallel_for.h>
#include <tbb/parallel_invoke.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <utility>

#include "vdb/error.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace vdbc {
namespace {

constexpr int kTile = 16;         // pixels
constexpr int kLanes = 16;        // floats in a vector; pixels in a block of 4 x 4
constexpr int kChunk = 128;       // splats a tile holds at a time
constexpr int kBatch = 8;         // splats a block takes at a time
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
  bool antialias;
};

/// A Gaussian in the image: alpha = 2^(log2_opacity - (a dx^2 + b dx dy + c dy^2)). One cache line:
/// the tiles read them in order of depth, all over memory.
struct alignas(64) Splat {
  float x, y;  // pixels
  float a, b, c;
  float log2_opacity;
  float z;  // metres
  float colour[3];
  /// Its instance in tile (x, y) is `instance + y * width + x` (modulo 2^32), counted from the
  /// first of its range.
  uint32_t instance, width;
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
  kSumHx = 1,
  kSumHxx = 2,
  kSumGreen = 3,
  kSumHy = 4,
  kSumHxy = 5,
  kSumBlue = 7,
  kSumHyy = 8,
  kSumZ = 11,
  kSumRed = 12
};

constexpr uint32_t kNoRow = ~0u;  // of an instance that no pixel saw
constexpr int kAhead = 48;        // instances between asking for a row and adding it

/// Floats in a gradient row of extra channels.
constexpr int extraStride(int count) { return (count + 15) / 16 * 16; }

/// The image under one tile by block: red, green, blue, alpha, depth.
struct alignas(64) TilePixels {
  float v[16][5][16];
};

struct GaussianArrays {
  const float *mean, *log_scale, *rotation, *opacity_logit, *sh;
  int sh_degree;
  const float* extra;
  int extra_count;
};

struct GradientArrays {
  float *mean, *log_scale, *rotation, *opacity_logit, *sh, *extra;
};

/// Extra channels of a tile; all zero without any.
struct ExtraJob {
  int count = 0;
  const float* values = nullptr;   // [N, count]
  const int32_t* index = nullptr;  // slot -> Gaussian
  float* blocks = nullptr;         // [16, count, 16] this tile's sums
  float* image = nullptr;          // forward
  const float* d_image = nullptr;  // the rest: backward
  float* d_blocks = nullptr;       // [16, count, 16] room for d_image of this tile
  float* rows = nullptr;           // beside the gradient rows, extraStride(count) floats each
};

struct TileJob {
  const RasterView* view;
  const Splat* splats;
  const int32_t* list;  // slots, front to back
  int count;
  int x0, y0;  // pixels
  float *colour, *alpha, *depth;
  float* median_depth;  // may be null
  ExtraJob extra;
};

struct TileBackwardJob {
  const RasterView* view;
  const Splat* splats;
  const uint32_t* range_instance;
  const int32_t* list;
  const uint16_t* masks;
  const int32_t* stops;
  const TilePixels* saved;
  int count;
  int x0, y0;
  const float *d_colour, *d_alpha, *d_depth, *d_median_depth;  // the last three may be null
  uint32_t first_row;                                          // rows are this tile's from here on
  uint32_t* row_of;                                            // [instances], filled with kNoRow
  GradientRow* rows;
  ExtraJob extra;
};

struct RasterKernels {
  int (*projectRange)(const GaussianArrays&, const RasterView&, int64_t begin, int64_t end, Splat*,
                      TileBox*, float* depths, int32_t* index);
  void (*projectRangeBackward)(const GaussianArrays&, const RasterView&, const int32_t* index,
                               int count, const TileBox*, const uint32_t* row_of,
                               const GradientRow*, const float* extra_rows, const GradientArrays&,
                               double* camera);
  void (*blendTile)(const TileJob&, uint16_t* masks, int32_t* stops, TilePixels* saved);
  void (*blendTileBackward)(const TileBackwardJob&);
};

#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // g++ 12's own AVX-512 header
#pragma GCC diagnostic ignored "-Wpsabi"  // vectors are passed to inlined functions only

// g++ 12 reads the whole file before it obeys `#pragma GCC target`, so __AVX512F__ and the like
// stay undefined there: the kernels are told how wide the registers are.
#define VDBC_VECTOR_BITS 128
namespace baseline {
#include "splat/rasterize_kernels.inl"
}  // namespace baseline

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v3")
#undef VDBC_VECTOR_BITS
#define VDBC_VECTOR_BITS 256
namespace avx2 {
#include "splat/rasterize_kernels.inl"
}  // namespace avx2
#pragma GCC pop_options

#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4")
#undef VDBC_VECTOR_BITS
#define VDBC_VECTOR_BITS 512
namespace avx512 {
#include "splat/rasterize_kernels.inl"
}  // namespace avx512
#pragma GCC pop_options

const RasterKernels& kernelsOf(int bits) {
  const bool has512 = __builtin_cpu_supports("x86-64-v4");
  const bool has256 = __builtin_cpu_supports("x86-64-v3");
  if (bits == 512 || (bits == 0 && has512)) {
    require(has512, "rasterize: vector_bits: expected a CPU with AVX-512 (x86-64-v4) for 512");
    return avx512::kKernels;
  }
  if (bits == 256 || (bits == 0 && has256)) {
    require(has256, "rasterize: vector_bits: expected a CPU with AVX2 (x86-64-v3) for 256");
    return avx2::kKernels;
  }
  require(bits == 0 || bits == 128, "rasterize: vector_bits: expected 0, 128, 256 or 512, found ",
          bits);
  return baseline::kKernels;
}
#else
const RasterKernels& kernelsOf(int bits) {
  require(bits == 0 || bits == 128,
          "rasterize: vector_bits: expected 0 or 128 in this build, found ", bits);
  return baseline::kKernels;
}
#endif

RasterView viewOf(const Camera& camera, const Eigen::Vector3d& origin,
                  const RasterSettings& settings) {
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
  const Eigen::Vector3d eye = camera.world_from_camera.translation() - origin;
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
  v.antialias = settings.antialias;
  return v;
}

GaussianArrays arraysOf(const Gaussians& g, const ExtraChannels& extra) {
  if (g.size() == 0) return {nullptr, nullptr, nullptr, nullptr, nullptr, g.sh_degree, nullptr, 0};
  return {g.mean[0].data(), g.log_scale[0].data(), g.rotation[0].data(), g.opacity_logit.data(),
          g.sh.data(),      g.sh_degree,           extra.values,         extra.count};
}

void requireExtra(const ExtraChannels& extra, const Gaussians& gaussians, const char* operation) {
  require(extra.count >= 0 && extra.count <= 1024 &&
              (extra.values || extra.count == 0 || gaussians.size() == 0),
          operation, ": expected 0 to 1024 extra channels with values, found ", extra.count);
}

/// Sorts slots of a tile by depth, equal depths by slot. `slots` come in ascending order.
void sortByDepth(const float* depths, int32_t* slots, size_t count) {
  if (count < 2) return;
  Buffer<uint64_t> room(2 * count);
  uint64_t *a = room.data, *b = a + count;  // depth, then slot
  uint32_t low = ~0u, high = 0;
  for (size_t i = 0; i < count; ++i) {
    uint32_t key;
    std::memcpy(&key, &depths[slots[i]], 4);  // positive floats sort as their bits
    low = std::min(low, key), high = std::max(high, key);
    a[i] = uint64_t(key) << 32 | uint32_t(slots[i]);
  }
  if (count >= 64) {
    // Two passes over the 16 leading bits of the tile's range of depths; few are equal in those.
    int shift = 0;
    while ((high - low) >> shift >> 16) ++shift;
    std::array<uint32_t, 256> at0{}, at1{};
    const auto digits = [&](uint64_t entry) { return (uint32_t(entry >> 32) - low) >> shift; };
    for (size_t i = 0; i < count; ++i) {
      const uint32_t d = digits(a[i]);
      ++at0[d & 255], ++at1[d >> 8];
    }
    uint32_t sum0 = 0, sum1 = 0;
    for (size_t d = 0; d < 256; ++d) {
      sum0 += std::exchange(at0[d], sum0);
      sum1 += std::exchange(at1[d], sum1);
    }
    for (size_t i = 0; i < count; ++i) b[at0[digits(a[i]) & 255]++] = a[i];
    for (size_t i = 0; i < count; ++i) a[at1[digits(b[i]) >> 8]++] = b[i];
    for (size_t i = 1; i < count; ++i) {
      if (a[i - 1] <= a[i]) continue;
      size_t begin = i - 1, end = i + 1;
      while (begin > 0 && digits(a[begin - 1]) == digits(a[i])) --begin;
      while (end < count && digits(a[end]) == digits(a[i])) ++end;
      std::sort(a + begin, a + end);
      i = end;
    }
  } else {
    std::sort(a, a + count);
  }
  for (size_t i = 0; i < count; ++i) slots[i] = int32_t(uint32_t(a[i]));
}

}  // namespace

/// Visible Gaussians live in slots: range r of kRange Gaussians fills the slots from r * kRange on.
struct RasterState {
  RasterView view;
  const RasterKernels* kernels = nullptr;
  int64_t gaussians = 0;
  int sh_degree = 0;
  std::vector<int> visible;              // per range
  Buffer<Splat> splats;                  // per slot
  Buffer<TileBox> boxes;                 // per slot
  Buffer<float> depths;                  // per slot, metres
  Buffer<int32_t> index;                 // per slot: which Gaussian
  std::vector<uint32_t> range_instance;  // [ranges + 1] first instance (splat in a tile) of each
  std::vector<uint32_t> tile_begin;      // [tiles + 1], into list
  Buffer<int32_t> list;                  // slots by tile, front to back
  Buffer<uint16_t> masks;                // beside list: which 4 x 4 blocks of the tile it may touch
  Buffer<int32_t> stops;      // [tiles * 16] how many of the tile's list the block looked at
  Buffer<TilePixels> pixels;  // [tiles]
  int extra_count = 0;
  Buffer<float> extra_blocks;  // [tiles, 16, extra_count, 16] sums of the extra channels
};

void RasterStateDeleter::operator()(RasterState* state) const { delete state; }

namespace {

/// Fills visible, splats, boxes, depths, index, range_instance.
void project(const GaussianArrays& g, int64_t n, RasterState* state) {
  const size_t ranges = size_t((n + kRange - 1) / kRange), slots = ranges * kRange;
  state->visible.assign(ranges, 0);
  state->splats.reset(slots);
  state->boxes.reset(slots);
  state->depths.reset(slots);
  state->index.reset(slots);
  std::vector<uint64_t> instances(ranges, 0);
  tbb::parallel_for(size_t(0), ranges, [&](size_t r) {
    const size_t slot = r * kRange;
    const int64_t begin = int64_t(slot), end = std::min(n, begin + kRange);
    state->visible[r] = state->kernels->projectRange(g, state->view, begin, end,
                                                     &state->splats[slot], &state->boxes[slot],
                                                     &state->depths[slot], &state->index[slot]);
    for (size_t s = slot; s < slot + size_t(state->visible[r]); ++s) {
      const TileBox& box = state->boxes[s];
      instances[r] += uint64_t(box.x1 - box.x0) * uint64_t(box.y1 - box.y0);
    }
  });
  uint64_t sum = 0;
  state->range_instance.resize(ranges + 1);
  for (size_t r = 0; r < ranges; ++r) {
    state->range_instance[r] = uint32_t(sum);
    sum += instances[r];
    require(sum < uint64_t(1) << 31, "rasterize: expected fewer than 2^31 splats in tiles, found ",
            sum, " and more");
  }
  state->range_instance[ranges] = uint32_t(sum);
}

/// Fills tile_begin and list, by slot within a tile.
void bin(RasterState* state) {
  size_t total = 0;
  for (int count : state->visible) total += size_t(count);
  // Runs of slots are counted, then placed, in parallel.
  const RasterView& v = state->view;
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y), ranges = state->visible.size();
  const size_t runs = std::clamp<size_t>(std::min(total / 8192, ranges), 1, 16);
  std::vector<uint32_t> offsets(runs * tiles, 0);
  const auto eachSlot = [&](size_t run, auto&& visit) {
    for (size_t r = ranges * run / runs; r < ranges * (run + 1) / runs; ++r)
      for (size_t s = r * kRange; s < r * kRange + size_t(state->visible[r]); ++s) visit(s);
  };
  tbb::parallel_for(size_t(0), runs, [&](size_t run) {
    uint32_t* count = &offsets[run * tiles];
    eachSlot(run, [&](size_t s) {
      const TileBox box = state->boxes[s];
      for (size_t y = box.y0; y < box.y1; ++y)
        for (size_t x = box.x0; x < box.x1; ++x) ++count[y * size_t(v.tiles_x) + x];
    });
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
    eachSlot(run, [&](size_t s) {
      const TileBox box = state->boxes[s];
      for (size_t y = box.y0; y < box.y1; ++y)
        for (size_t x = box.x0; x < box.x1; ++x)
          state->list[to[y * size_t(v.tiles_x) + x]++] = int32_t(s);
    });
  });
}

}  // namespace

RasterOutput rasterize(const Gaussians& gaussians, const Camera& camera,
                       const RasterSettings& settings, RasterStatePtr* saved,
                       const ExtraChannels& extra) {
  requireConsistent(gaussians);
  requireExtra(extra, gaussians, "rasterize");
  require(gaussians.size() < int64_t(1) << 30,
          "rasterize: expected fewer than 2^30 Gaussians, found ", gaussians.size());
  RasterStatePtr state(new RasterState);
  state->view = viewOf(camera, gaussians.origin, settings);
  state->kernels = &kernelsOf(settings.vector_bits);
  state->gaussians = gaussians.size();
  state->sh_degree = gaussians.sh_degree;
  state->extra_count = extra.count;
  project(arraysOf(gaussians, extra), gaussians.size(), state.get());
  bin(state.get());

  const RasterView& v = state->view;
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y);
  state->stops.reset(tiles * 16);
  if (saved) {
    state->masks.reset(state->tile_begin[tiles] + kLanes);  // read sixteen at a time
    state->pixels.reset(tiles);
  }
  RasterOutput out;
  out.colour = Image(v.width, v.height, 3);
  out.alpha = Image(v.width, v.height, 1);
  out.depth = Image(v.width, v.height, 1);
  if (settings.median_depth) out.median_depth = Image(v.width, v.height, 1);
  if (extra.count) out.channels = Image(v.width, v.height, extra.count);
  const size_t extra_size = 16 * kLanes * size_t(extra.count);  // of a tile
  if (saved) state->extra_blocks.reset(tiles * extra_size);
  tbb::parallel_for(size_t(0), tiles, [&](size_t tile) {
    const uint32_t begin = state->tile_begin[tile], end = state->tile_begin[tile + 1];
    sortByDepth(state->depths.data, state->list.data + begin, end - begin);
    Buffer<float> own_blocks(saved ? 0 : extra_size);
    TileJob job;
    job.view = &v;
    job.splats = state->splats.data;
    job.list = state->list.data + begin;
    job.count = int(end - begin);
    job.x0 = int(tile % size_t(v.tiles_x)) * kTile;
    job.y0 = int(tile / size_t(v.tiles_x)) * kTile;
    job.colour = out.colour.data.data();
    job.alpha = out.alpha.data.data();
    job.depth = out.depth.data.data();
    job.median_depth = settings.median_depth ? out.median_depth.data.data() : nullptr;
    job.extra.count = extra.count;
    job.extra.values = extra.values;
    job.extra.index = state->index.data;
    job.extra.blocks = saved ? state->extra_blocks.data + tile * extra_size : own_blocks.data;
    job.extra.image = out.channels.data.data();
    state->kernels->blendTile(job, saved ? state->masks.data + begin : nullptr,
                              &state->stops[tile * 16], saved ? &state->pixels[tile] : nullptr);
  });
  if (saved) *saved = std::move(state);
  return out;
}

GaussianGradients rasterizeBackward(const Gaussians& gaussians, const Camera& camera,
                                    const RasterState& saved, const Image& d_colour,
                                    const Image* d_alpha, const Image* d_depth,
                                    const BackwardExtras& extras) {
  requireConsistent(gaussians);
  const RasterView& v = saved.view;
  const ExtraChannels& extra = extras.extra;
  requireExtra(extra, gaussians, "rasterizeBackward");
  require(gaussians.size() == saved.gaussians && gaussians.sh_degree == saved.sh_degree &&
              camera.width == v.width && camera.height == v.height,
          "rasterizeBackward: expected the Gaussians and the camera of the forward call");
  require(!extras.d_channels || extra.count == saved.extra_count,
          "rasterizeBackward: extra channels: expected ", saved.extra_count, " as in the forward ",
          "call, found ", extra.count);
  const auto requireImage = [&](const Image& image, int channels, const char* name) {
    require(image.width == v.width && image.height == v.height && image.channels == channels,
            "rasterizeBackward: ", name, ": expected ", v.width, " x ", v.height, " x ", channels,
            ", found ", image.width, " x ", image.height, " x ", image.channels);
  };
  requireImage(d_colour, 3, "d_colour");
  if (d_alpha) requireImage(*d_alpha, 1, "d_alpha");
  if (d_depth) requireImage(*d_depth, 1, "d_depth");
  if (extras.d_median_depth) requireImage(*extras.d_median_depth, 1, "d_median_depth");
  if (extras.d_channels) requireImage(*extras.d_channels, extra.count, "d_channels");

  GaussianGradients d;
  const size_t n = size_t(saved.gaussians);
  d.extra.resize(n * size_t(extra.count), 0.f);
  if (n == 0) return d;

  // 1. Every tile writes its own rows, one per splat in its list.
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y);
  const int channels = extras.d_channels ? extra.count : 0;
  const size_t extra_size = 16 * kLanes * size_t(channels);  // of a tile
  Buffer<GradientRow> rows(saved.tile_begin[tiles]);
  Buffer<uint32_t> row_of(saved.tile_begin[tiles] + kAhead);
  std::fill_n(row_of.data, saved.tile_begin[tiles] + kAhead, kNoRow);
  Buffer<float> extra_rows(saved.tile_begin[tiles] * size_t(extraStride(channels)));
  const auto backwardTile = [&](size_t tile) {
    const uint32_t begin = saved.tile_begin[tile];
    Buffer<float> d_blocks(extra_size);
    TileBackwardJob job;
    job.view = &v;
    job.splats = saved.splats.data;
    job.range_instance = saved.range_instance.data();
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
    job.d_median_depth = extras.d_median_depth ? extras.d_median_depth->data.data() : nullptr;
    job.first_row = begin;
    job.row_of = row_of.data;
    job.rows = rows.data;
    job.extra.count = channels;
    job.extra.values = extra.values;
    job.extra.index = saved.index.data;
    if (channels) {
      job.extra.blocks = saved.extra_blocks.data + tile * extra_size;
      job.extra.d_image = extras.d_channels->data.data();
    }
    job.extra.d_blocks = d_blocks.data;
    job.extra.rows = extra_rows.data;
    saved.kernels->blendTileBackward(job);
  };
  // Eigen's vectors stay uncleared here: step 2 writes every one of them.
  tbb::parallel_invoke(
      [&] {
        d.mean.resize(n), d.log_scale.resize(n), d.rotation.resize(n);
        d.opacity_logit.resize(n);
        d.sh.resize(gaussians.sh.size());
      },
      [&] { tbb::parallel_for(size_t(0), tiles, backwardTile); });

  // 2. Every Gaussian gathers its rows in tile order.
  const GaussianArrays g = arraysOf(gaussians, {channels, extra.values});
  const GradientArrays out = {d.mean[0].data(),       d.log_scale[0].data(), d.rotation[0].data(),
                              d.opacity_logit.data(), d.sh.data(),           d.extra.data()};
  const size_t ranges = saved.visible.size();
  std::vector<Eigen::Matrix<double, 6, 1>> pose(ranges, Eigen::Matrix<double, 6, 1>::Zero());
  tbb::parallel_for(size_t(0), ranges, [&](size_t r) {
    const size_t slot = r * kRange, count = std::min<size_t>(kRange, n - slot);
    std::fill_n(out.mean + 3 * slot, 3 * count, 0.f);
    std::fill_n(out.log_scale + 3 * slot, 3 * count, 0.f);
    std::fill_n(out.rotation + 4 * slot, 4 * count, 0.f);
    saved.kernels->projectRangeBackward(g, v, &saved.index[slot], saved.visible[r],
                                        &saved.boxes[slot], row_of.data + saved.range_instance[r],
                                        rows.data, extra_rows.data, out,
                                        extras.camera ? pose[r].data() : nullptr);
  });
  for (const auto& p : pose) d.camera += p;
  return d;
}

RasterWork workOf(const RasterState& state) {
  RasterWork work;
  for (int count : state.visible) work.visible += count;
  const RasterView& v = state.view;
  const size_t tiles = size_t(v.tiles_x) * size_t(v.tiles_y);
  work.instances = state.tile_begin[tiles];
  for (size_t block = 0; block < tiles * 16; ++block) {
    const size_t tile = block / 16, bit = block % 16;
    const int x0 = int(tile % size_t(v.tiles_x)) * kTile + int(bit % 4) * 4;
    const int y0 = int(tile / size_t(v.tiles_x)) * kTile + int(bit / 4) * 4;
    float transmittance[16];
    std::fill_n(transmittance, 16, 1.f);
    for (int k = 0; k < state.stops[block]; ++k) {
      const size_t at = state.tile_begin[tile] + size_t(k);
      if (!(state.masks[at] >> bit & 1)) continue;
      ++work.blocks;
      const Splat& s = state.splats[size_t(state.list[at])];
      for (int i = 0; i < 16; ++i) {
        const int x = x0 + i % 4, y = y0 + i / 4;
        const float dx = float(x) + 0.5f - s.x, dy = float(y) + 0.5f - s.y;
        const float e = s.log2_opacity - (dx * (s.a * dx + s.b * dy) + s.c * dy * dy);
        if (x >= v.width || y >= v.height || e < v.log2_min_alpha || transmittance[i] < kOpaque)
          continue;
        ++work.pairs;
        transmittance[i] *= 1 - std::min(std::exp2(e), v.max_alpha);
      }
    }
  }
  return work;
}

}  // namespace vdbc
