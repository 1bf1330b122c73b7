// What a scene is to the networks: its tokens and what is around a chunk of them.
#include "mar/context.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>

#include "tests/toy_completer.h"

namespace vdbc {
namespace {

TEST(SceneTokens, ListNodesByStateAndShell) {
  const CompletionSample s = toySample();
  const SceneTokens t = sceneTokens(s.seen_nodes, s.seen_coarse);
  const auto listed = [](const std::vector<Coord>& coords, const Coord& c) {
    return std::count(coords.begin(), coords.end(), c);
  };
  const auto touches = [](const SeenSpace& space, const Coord& c) {
    for (auto n = CoordBBox(c.offsetBy(-1), c.offsetBy(1)).begin(); n; ++n)
      if (space.box.isInside(*n) && space.at(*n) == NodeState::kUnobserved) return true;
    return false;
  };
  for (auto c = s.seen_nodes.box.begin(); c; ++c)
    EXPECT_EQ(listed(t.empty_shell, *c),
              s.seen_nodes.at(*c) == NodeState::kEmpty && touches(s.seen_nodes, *c));
  const std::vector<Coord> coarse_unknown = unobservedNodes(t.coarse, t.coarse.box);
  for (auto c = s.seen_coarse.box.begin(); c; ++c) {
    const NodeState state = s.seen_coarse.at(*c);
    EXPECT_EQ(listed(t.coarse_filled, *c), state == NodeState::kFilled);
    EXPECT_EQ(listed(coarse_unknown, *c), state == NodeState::kUnobserved);
    EXPECT_EQ(listed(t.coarse_empty, *c), state == NodeState::kEmpty && touches(s.seen_coarse, *c));
  }
}

TEST(SceneTokens, CoarseFeaturesAreTheStatesOfTheChildren) {
  const CompletionSample s = toySample();
  const std::vector<Coord> nodes = {Coord(0, 0, 0), Coord(2, 3, 1), Coord(5, 4, 2)};
  // As targets and, those that are, as condition and empty tokens.
  const SceneTokens t = sceneTokens(s.seen_nodes, s.seen_coarse);
  const TokenSets in = coarseInputs(t, {}, nodes, 1000);
  const auto expectChildren = [&](const TokenSet& set) {
    ASSERT_EQ(set.features.sizes(), (std::vector<int64_t>{int64_t(set.coords.size()), 24}));
    for (size_t i = 0; i < set.coords.size(); ++i)
      for (int slot = 0; slot < 8; ++slot) {
        const NodeState state = s.seen_nodes.at(childCoord(set.coords[i], slot));
        const Tensor f = set.features[int64_t(i)];
        EXPECT_EQ(f[3 * slot].item<float>(), state == NodeState::kFilled);
        EXPECT_EQ(f[3 * slot + 1].item<float>(), state == NodeState::kEmpty);
        EXPECT_EQ(f[3 * slot + 2].item<float>(), state == NodeState::kUnobserved);
      }
  };
  EXPECT_EQ(in[kTarget].coords, nodes);
  EXPECT_EQ(in[kCondition].coords, t.coarse_filled);
  EXPECT_EQ(in[kEmptyToken].coords, t.coarse_empty);
  for (size_t kind : {kTarget, kCondition, kEmptyToken}) expectChildren(in[kind]);
}

TEST(SceneTokens, NearestRowsEqualASortByDistance) {
  std::mt19937 random(15);
  std::vector<Coord> coords;
  for (int i = 0; i < 200; ++i)
    coords.push_back(Coord(int(random() % 15), int(random() % 15), int(random() % 15)));
  const Eigen::Vector3d centre(7.25, 6.5, 3);
  std::vector<int64_t> truth(200);
  for (int64_t i = 0; i < 200; ++i) truth[size_t(i)] = i;
  std::stable_sort(truth.begin(), truth.end(), [&](int64_t a, int64_t b) {
    const auto distance = [&](int64_t i) {
      const Coord& c = coords[size_t(i)];
      return (Eigen::Vector3d(c.x(), c.y(), c.z()) - centre).squaredNorm();
    };
    return distance(a) < distance(b);
  });
  const std::vector<int64_t> all = nearestRows(coords, centre, 1000);
  EXPECT_EQ(all, truth);
  truth.resize(30);
  EXPECT_EQ(nearestRows(coords, centre, 30), truth);
  std::vector<Coord> nearest;
  for (int64_t row : truth) nearest.push_back(coords[size_t(row)]);
  EXPECT_EQ(nearestOf(coords, centre, 30), nearest);
}

TEST(SceneTokens, InABoxAreThoseThereAndUnobservedBeyond) {
  const CompletionSample s = toySample();
  const SceneTokens scene = sceneTokens(s.seen_nodes, s.seen_coarse);
  const CoordBBox bounds = s.condition.frame.bounds;
  const CoordBBox box(bounds.min() + Coord(4, -8, 0), bounds.max() + Coord(8, -4, 0));
  const SceneTokens part = sceneIn(scene, box);
  EXPECT_EQ(part.nodes.level, 1);
  EXPECT_EQ(part.coarse.level, 2);
  EXPECT_EQ(part.nodes.box, CoordBBox(Coord(2, -4, 0), Coord(15, 7, 5)));
  EXPECT_EQ(part.coarse.box, CoordBBox(Coord(1, -2, 0), Coord(7, 3, 2)));
  for (const auto& [whole, in_box] :
       {std::pair(&scene.nodes, &part.nodes), std::pair(&scene.coarse, &part.coarse)}) {
    int inside = 0;
    for (auto node = in_box->box.begin(); node; ++node) {
      inside += whole->box.isInside(*node);
      EXPECT_EQ(in_box->at(*node), whole->at(*node));
    }
    EXPECT_GT(inside, 0);
    EXPECT_LT(inside, int(in_box->box.volume()));
    for (auto node = whole->box.begin(); node; ++node)
      if (!in_box->box.isInside(*node)) {
        EXPECT_EQ(in_box->at(*node), NodeState::kUnobserved);
      }
  }
  EXPECT_EQ(part.coarse_filled, filledNodes(part.coarse));
  EXPECT_EQ(part.coarse_empty, emptyShell(part.coarse));
  EXPECT_EQ(part.empty_shell, emptyShell(part.nodes));
}

TEST(SceneTokens, ChunksAreEqualPartsOfNeighbours) {
  std::mt19937 random(4);
  std::vector<Coord> tokens;
  for (auto c = CoordBBox(Coord(-3, 0, 2), Coord(4, 7, 9)).begin(); c; ++c)
    if (random() % 5) tokens.push_back(*c);
  for (const int64_t size : {1, 7, 100, 1000}) {
    const std::vector<std::vector<Coord>> chunks = chunksOf(tokens, size);
    std::vector<Coord> all;
    size_t least = tokens.size(), most = 0;
    for (const std::vector<Coord>& chunk : chunks) {
      all.insert(all.end(), chunk.begin(), chunk.end());
      least = std::min(least, chunk.size()), most = std::max(most, chunk.size());
    }
    EXPECT_LE(int64_t(most), size);
    EXPECT_LE(most - least, 1u);
    EXPECT_EQ(int64_t(chunks.size()), (int64_t(tokens.size()) + size - 1) / size);
    std::vector<Coord> sorted = tokens;
    std::sort(all.begin(), all.end()), std::sort(sorted.begin(), sorted.end());
    EXPECT_EQ(all, sorted);
  }
  // Eight octants in chunks of an octant: each chunk is one.
  std::vector<Coord> cube;
  for (auto c = CoordBBox(Coord(0), Coord(7)).begin(); c; ++c) cube.push_back(*c);
  for (const std::vector<Coord>& chunk : chunksOf(cube, 64))
    for (const Coord& c : chunk) EXPECT_EQ(tokenCoord(c, 2), tokenCoord(chunk[0], 2));
  EXPECT_TRUE(chunksOf({}, 5).empty());
}

TEST(SceneTokens, UnobservedChildrenAreThoseInTheVolume) {
  const CompletionSample s = toySample();
  std::vector<Coord> truth;
  const std::vector<Coord> parents = {Coord(2, 1, 0), Coord(0, 0, 0), Coord(5, 4, 2),
                                      Coord(6, 0, 0)};  // the last one lies outside
  for (const Coord& parent : parents)
    for (int slot = 0; slot < 8; ++slot) {
      const Coord c = childCoord(parent, slot);
      if (s.seen_nodes.box.isInside(c) && s.seen_nodes.at(c) == NodeState::kUnobserved)
        truth.push_back(c);
    }
  EXPECT_FALSE(truth.empty());
  EXPECT_EQ(unobservedChildren(parents, s.seen_nodes), truth);
}

TEST(FineChunk, HoldsTheNearestOfEachKindAndTheGatesProbabilities) {
  const CompletionSample s = toySample();
  const SceneTokens scene = sceneTokens(s.seen_nodes, s.seen_coarse);
  std::vector<Coord> context = s.condition.ijk;
  const int64_t conditions = s.condition.size();
  context.insert(context.end(), {Coord(5, 2, 1), Coord(6, 3, 1), Coord(11, 0, 1)});
  const std::vector<Coord> targets = {Coord(6, 2, 1), Coord(6, 2, 2), Coord(8, 2, 1)};
  Gate gate;
  gate.set(Coord(3, 1, 0), .25f), gate.set(Coord(3, 1, 1), .5f);
  const Eigen::Vector3d centre = centreOf(targets);
  EXPECT_LT((centre - Eigen::Vector3d(20. / 3, 2, 4. / 3)).norm(), 1e-12);
  const FineChunk chunk = fineChunk(scene, gate, context, conditions, targets, centre, 9, 5);
  std::vector<int64_t> rows[2];
  std::vector<Coord> coords[2];
  for (int64_t row : nearestRows(context, centre, 9)) {
    rows[row >= conditions].push_back(row);
    coords[row >= conditions].push_back(context[size_t(row)]);
  }
  EXPECT_EQ(rows[1].size(), 2u) << "the third generated token is farther than nine others";
  for (size_t kind : {kCondition, kVisible}) {
    EXPECT_EQ(chunk.rows[kind], rows[kind]);
    EXPECT_EQ(chunk.tokens[kind].coords, coords[kind]);
  }
  EXPECT_EQ(chunk.tokens[kEmptyToken].coords, nearestOf(scene.empty_shell, centre, 5));
  EXPECT_EQ(chunk.tokens[kTarget].coords, targets);
  // The third target's parent was never asked.
  EXPECT_TRUE(
      torch::equal(chunk.tokens[kTarget].features, torch::tensor({.25f, .5f, 0.f}).unsqueeze(1)));
}

TEST(CoarseStage, SeesAnEvenShareOfTheEmptyShellAndIsOneWhereThereIsNone) {
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const SceneTokens scene = sceneTokens(s.seen_nodes, s.seen_coarse);
  const std::vector<Coord> targets = unobservedNodes(scene.coarse, scene.coarse.box);
  const size_t all = scene.coarse_empty.size();
  ASSERT_GT(all, 2u);
  EXPECT_TRUE(coarseInputs(scene, {}, targets, 0)[kEmptyToken].coords.empty());
  const std::vector<Coord> half =
      coarseInputs(scene, {}, targets, int(all + 1) / 2)[kEmptyToken].coords;
  for (size_t i = 0; i < half.size(); ++i) EXPECT_EQ(half[i], scene.coarse_empty[2 * i]);
  EXPECT_EQ(half.size(), (all + 1) / 2);
  CompleterConfig c = toyConfig();
  const auto net = makeNet(c, 15);
  const Tensor p =
      net->coarseLogits(coarseInputs(scene, {}, targets, c.coarse_empty_tokens), s.condition.frame)
          .sigmoid();
  const std::vector<float> found = coarseProbability(*net, scene, targets, s.condition.frame);
  ASSERT_EQ(found.size(), targets.size());
  for (size_t i = 0; i < found.size(); ++i) EXPECT_EQ(found[i], p[int64_t(i)].item<float>());
  c.coarse_stage = false;
  EXPECT_EQ(coarseProbability(*makeNet(c, 15), scene, targets, s.condition.frame),
            std::vector<float>(targets.size(), 1.f));
}

}  // namespace
}  // namespace vdbc
