#include "mar/network.h"

namespace vdbc {

namespace nn = torch::nn;

MaskedTransformer::MaskedTransformer(const StageSizes& s, const CompleterConfig& c)
    : sizes(s),
      rotary_positions(c.rotary_positions),
      position_code(c.position_code),
      positions(c.positions) {
  static const char* const kNames[] = {"condition", "visible", "empty", "target"};
  for (size_t k = 0; k < kTokenKinds; ++k) {
    // Kinds without features learn one vector: the bias of a linear layer of constant input.
    embed[k] = register_module(std::string("embed_") + kNames[k],
                               Linear(std::max(1, s.feature_dims[k]), s.width));
    embed_norm[k] = register_module(std::string("norm_") + kNames[k],
                                    nn::LayerNorm(nn::LayerNormOptions({s.width})));
  }
  position_in = register_module("position_in", Linear(kSinusoidalDim, s.width));
  for (int i = 0; i < s.layers; ++i) {
    h1.push_back(
        register_module("h1_" + std::to_string(i), std::make_shared<SelfBlock>(s.width, s.heads)));
    h2.push_back(
        register_module("h2_" + std::to_string(i), std::make_shared<SelfBlock>(s.width, s.heads)));
  }
  out_norm = register_module("out_norm", nn::LayerNorm(nn::LayerNormOptions({s.width})));
}

MaskedTransformer::Output MaskedTransformer::forward(const TokenSets& inputs, int level,
                                                     const VoxelFrame& frame) {
  std::vector<Tensor> tokens(kTokenKinds), coords(kTokenKinds);
  for (size_t k = 0; k < kTokenKinds; ++k) {
    const int64_t n = int64_t(inputs[k].coords.size());
    coords[k] = coordTensor(inputs[k].coords);
    const Tensor features = sizes.feature_dims[k] ? inputs[k].features : torch::ones({n, 1});
    tokens[k] = embed_norm[k]->forward(
        embed[k]->forward(features.view({n, std::max(1, sizes.feature_dims[k])})));
    if (position_code)
      tokens[k] =
          tokens[k] +
          position_in->forward(sinusoidalCode(tokenPositions(coords[k], level, frame, positions)));
  }
  const Tensor all_coords = torch::cat(coords);
  const Rotary pos = rotary(all_coords, sizes.width / sizes.heads, positions);
  const int64_t context = all_coords.size(0) - coords[kTarget].size(0);
  const Rotary context_pos{pos.cos.slice(0, 0, context), pos.sin.slice(0, 0, context)};
  Output out;
  Tensor x = torch::cat({tokens[kCondition], tokens[kVisible], tokens[kEmptyToken]});
  for (auto& block : h1) x = block->forward(x, rotary_positions ? &context_pos : nullptr);
  out.context = x;
  x = torch::cat({x, tokens[kTarget]});
  for (auto& block : h2) x = block->forward(x, rotary_positions ? &pos : nullptr);
  out.tokens = out_norm->forward(x);
  return out;
}

CompleterNet::CompleterNet(const CompleterConfig& c) : config(c) {
  coarse = register_module("coarse",
                           std::make_shared<MaskedTransformer>(
                               StageSizes{c.coarse_width,
                                          c.coarse_heads,
                                          c.coarse_layers,
                                          {kCoarseFeatures, 0, kCoarseFeatures, kCoarseFeatures}},
                               c));
  // Targets carry the coarse stage's probability of their parent.
  trunk = register_module(
      "trunk", std::make_shared<MaskedTransformer>(
                   StageSizes{c.width, c.heads, c.layers, {c.latent_dim, c.latent_dim, 0, 1}}, c));
  coarse_occupancy =
      register_module("coarse_occupancy", std::make_shared<OccupancyHead>(c.coarse_width));
  occupancy = register_module("occupancy", std::make_shared<OccupancyHead>(c.width));
  auto head = [&] {
    return std::make_shared<DiffusionHead>(c.width, c.latent_dim, c.diffusion_width,
                                           c.diffusion_steps);
  };
  diffusion = register_module("diffusion", head());
  refinement = register_module("refinement", head());
  latent_mean = register_buffer("latent_mean", torch::zeros({c.latent_dim}));
  latent_deviation = register_buffer("latent_deviation", torch::ones({c.latent_dim}));
  initialiseXavier(*this);
  diffusion->zeroStart(), refinement->zeroStart();
}

Tensor CompleterNet::coarseLogits(const TokenSets& inputs, const VoxelFrame& frame) {
  const Tensor tokens = coarse->forward(inputs, 2, frame).tokens;
  const int64_t targets = int64_t(inputs[kTarget].coords.size());
  return coarse_occupancy->forward(tokens.slice(0, tokens.size(0) - targets));
}

CompleterNet::Fine CompleterNet::fine(const TokenSets& inputs, const VoxelFrame& frame) {
  const Tensor tokens = trunk->forward(inputs, 1, frame).tokens;
  const int64_t targets = int64_t(inputs[kTarget].coords.size());
  Fine f;
  f.targets = tokens.slice(0, tokens.size(0) - targets);
  f.conditions = tokens.slice(0, 0, int64_t(inputs[kCondition].coords.size()));
  f.logits = occupancy->forward(f.targets);
  return f;
}

}  // namespace vdbc
