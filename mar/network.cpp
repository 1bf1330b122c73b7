#include "mar/network.h"

#include <algorithm>
#include <numeric>

namespace vdbc {

namespace nn = torch::nn;

MaskedTransformer::MaskedTransformer(const StageSizes& s, bool rotary_positions_,
                                     bool position_code_)
    : sizes(s), rotary_positions(rotary_positions_), position_code(position_code_) {
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

MaskedTransformer::Output MaskedTransformer::forward(
    const std::array<TokenSet, kTokenKinds>& inputs, int level, const VoxelFrame& frame) {
  std::vector<Tensor> tokens(kTokenKinds), coords(kTokenKinds);
  for (size_t k = 0; k < kTokenKinds; ++k) {
    const int64_t n = int64_t(inputs[k].coords.size());
    coords[k] = coordTensor(inputs[k].coords);
    const Tensor features = sizes.feature_dims[k] ? inputs[k].features : torch::ones({n, 1});
    tokens[k] = embed_norm[k]->forward(
        embed[k]->forward(features.view({n, std::max(1, sizes.feature_dims[k])})));
    if (position_code)
      tokens[k] =
          tokens[k] + position_in->forward(sinusoidalCode(tokenPositions(coords[k], level, frame)));
  }
  const Tensor all_coords = torch::cat(coords);
  const Rotary pos = rotary(all_coords, sizes.width / sizes.heads);
  const int64_t context = all_coords.size(0) - coords[kTarget].size(0);
  const Rotary context_pos{pos.cos.slice(0, 0, context), pos.sin.slice(0, 0, context)};
  constexpr int kFull = 1 << 30;  // full attention: one window holds everything
  Output out;
  Tensor x = torch::cat({tokens[kCondition], tokens[kVisible], tokens[kEmptyToken]});
  for (auto& block : h1)
    x = block->forward(x, rotary_positions ? &context_pos : nullptr, {}, kFull, false);
  out.context = x;
  x = torch::cat({x, tokens[kTarget]});
  for (auto& block : h2) x = block->forward(x, rotary_positions ? &pos : nullptr, {}, kFull, false);
  out.tokens = out_norm->forward(x);
  return out;
}

Tensor coarseFeatures(const std::vector<Coord>& nodes, const NodeStates& children) {
  Tensor features = torch::zeros({int64_t(nodes.size()), kCoarseFeatures});
  float* row = features.data_ptr<float>();
  for (const Coord& node : nodes) {
    for (int slot = 0; slot < 8; ++slot)
      row[3 * slot + 2 - int(children.at(childCoord(node, slot)))] = 1;  // F, E, U
    row += kCoarseFeatures;
  }
  return features;
}

CompleterNet::CompleterNet(const CompleterConfig& c) : config(c) {
  coarse = register_module("coarse",
                           std::make_shared<MaskedTransformer>(
                               StageSizes{c.coarse_width,
                                          c.coarse_heads,
                                          c.coarse_layers,
                                          {kCoarseFeatures, 0, kCoarseFeatures, kCoarseFeatures}},
                               c.rotary_positions, c.position_code));
  // Targets carry the coarse stage's probability of their parent.
  trunk = register_module(
      "trunk", std::make_shared<MaskedTransformer>(
                   StageSizes{c.width, c.heads, c.layers, {c.latent_dim, c.latent_dim, 0, 1}},
                   c.rotary_positions, c.position_code));
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

Tensor CompleterNet::coarseLogits(const std::array<TokenSet, kTokenKinds>& inputs,
                                  const VoxelFrame& frame) {
  const Tensor tokens = coarse->forward(inputs, 2, frame).tokens;
  const int64_t targets = int64_t(inputs[kTarget].coords.size());
  return coarse_occupancy->forward(tokens.slice(0, tokens.size(0) - targets));
}

void CompleterNet::coarseProbabilities(const SceneTokens& scene, const std::vector<Coord>& unknown,
                                       const VoxelFrame& frame,
                                       std::map<Coord, float>* probability) {
  for (const std::vector<Coord>& targets : chunksOf(unknown, config.coarse_chunk_tokens)) {
    const Tensor p =
        config.coarse_stage
            ? coarseLogits(coarseInputs(scene, {}, targets, config.coarse_empty_tokens), frame)
                  .sigmoid()
                  .contiguous()
            : torch::ones({int64_t(targets.size())});
    for (size_t i = 0; i < targets.size(); ++i) (*probability)[targets[i]] = p.data_ptr<float>()[i];
  }
}

CompleterNet::Fine CompleterNet::fine(const std::array<TokenSet, kTokenKinds>& inputs,
                                      const VoxelFrame& frame) {
  const Tensor tokens = trunk->forward(inputs, 1, frame).tokens;
  const int64_t targets = int64_t(inputs[kTarget].coords.size());
  Fine f;
  f.targets = tokens.slice(0, tokens.size(0) - targets);
  f.conditions = tokens.slice(0, 0, int64_t(inputs[kCondition].coords.size()));
  f.logits = occupancy->forward(f.targets);
  return f;
}

namespace {

bool touchesUnobserved(const NodeStates& s, const Coord& ijk) {
  for (int dx = -1; dx <= 1; ++dx)
    for (int dy = -1; dy <= 1; ++dy)
      for (int dz = -1; dz <= 1; ++dz) {
        const Coord n = ijk.offsetBy(dx, dy, dz);
        if (s.box.isInside(n) && s.at(n) == NodeState::kUnobserved) return true;
      }
  return false;
}

}  // namespace

SceneTokens sceneTokens(NodeStates nodes, NodeStates coarse) {
  SceneTokens t;
  for (auto i = nodes.box.begin(); i; ++i)
    if (nodes.at(*i) == NodeState::kEmpty && touchesUnobserved(nodes, *i))
      t.empty_shell.push_back(*i);
  for (auto i = coarse.box.begin(); i; ++i) switch (coarse.at(*i)) {
      case NodeState::kFilled:
        t.coarse_filled.push_back(*i);
        break;
      case NodeState::kUnobserved:
        t.coarse_unknown.push_back(*i);
        break;
      case NodeState::kEmpty:
        if (touchesUnobserved(coarse, *i)) t.coarse_empty.push_back(*i);
    }
  t.nodes = std::move(nodes), t.coarse = std::move(coarse);
  return t;
}

std::array<TokenSet, kTokenKinds> coarseInputs(const SceneTokens& scene,
                                               const std::vector<Coord>& visible,
                                               const std::vector<Coord>& targets,
                                               int empty_tokens) {
  std::array<TokenSet, kTokenKinds> in;
  in[kCondition] = {coarseFeatures(scene.coarse_filled, scene.nodes), scene.coarse_filled};
  in[kVisible] = {{}, visible};
  // An even share of the empty shell: every k-th, so that it outlines the whole seen space.
  const size_t most = size_t(empty_tokens),
               stride = most ? (scene.coarse_empty.size() + most - 1) / most : 0;
  for (size_t i = 0; stride && i < scene.coarse_empty.size(); i += stride)
    in[kEmptyToken].coords.push_back(scene.coarse_empty[i]);
  in[kEmptyToken].features = coarseFeatures(in[kEmptyToken].coords, scene.nodes);
  in[kTarget] = {coarseFeatures(targets, scene.nodes), targets};
  return in;
}

std::vector<int64_t> nearestRows(const std::vector<Coord>& coords, const Eigen::Vector3d& centre,
                                 int64_t count) {
  std::vector<std::pair<double, int64_t>> by_distance(coords.size());
  for (size_t i = 0; i < coords.size(); ++i)
    by_distance[i] = {
        (Eigen::Vector3d(coords[i].x(), coords[i].y(), coords[i].z()) - centre).squaredNorm(),
        int64_t(i)};
  const size_t n = std::min(coords.size(), size_t(count));
  std::partial_sort(by_distance.begin(), by_distance.begin() + std::ptrdiff_t(n),
                    by_distance.end());
  std::vector<int64_t> rows(n);
  for (size_t i = 0; i < n; ++i) rows[i] = by_distance[i].second;
  return rows;
}

std::vector<Coord> nearestOf(const std::vector<Coord>& coords, const Eigen::Vector3d& centre,
                             int64_t count) {
  std::vector<Coord> nearest;
  for (int64_t row : nearestRows(coords, centre, count)) nearest.push_back(coords[size_t(row)]);
  return nearest;
}

std::vector<std::vector<Coord>> chunksOf(const std::vector<Coord>& tokens, int64_t size) {
  const Tensor order = zOrder(tokens);
  const int64_t n = int64_t(tokens.size()), count = (n + size - 1) / size;
  std::vector<std::vector<Coord>> chunks(static_cast<size_t>(count));
  for (int64_t c = 0; c < count; ++c)
    for (int64_t i = c * n / count; i < (c + 1) * n / count; ++i)
      chunks[size_t(c)].push_back(tokens[size_t(order.data_ptr<int64_t>()[i])]);
  return chunks;
}

NodeStates statesIn(const NodeStates& s, const CoordBBox& voxels) {
  NodeStates part;
  part.level = s.level;
  part.box = CoordBBox(tokenCoord(voxels.min(), s.level), tokenCoord(voxels.max(), s.level));
  for (auto node = part.box.begin(); node; ++node) part.states.push_back(s.at(*node));
  return part;
}

std::vector<Coord> unobservedChildren(const std::vector<Coord>& coarse, const NodeStates& nodes) {
  std::vector<Coord> children;
  for (const Coord& c : coarse)
    for (int slot = 0; slot < 8; ++slot) {
      const Coord child = childCoord(c, slot);
      if (nodes.box.isInside(child) && nodes.at(child) == NodeState::kUnobserved)
        children.push_back(child);
    }
  return children;
}

}  // namespace vdbc
