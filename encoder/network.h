#pragma once
// Private: the encoder-decoder as torch modules.
#include "encoder/encoder.h"
#include "encoder/layers.h"

namespace vdbc {

/// Softmax of pixel counts as a uniform floor plus a sparse correction: never a dense matrix
/// (docs/method.md, section 3.2).
struct CountAttention {
  Tensor rows, columns;  // [nnz] int64
  Tensor weight;         // [nnz] softmax value less the floor
  Tensor floor;          // [N, 1]
  /// [M, C] values -> [N, C].
  Tensor apply(const Tensor& values) const;
};

/// From (row, column, count) triples of an N x M matrix that is zero elsewhere.
CountAttention countAttention(const std::vector<int32_t>& rows, const std::vector<int32_t>& columns,
                              const std::vector<float>& counts, int64_t n, int64_t m,
                              bool log_counts);

/// An observation as tensors.
struct EncoderInput {
  Tensor voxel_features;  // [N0, kVoxelFeatures]
  std::vector<Tensor>
      children;           // per level 1..levels: [N_l, 8] int64 rows below, N_(l-1) where absent
  Tensor coords;          // [N, 3] int32 of the latent level
  Tensor positions;       // [N, 3] normalised
  Tensor order;           // Z-order of the latent level
  Tensor patches;         // [P, 3 * px * px]
  Tensor patch_geometry;  // [P, 10]: centre ray, camera place, mean point (normalised), share
  CountAttention voxels_from_patches, patches_from_voxels;
};
EncoderInput encoderInput(const std::vector<View>& views, const Observation& observation,
                          const EncoderConfig& config);

struct BidirectionalBlock : torch::nn::Module {
  BidirectionalBlock(const EncoderConfig& config, bool updates_patches);
  /// Updates x3 [N, C] from x2, then x2 [P, C] from the new x3 (paper eq. 2).
  void forward(Tensor* x3, Tensor* x2, const EncoderInput& in, const Rotary& pos, int layer);

  const EncoderConfig config;
  std::shared_ptr<SelfBlock> self3, self2;
  std::shared_ptr<Attention> cross3, cross2;
  torch::nn::LayerNorm norm3{nullptr}, norm2{nullptr}, context3{nullptr}, context2{nullptr};
  Tensor alpha;  // logit of the learned share

 private:
  Tensor share() const;
};

/// Rows of the children that a split makes.
struct Split {
  Tensor parent;  // [V] int64
  Tensor slot;    // [V] int64, 0-7
};

/// What the decoder knows of N tokens: features of its transformer and, around them, the colours
/// that the Gaussians in each of a token's 8 octants start from (opponent colours).
struct DecoderTokens {
  Tensor features;  // [N, C]
  Tensor colours;   // [N, 8, 3]
  DecoderTokens rows(int64_t begin, int64_t end) const {
    return {features.slice(0, begin, end), colours.slice(0, begin, end)};
  }
};

/// Places of M Gaussians in a unit voxel, [M, 3]: centres of the smallest cubic lattice with at
/// least M cells, every cell where M is a cube and evenly spread ones elsewhere; x slowest. See
/// docs/method.md, section 3.5.
Tensor subLattice(int64_t m);

/// Raw outputs for V voxels.
struct GaussianTensors {
  Tensor mean, log_scale, rotation, opacity_logit, sh;  // [V * M, ...] grid frame, metres
};

struct EncoderNet : torch::nn::Module {
  explicit EncoderNet(const EncoderConfig& config);

  struct Posterior {
    Tensor mean, log_variance;  // [N, latent_dim]
  };
  Posterior encode(const EncoderInput& in);
  /// GroupNorm over each token's channel groups (docs/method.md, section 3.3), or nothing with 0
  /// groups.
  Tensor normalise(const Tensor& z);

  /// Tokens of latents [N, latent_dim].
  DecoderTokens decodeTokens(const Tensor& z, const Tensor& coords, const Tensor& order);
  /// BCE-up logits of the 8 children, [N, 8]; split 0 is the coarsest.
  Tensor childLogits(const DecoderTokens& tokens, int split);
  /// Tokens of the children.
  DecoderTokens splitTokens(const DecoderTokens& tokens, const Split& split, int level);
  /// Gaussians of voxels (coords [V, 3]) of edge voxel_m.
  GaussianTensors gaussians(const DecoderTokens& voxels, const Tensor& coords, float voxel_m);

  const EncoderConfig config;
  std::shared_ptr<Mlp> voxel_in, gaussian_mlp;
  std::vector<std::shared_ptr<Mlp>> aggregate;
  Linear position_in{nullptr}, patch_in{nullptr}, geometry_in{nullptr}, posterior{nullptr},
      latent_in{nullptr}, gaussian_out{nullptr};
  // Shallow ways around the transformers, for the mean colours of a token's octants: learned in
  // minutes, where the deep way stayed grey for an hour.
  Linear feature_shortcut{nullptr}, colour_shortcut{nullptr};
  torch::nn::LayerNorm posterior_norm{nullptr}, decoder_norm{nullptr}, gaussian_norm{nullptr};
  std::vector<std::shared_ptr<BidirectionalBlock>> blocks;
  std::vector<std::shared_ptr<SelfBlock>> decoder_blocks;
  std::vector<Linear> child_logits, child_tokens;
};

/// Ground truth children plus false positives (docs/method.md, section 3.4): count = ratio * truth,
/// half among children next to the truth (26 neighbours), half anywhere among the children.
/// `occupied` [N, 8] bool, `coords` of the nodes. Returns [N, 8] bool.
Tensor injectFalsePositives(const Tensor& occupied, const std::vector<Coord>& coords, float ratio,
                            torch::Generator& random);

/// Rows and slots of the true entries of [N, 8].
Split splitOf(const Tensor& mask);

}  // namespace vdbc
