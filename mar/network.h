#pragma once
// Private: the completer as torch modules, and how scenes become its inputs.
#include <array>
#include <map>

#include "encoder/layers.h"
#include "mar/completer.h"
#include "mar/heads.h"

namespace vdbc {

/// Tokens of one kind: features [n, D] (D = 0 where position is all), coordinates of a tree level.
struct TokenSet {
  Tensor features;
  std::vector<Coord> coords;
};

/// Inputs in the order H1 and H2 see them; each kind has its own linear layer and LayerNorm (A4).
enum TokenKind { kCondition, kVisible, kEmptyToken, kTarget, kTokenKinds };

struct StageSizes {
  int width, heads, layers;
  std::array<int, kTokenKinds> feature_dims;
};

/// H1 sees condition, visible and empty tokens; H2 sees H1's output and the mask tokens (A4).
struct MaskedTransformer : torch::nn::Module {
  MaskedTransformer(const StageSizes& sizes, bool rotary_positions, bool position_code);
  struct Output {
    Tensor context;  // [condition + visible + empty, C], H1's output
    Tensor tokens;   // [all, C], H2's output, same order, targets last
  };
  Output forward(const std::array<TokenSet, kTokenKinds>& inputs, int level,
                 const VoxelFrame& frame);

  const StageSizes sizes;
  const bool rotary_positions, position_code;
  std::array<Linear, kTokenKinds> embed{nullptr, nullptr, nullptr, nullptr};
  std::array<torch::nn::LayerNorm, kTokenKinds> embed_norm{nullptr, nullptr, nullptr, nullptr};
  Linear position_in{nullptr};
  std::vector<std::shared_ptr<SelfBlock>> h1, h2;
  torch::nn::LayerNorm out_norm{nullptr};
};

/// States of the 8 children of coarse nodes, one-hot F, E, U: [N, 24].
constexpr int kCoarseFeatures = 24;
Tensor coarseFeatures(const std::vector<Coord>& nodes, const NodeStates& children);

/// What is known of a scene, as token lists of both levels.
struct SceneTokens {
  NodeStates nodes, coarse;           // levels 1 and 2
  std::vector<Coord> empty_shell;     // level-1 E nodes with an unobserved neighbour
  std::vector<Coord> coarse_filled;   // level-2 nodes with an F voxel
  std::vector<Coord> coarse_empty;    // level-2 E nodes with an unobserved neighbour
  std::vector<Coord> coarse_unknown;  // level-2 nodes with no F and some U voxel
};
SceneTokens sceneTokens(NodeStates nodes, NodeStates coarse);

struct CompleterNet : torch::nn::Module {
  explicit CompleterNet(const CompleterConfig& config);

  /// Occupancy logits [targets] of coarse nodes.
  Tensor coarseLogits(const std::array<TokenSet, kTokenKinds>& inputs, const VoxelFrame& frame);
  /// Their probabilities as inference asks for them, in chunks of neighbours; 1 without a coarse
  /// stage.
  void coarseProbabilities(const SceneTokens& scene, const std::vector<Coord>& unknown,
                           const VoxelFrame& frame, std::map<Coord, float>* probability);
  struct Fine {
    Tensor logits;      // [targets]
    Tensor targets;     // [targets, C] tokens for the diffusion head
    Tensor conditions;  // [conditions, C] tokens for the refinement head
  };
  Fine fine(const std::array<TokenSet, kTokenKinds>& inputs, const VoxelFrame& frame);

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

/// Inputs of the coarse stage for some target positions.
std::array<TokenSet, kTokenKinds> coarseInputs(const SceneTokens& scene,
                                               const std::vector<Coord>& visible,
                                               const std::vector<Coord>& targets, int empty_tokens);

/// The `count` of `coords` nearest to `centre`, by distance, ties by row: row indices.
std::vector<int64_t> nearestRows(const std::vector<Coord>& coords, const Eigen::Vector3d& centre,
                                 int64_t count);
/// Their coordinates.
std::vector<Coord> nearestOf(const std::vector<Coord>& coords, const Eigen::Vector3d& centre,
                             int64_t count);

/// Parts of at most `size`, about equal, of tokens that lie together.
std::vector<std::vector<Coord>> chunksOf(const std::vector<Coord>& tokens, int64_t size);

/// The states of the nodes in a box of voxels; unobserved where `states` has none.
NodeStates statesIn(const NodeStates& states, const CoordBBox& voxels);

/// Level-1 nodes of the given coarse nodes that were not observed.
std::vector<Coord> unobservedChildren(const std::vector<Coord>& coarse, const NodeStates& nodes);

}  // namespace vdbc
