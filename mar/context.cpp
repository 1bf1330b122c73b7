#include "mar/context.h"

#include <algorithm>

namespace vdbc {
namespace {

/// States of the 8 children of coarse nodes, one-hot F, E, U: [N, kCoarseFeatures].
Tensor coarseFeatures(const std::vector<Coord>& nodes, const SeenSpace& children) {
  Tensor features = torch::zeros({int64_t(nodes.size()), kCoarseFeatures});
  float* row = features.data_ptr<float>();
  const StateLookup state(children);
  for (const Coord& node : nodes) {
    for (int slot = 0; slot < 8; ++slot)
      row[3 * slot + 2 - int(state(childCoord(node, slot)))] = 1;  // F, E, U
    row += kCoarseFeatures;
  }
  return features;
}

}  // namespace

SceneTokens sceneTokens(const SeenSpace& nodes, const SeenSpace& coarse) {
  return {nodes, coarse, emptyShell(nodes), filledNodes(coarse), emptyShell(coarse)};
}

SceneTokens sceneIn(const SceneTokens& scene, const CoordBBox& voxels) {
  return sceneTokens(seenIn(scene.nodes, nodesIn(voxels, 1)),
                     seenIn(scene.coarse, nodesIn(voxels, 2)));
}

TokenSets coarseInputs(const SceneTokens& scene, const std::vector<Coord>& visible,
                       const std::vector<Coord>& targets, int empty_tokens) {
  TokenSets in;
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

std::vector<float> coarseProbability(CompleterNet& net, const SceneTokens& scene,
                                     const std::vector<Coord>& targets, const VoxelFrame& frame) {
  if (!net.config.coarse_stage) return std::vector<float>(targets.size(), 1.f);
  const TokenSets in = coarseInputs(scene, {}, targets, net.config.coarse_empty_tokens);
  const Tensor p = net.coarseLogits(in, frame).sigmoid().contiguous();
  return {p.data_ptr<float>(), p.data_ptr<float>() + p.numel()};
}

std::vector<Coord> unobservedChildren(const std::vector<Coord>& coarse, const SeenSpace& nodes) {
  const StateLookup state(nodes);
  std::vector<Coord> children;
  for (const Coord& c : coarse)
    for (int slot = 0; slot < 8; ++slot) {
      const Coord child = childCoord(c, slot);
      if (nodes.box.isInside(child) && state(child) == NodeState::kUnobserved)
        children.push_back(child);
    }
  return children;
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

Eigen::Vector3d centreOf(const std::vector<Coord>& coords) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Coord& c : coords) sum += Eigen::Vector3d(c.x(), c.y(), c.z());
  return sum / double(coords.size());
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

FineChunk fineChunk(const SceneTokens& scene, const Gate& gate, const std::vector<Coord>& context,
                    int64_t conditions, const std::vector<Coord>& targets,
                    const Eigen::Vector3d& centre, int context_tokens, int empty_tokens) {
  FineChunk chunk;
  for (int64_t row : nearestRows(context, centre, context_tokens)) {
    const size_t kind = row < conditions ? kCondition : kVisible;
    chunk.rows[kind].push_back(row);
    chunk.tokens[kind].coords.push_back(context[size_t(row)]);
  }
  chunk.tokens[kEmptyToken].coords = nearestOf(scene.empty_shell, centre, empty_tokens);
  std::vector<float> probability;
  for (const Coord& target : targets) {
    const float* found = gate.find(tokenCoord(target, 1));
    probability.push_back(found ? *found : 0.f);
  }
  chunk.tokens[kTarget] = {torch::tensor(probability).unsqueeze(1), targets};
  return chunk;
}

}  // namespace vdbc
