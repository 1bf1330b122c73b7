#pragma once
// Private: the completer as torch modules.
#include <array>

#include "encoder/layers.h"
#include "mar/config.h"
#include "mar/heads.h"

namespace vdbc {

/// Tokens of one kind: features [n, D] (D = 0 where position is all), coordinates of a tree level.
struct TokenSet {
  Tensor features;
  std::vector<Coord> coords;
};

/// Inputs in the order H1 and H2 see them; each kind has its own linear layer and LayerNorm
/// (docs/method.md, section 4.2).
enum TokenKind { kCondition, kVisible, kEmptyToken, kTarget, kTokenKinds };
using TokenSets = std::array<TokenSet, kTokenKinds>;

struct StageSizes {
  int width, heads, layers;
  std::array<int, kTokenKinds> feature_dims;
};

/// H1 sees condition, visible and empty tokens; H2 sees H1's output and the mask tokens
/// (docs/method.md, section 4.2).
struct MaskedTransformer : torch::nn::Module {
  MaskedTransformer(const StageSizes& sizes, const CompleterConfig& config);
  struct Output {
    Tensor context;  // [condition + visible + empty, C], H1's output
    Tensor tokens;   // [all, C], H2's output, same order, targets last
  };
  Output forward(const TokenSets& inputs, int level, const VoxelFrame& frame);

  const StageSizes sizes;
  const bool rotary_positions, position_code;
  const PositionConfig positions;
  std::array<Linear, kTokenKinds> embed{nullptr, nullptr, nullptr, nullptr};
  std::array<torch::nn::LayerNorm, kTokenKinds> embed_norm{nullptr, nullptr, nullptr, nullptr};
  Linear position_in{nullptr};
  std::vector<std::shared_ptr<SelfBlock>> h1, h2;
  torch::nn::LayerNorm out_norm{nullptr};
};

constexpr int kCoarseFeatures = 24;  // of a coarse node: its 8 children, one-hot F, E, U

struct CompleterNet : torch::nn::Module {
  explicit CompleterNet(const CompleterConfig& config);

  /// Occupancy logits [targets] of coarse nodes.
  Tensor coarseLogits(const TokenSets& inputs, const VoxelFrame& frame);
  struct Fine {
    Tensor logits;      // [targets]
    Tensor targets;     // [targets, C] tokens for the diffusion head
    Tensor conditions;  // [conditions, C] tokens for the refinement head
  };
  Fine fine(const TokenSets& inputs, const VoxelFrame& frame);

  /// Latents <-> unit deviation.
  Tensor standardise(const Tensor& z) { return (z - latent_mean) / latent_deviation; }
  /// Standardised predictions put back where latents lie: the encoder normalises each token's
  /// channel groups, a mean does not. Growth that sees what it made drifts without it; on its own a
  /// mean is the better colour.
  Tensor project(const Tensor& z) {
    return config.latent_groups ? standardise(torch::group_norm(restore(z), config.latent_groups))
                                : z;
  }
  Tensor restore(const Tensor& z) { return z * latent_deviation + latent_mean; }

  const CompleterConfig config;
  std::shared_ptr<MaskedTransformer> coarse, trunk;
  std::shared_ptr<OccupancyHead> coarse_occupancy, occupancy;
  std::shared_ptr<DiffusionHead> diffusion, refinement;
  Tensor latent_mean, latent_deviation;  // [D] buffers, from the training latents
};

}  // namespace vdbc
