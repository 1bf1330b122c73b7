#pragma once
// A toy scene, a floor and a wall of which the near half is seen, and completers of toy size.
#include <cmath>
#include <deque>
#include <map>
#include <memory>
#include <set>
#include <vector>

#include "mar/completer_train.h"
#include "mar/network.h"
#include "vdb/seen.h"

namespace vdbc {

constexpr int kDim = 8;

inline void setState(SeenSpace* space, const Coord& node, NodeState state) {
  space->filled.setActiveState(node, state == NodeState::kFilled);
  space->empty.setActiveState(node, state == NodeState::kEmpty);
}

/// The parents, by the rule: F if any child is, E if all are.
inline void setParents(const SeenSpace& nodes, SeenSpace* parents) {
  parents->level = nodes.level + 1;
  parents->box = CoordBBox(tokenCoord(nodes.box.min(), 1), tokenCoord(nodes.box.max(), 1));
  for (auto c = parents->box.begin(); c; ++c) {
    int filled = 0, empty = 0;
    for (int slot = 0; slot < 8; ++slot) {
      const NodeState state = nodes.at(childCoord(*c, slot));
      filled += state == NodeState::kFilled, empty += state == NodeState::kEmpty;
    }
    setState(parents, *c,
             filled       ? NodeState::kFilled
             : empty == 8 ? NodeState::kEmpty
                          : NodeState::kUnobserved);
  }
}

inline Place observedPlace(const SeenSpace& nodes, const VoxelFrame& frame) {
  Place place;
  place.frame = frame, place.dim = kDim;
  for (auto c = nodes.box.begin(); c; ++c) {
    if (nodes.at(*c) != NodeState::kFilled) continue;
    place.ijk.push_back(*c);
    for (int d = 0; d < kDim; ++d)
      place.z.push_back(
          std::sin(.3f * float((*c).x() * (d + 1)) + float((*c).z() == 1) * float(d)));
  }
  place.generated.assign(place.ijk.size(), 0);
  place.probability.assign(place.ijk.size(), 1.f);
  place.bfs_level.assign(place.ijk.size(), 0);
  return place;
}

/// 12 x 10 x 6 nodes; the condition sees x < `seen_x` up to the wall, the dense views all but the
/// lowest and the highest layer.
inline CompletionSample toySample(int seen_x = 5) {
  CompletionSample s;
  VoxelFrame frame;
  frame.bounds = CoordBBox(Coord(0), Coord(23, 19, 11));
  s.seen_nodes.level = s.target_nodes.level = 1;
  s.seen_nodes.box = s.target_nodes.box = CoordBBox(Coord(0), Coord(11, 9, 5));
  for (auto c = s.target_nodes.box.begin(); c; ++c) {
    const Coord ijk = *c;
    if (ijk.z() == 5 || ijk.z() == 0) continue;  // nobody sees there
    const bool solid = ijk.z() == 1 || ijk.y() == 9;
    setState(&s.target_nodes, ijk, solid ? NodeState::kFilled : NodeState::kEmpty);
    if (ijk.x() < seen_x) setState(&s.seen_nodes, ijk, s.target_nodes.at(ijk));
  }
  setParents(s.seen_nodes, &s.seen_coarse), setParents(s.target_nodes, &s.target_coarse);
  s.condition = observedPlace(s.seen_nodes, frame);
  s.target = observedPlace(s.target_nodes, frame);
  return s;
}

/// The condition with what was seen, as the completer takes it.
inline Place startOf(const CompletionSample& sample) {
  const auto seen = std::make_shared<SeenSpace>();
  seen->box = sample.condition.frame.bounds;
  for (auto c = sample.seen_nodes.box.begin(); c; ++c)
    for (int slot = 0; slot < 8; ++slot)
      setState(seen.get(), childCoord(*c, slot), sample.seen_nodes.at(*c));
  Place start = sample.condition;
  start.seen = seen;
  return start;
}

inline CompleterConfig toyConfig() {
  CompleterConfig c;
  c.preset = "toy", c.latent_dim = kDim, c.latent_groups = kDim / 4;
  c.width = 24, c.heads = 2, c.layers = 2, c.coarse_width = 16, c.coarse_heads = 1;
  c.diffusion_width = 16, c.diffusion_steps = 100;
  c.context_tokens = 40, c.empty_tokens = 12, c.chunk_tokens = 16, c.coarse_empty_tokens = 8;
  return c;
}

inline std::shared_ptr<CompleterNet> makeNet(const CompleterConfig& c, uint64_t seed) {
  torch::manual_seed(seed);
  auto net = std::make_shared<CompleterNet>(c);
  torch::NoGradGuard no_grad;
  // Spreads the probabilities, which a fresh network puts all near one half.
  net->occupancy->third->weight.mul_(4), net->coarse_occupancy->third->weight.mul_(4);
  net->latent_mean.fill_(-.42), net->latent_deviation.fill_(.33);
  return net;
}

inline int64_t parameterCount(const torch::nn::Module& module) {
  int64_t n = 0;
  for (const Tensor& p : module.parameters()) n += p.numel();
  return n;
}

inline double largestDifference(const Tensor& a, const Tensor& b) {
  return (a - b).abs().max().item<double>();
}

/// Distance of each candidate from the seeds by a plain queue, 26 neighbours.
inline std::map<Coord, int> serialLevels(const std::vector<Coord>& candidates,
                                         const std::vector<Coord>& seeds) {
  const std::set<Coord> open(candidates.begin(), candidates.end());
  std::map<Coord, int> level;
  std::deque<std::pair<Coord, int>> queue;
  for (const Coord& s : seeds) queue.push_back({s, 0});
  while (!queue.empty()) {
    const auto [at, depth] = queue.front();
    queue.pop_front();
    for (auto n = CoordBBox(at.offsetBy(-1), at.offsetBy(1)).begin(); n; ++n)
      if (open.count(*n) && level.insert({*n, depth + 1}).second) queue.push_back({*n, depth + 1});
  }
  return level;
}

}  // namespace vdbc
