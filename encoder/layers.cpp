#include "encoder/layers.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "vdb/z_order.h"

namespace vdbc {

namespace nn = torch::nn;

Tensor coordTensor(const std::vector<Coord>& coords) {
  static_assert(sizeof(Coord) == 3 * sizeof(int32_t), "Coord is three packed int32");
  Tensor t = torch::empty({int64_t(coords.size()), 3}, torch::kInt32);
  if (!coords.empty()) std::memcpy(t.data_ptr(), coords.data(), coords.size() * sizeof(Coord));
  return t;
}

Tensor zOrder(const std::vector<Coord>& coords) {
  constexpr int kOffset = 1 << 20;  // makes negative coordinates positive
  std::vector<uint64_t> key(coords.size());
  for (size_t i = 0; i < coords.size(); ++i)
    key[i] = zOrderCode(uint64_t(coords[i].x() + kOffset), uint64_t(coords[i].y() + kOffset),
                        uint64_t(coords[i].z() + kOffset));
  Tensor order = torch::empty({int64_t(coords.size())}, torch::kInt64);
  int64_t* o = order.data_ptr<int64_t>();
  std::iota(o, o + coords.size(), 0);
  std::sort(o, o + coords.size(), [&](int64_t a, int64_t b) {
    return key[size_t(a)] != key[size_t(b)] ? key[size_t(a)] < key[size_t(b)] : a < b;
  });
  return order;
}

Rotary rotary(const Tensor& coords, int head_dim, const PositionConfig& config) {
  constexpr int kFrequencies = 5;
  const int64_t n = coords.size(0), pairs = head_dim / 2;
  const int used = int(std::min<int64_t>(kFrequencies, pairs / 3));
  const float high = config.rotary_highest, low = config.rotary_lowest;
  std::vector<float> f(size_t(used), high);
  for (int i = 1; i < used; ++i)
    f[size_t(i)] = high * std::pow(low / high, float(i) / float(used - 1));
  const Tensor frequencies = torch::tensor(f);
  Tensor angle = coords.to(torch::kFloat32).unsqueeze(2) * frequencies;  // [N, 3, used]
  angle = torch::cat({angle.reshape({n, 3 * used}), torch::zeros({n, pairs - 3 * used})}, 1);
  return {angle.cos(), angle.sin()};
}

Tensor rotate(const Tensor& x, const Rotary& p) {
  const auto halves = x.chunk(2, -1);
  return torch::cat({halves[0] * p.cos - halves[1] * p.sin, halves[0] * p.sin + halves[1] * p.cos},
                    -1);
}

Tensor sinusoidalCode(const Tensor& positions) {
  const Tensor octaves = torch::pow(2.f, torch::arange(6, torch::kFloat32)) * float(M_PI / 2);
  const Tensor angle = (positions.unsqueeze(2) * octaves).reshape({positions.size(0), 18});
  return torch::cat({angle.sin(), angle.cos()}, 1);
}

Tensor normalisedPositions(const Tensor& metres, const VoxelFrame& frame,
                           const PositionConfig& config) {
  const Coord lo = frame.bounds.min(), hi = frame.bounds.max();
  const Tensor origin = torch::tensor({float(lo.x() + hi.x() + 1) / 2 * frame.voxel_m,
                                       float(lo.y() + hi.y() + 1) / 2 * frame.voxel_m,
                                       float(lo.z()) * frame.voxel_m});
  return (metres - origin) / config.extent_m;
}

Tensor tokenPositions(const Tensor& coords, int level, const VoxelFrame& frame,
                      const PositionConfig& config) {
  const float token_m = frame.voxel_m * float(1 << level);
  return normalisedPositions((coords.to(torch::kFloat32) + .5f) * token_m, frame, config);
}

namespace {
thread_local bool mixed_precision = false;
}
MixedPrecision::MixedPrecision(bool on) : before_(mixed_precision) { mixed_precision = on; }
MixedPrecision::~MixedPrecision() { mixed_precision = before_; }

Tensor LinearImpl::forward(const Tensor& x) {
  if (!mixed_precision) return torch::nn::LinearImpl::forward(x);
  const auto half = torch::kBFloat16;
  return torch::linear(x.to(half), weight.to(half)).to(torch::kFloat32) + bias;
}

Attention::Attention(int width, int heads_) : heads(heads_) {
  query = register_module("query", Linear(width, width));
  key = register_module("key", Linear(width, width));
  value = register_module("value", Linear(width, width));
  output = register_module("output", Linear(width, width));
}

namespace {
Tensor splitHeads(const Tensor& x, int heads) {  // [N, C] -> [H, N, C / H]
  return x.view({x.size(0), heads, -1}).transpose(0, 1);
}
}  // namespace

Attention::Context Attention::contextOf(const Tensor& rows, const Rotary* pos) {
  const auto through = [&](Linear& layer) {
    return inRowBlocks(rows.size(0), [&](int64_t begin, int64_t end) {
      return layer->forward(rowRange(rows, begin, end));
    });
  };
  const Tensor keys = splitHeads(through(key), heads);
  return {pos ? rotate(keys, *pos) : keys, through(value), {}};
}

Tensor Attention::attend(const Tensor& x, const Rotary* pos, const Context& context) {
  Tensor q = splitHeads(query->forward(x), heads);
  if (pos) q = rotate(q, *pos);
  const double scale = 1 / std::sqrt(double(q.size(2)));
  Tensor scores = torch::matmul(q * scale, context.keys.transpose(1, 2));
  if (context.bias.defined()) scores = scores + context.bias;
  return torch::matmul(scores.softmax(-1), splitHeads(context.values, heads))
      .transpose(0, 1)
      .reshape(x.sizes());
}

Mlp::Mlp(int in, int hidden, int out) {
  first = register_module("first", Linear(in, hidden));
  second = register_module("second", Linear(hidden, out));
}

SelfBlock::SelfBlock(int width, int heads) {
  norm1 = register_module("norm1", nn::LayerNorm(nn::LayerNormOptions({width})));
  norm2 = register_module("norm2", nn::LayerNorm(nn::LayerNormOptions({width})));
  attention = register_module("attention", std::make_shared<Attention>(width, heads));
  mlp = register_module("mlp", std::make_shared<Mlp>(width, 4 * width, width));
}

Tensor SelfBlock::forward(const Tensor& x, const Rotary* pos, const Tensor& bias) {
  const Tensor normed = norm1->forward(x);
  Attention::Context context = attention->contextOf(normed, pos);
  context.bias = bias;
  return inRowBlocks(x.size(0), [&](int64_t begin, int64_t end) {
    const Rotary p = pos ? pos->slice(begin, end) : Rotary();
    const Tensor y = rowRange(x, begin, end) +
                     attention->forward(rowRange(normed, begin, end), pos ? &p : nullptr, context);
    return y + mlp->forward(norm2->forward(y));
  });
}

Tensor SelfBlock::windowed(const Tensor& x, const Rotary* pos, const Tensor& order, int window,
                           bool shifted) {
  const int64_t n = x.size(0), lead = shifted ? window / 2 : 0;
  if (n <= window) return forward(x, pos);
  std::vector<Tensor> parts(size_t((n + lead + window - 1) / window));
  inTasks(int64_t(parts.size()), [&](int64_t i) {
    const int64_t begin = i * window - lead, first = std::max<int64_t>(0, begin),
                  last = std::min(n, begin + window);
    const Tensor rows = order.slice(0, first, last);
    // The first and the last window may have places without a token, which nobody looks at.
    const int64_t before = first - begin, after = begin + window - last;
    const auto places = [&](const Tensor& t) {
      return torch::constant_pad_nd(t.index_select(0, rows), {0, 0, before, after});
    };
    Tensor bias;
    if (before || after)
      bias = torch::constant_pad_nd(torch::zeros({last - first}), {before, after}, -1e9);
    const Rotary p = pos ? Rotary{places(pos->cos), places(pos->sin)} : Rotary();
    parts[size_t(i)] =
        forward(places(x), pos ? &p : nullptr, bias).slice(0, before, window - after);
  });
  Tensor inverse = torch::empty_like(order);
  inverse.index_put_({order}, torch::arange(n));
  return torch::cat(parts).index_select(0, inverse);
}

void initialiseXavier(nn::Module& module) {
  torch::NoGradGuard no_grad;
  for (auto& m : module.modules(/*include_self=*/false))
    if (auto* linear = m->as<nn::LinearImpl>()) {
      const double bound = std::sqrt(6.0 / double(linear->weight.size(0) + linear->weight.size(1)));
      linear->weight.uniform_(-bound, bound);
      if (linear->bias.defined()) linear->bias.zero_();
    }
}

void updateAverage(std::vector<Tensor>& average, const std::vector<Tensor>& parameters,
                   double decay) {
  torch::NoGradGuard no_grad;
  for (size_t i = 0; i < average.size(); ++i) average[i].lerp_(parameters[i], 1 - decay);
}

double cosineRate(double base, int64_t step, int64_t steps, int64_t warmup, double floor) {
  if (step < warmup) return base * double(step + 1) / double(warmup);
  const double t =
      std::min(1.0, double(step - warmup) / double(std::max<int64_t>(1, steps - warmup)));
  return base * (floor + (1 - floor) * .5 * (1 + std::cos(M_PI * t)));
}

}  // namespace vdbc
