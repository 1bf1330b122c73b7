#pragma once
// Private: transformer layers shared by encoder/ and mar/, and the only place (with
// rasterize_torch.h and inference.h) that includes torch. This header is precompiled.
#include <torch/nn/module.h>
#include <torch/nn/modules/activation.h>
#include <torch/nn/modules/container/modulelist.h>
#include <torch/nn/modules/container/sequential.h>
#include <torch/nn/modules/linear.h>
#include <torch/nn/modules/normalization.h>
#include <torch/types.h>

#include "encoder/inference.h"
#include "encoder/positions.h"
#include "vdb/frame.h"
#include "vdb/token_grid.h"

namespace vdbc {

using torch::Tensor;

/// Coordinates as an int32 tensor [N, 3].
Tensor coordTensor(const std::vector<Coord>& coords);

/// Z-order of coordinates: order[k] is the row at place k of the curve. Neighbours on the curve are
/// neighbours in space, which is what windowed attention needs.
Tensor zOrder(const std::vector<Coord>& coords);

/// Cosines and sines of 3-D rotary positions, each [N, head_dim / 2]: 5 frequencies an axis between
/// the configuration's, geometric; pairs left over do not turn.
struct Rotary {
  Tensor cos, sin;
  Rotary slice(int64_t begin, int64_t end) const {
    return {rowRange(cos, begin, end), rowRange(sin, begin, end)};
  }
};
Rotary rotary(const Tensor& coords, int head_dim, const PositionConfig& config);

/// Rotates [H, N, head_dim] by the positions of its N tokens.
Tensor rotate(const Tensor& x, const Rotary& positions);

/// Sinusoidal code of positions [N, 3] (any unit; about 0-1 over the training extent), [N, 6 * 6].
Tensor sinusoidalCode(const Tensor& positions);
constexpr int kSinusoidalDim = 36;

/// Positions in metres (grid axes) divided by the training extent: about -.5..+.5 across, 0-.4 up.
Tensor normalisedPositions(const Tensor& metres, const VoxelFrame& frame,
                           const PositionConfig& config);
/// The same of the centres of tokens [N, 3] int32 of a tree level.
Tensor tokenPositions(const Tensor& coords, int level, const VoxelFrame& frame,
                      const PositionConfig& config);

/// While it lives, this thread's Linear layers multiply in bfloat16, forward and backward; all
/// else, the parameters too, stays float32.
class MixedPrecision {
 public:
  explicit MixedPrecision(bool on);
  ~MixedPrecision();
  MixedPrecision(const MixedPrecision&) = delete;

 private:
  bool before_;
};

/// torch's linear layer that obeys MixedPrecision.
struct LinearImpl : torch::nn::LinearImpl {
  using torch::nn::LinearImpl::LinearImpl;
  Tensor forward(const Tensor& x);
};
TORCH_MODULE(Linear);

/// Multi-head attention with separate q, k, v and output projections. Rotary positions may be null.
struct Attention : torch::nn::Module {
  Attention(int width, int heads);
  /// What queries look at.
  struct Context {
    Tensor keys;    // [H, M, C / H]
    Tensor values;  // [M, C]
    Tensor bias;    // [M] added to every query's scores; undefined: none
  };
  Context contextOf(const Tensor& rows, const Rotary* pos);
  /// Queries from [N, C]. Returns [N, C], before the output projection.
  Tensor attend(const Tensor& x, const Rotary* pos, const Context& context);
  /// The same, projected.
  Tensor forward(const Tensor& x, const Rotary* pos, const Context& context) {
    return output->forward(attend(x, pos, context));
  }
  /// alpha * attention + (1 - alpha) * guide, mixed before the output projection; `guide` maps
  /// values [M, C] to [N, C] (docs/method.md, section 3.2).
  template <typename Guide>
  Tensor guided(const Tensor& x, const Tensor& rows, const Tensor& alpha, const Guide& guide) {
    const Context context = contextOf(rows, nullptr);
    const Tensor given = guide(context.values);
    return inRowBlocks(x.size(0), [&](int64_t begin, int64_t end) {
      return output->forward(alpha * attend(rowRange(x, begin, end), nullptr, context) +
                             (1 - alpha) * rowRange(given, begin, end));
    });
  }

  int heads;
  Linear query{nullptr}, key{nullptr}, value{nullptr}, output{nullptr};
};

/// Linear, GELU, linear.
struct Mlp : torch::nn::Module {
  Mlp(int in, int hidden, int out);
  Tensor forward(const Tensor& x) {
    return inRowBlocks(x.size(0), [&](int64_t begin, int64_t end) {
      return second->forward(torch::gelu(first->forward(rowRange(x, begin, end))));
    });
  }
  Linear first{nullptr}, second{nullptr};
};

/// Pre-norm transformer block: self-attention (rotary) and MLP.
struct SelfBlock : torch::nn::Module {
  SelfBlock(int width, int heads);
  /// All N tokens look at each other. `bias` [N] is added to the scores of the tokens looked at;
  /// undefined: none.
  Tensor forward(const Tensor& x, const Rotary* pos, const Tensor& bias = {});
  /// Within windows of `window` tokens consecutive in `order` (Z-order), where `shifted` from half
  /// a window on, as every second block is. One window where N <= window.
  Tensor windowed(const Tensor& x, const Rotary* pos, const Tensor& order, int window,
                  bool shifted);
  torch::nn::LayerNorm norm1{nullptr}, norm2{nullptr};
  std::shared_ptr<Attention> attention;
  std::shared_ptr<Mlp> mlp;
};

/// Xavier for matrices, zeros for biases (docs/method.md, section 3.7); modules that must start at
/// zero do so afterwards.
void initialiseXavier(torch::nn::Module& module);

/// Exponential moving average of parameters: average += (1 - decay) * (value - average).
void updateAverage(std::vector<Tensor>& average, const std::vector<Tensor>& parameters,
                   double decay);

/// base * (linear warm-up, then cosine from 1 to `floor`). See docs/method.md, sections 3.7
/// and 5.5.
double cosineRate(double base, int64_t step, int64_t steps, int64_t warmup, double floor);

}  // namespace vdbc
