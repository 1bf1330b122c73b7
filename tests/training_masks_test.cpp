// Laws of what a training step hides (docs/method.md, section 5.3).
#include "mar/training_masks.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>

#include "tests/toy_completer.h"

namespace vdbc {
namespace {

/// Largest difference of the draws' distribution from the uniform one on [low, high].
double distanceFromUniform(std::vector<double> draws, double low, double high) {
  std::sort(draws.begin(), draws.end());
  double worst = 0;
  for (size_t i = 0; i < draws.size(); ++i)
    worst = std::max(
        worst, std::abs((double(i) + .5) / double(draws.size()) - (draws[i] - low) / (high - low)));
  return worst;
}

TEST(Masks, CoarseSharesAreDrawnAsTheMethodSays) {  // section 5.3
  std::vector<Coord> unknown;
  for (auto c = CoordBBox(Coord(0), Coord(9, 9, 9)).begin(); c; ++c) unknown.push_back(*c);
  SeenSpace truth;
  truth.level = 2, truth.box = CoordBBox(Coord(0), Coord(9, 9, 9));
  truth.filled.sparseFill(truth.box, true, true);
  torch::Generator random = at::detail::createCPUGenerator(16);
  std::vector<double> worked_on, hidden;
  int all_hidden = 0;
  for (int i = 0; i < 1500; ++i) {
    const CoarseMask m = drawCoarseMask(unknown, truth, random);
    std::set<Coord> both(m.visible.begin(), m.visible.end());
    both.insert(m.targets.begin(), m.targets.end());
    ASSERT_EQ(both.size(), m.visible.size() + m.targets.size()) << "visible and targets overlap";
    worked_on.push_back(double(both.size()) / 1000);
    if (m.visible.empty())
      ++all_hidden;
    else
      hidden.push_back(double(m.targets.size()) / double(both.size()));
  }
  EXPECT_LT(distanceFromUniform(worked_on, .3, 1), .05);
  EXPECT_NEAR(all_hidden / 1500., .5, .05);
  EXPECT_LT(distanceFromUniform(hidden, .5, 1), .08);
}

TEST(Masks, OnlyFilledNodesAreShown) {  // section 5.3
  const CompletionSample s = toySample();
  const std::vector<Coord> unknown = unobservedNodes(s.seen_coarse, s.seen_coarse.box);
  torch::Generator random = at::detail::createCPUGenerator(17);
  size_t shown = 0;
  for (int i = 0; i < 200; ++i)
    for (const Coord& c : drawCoarseMask(unknown, s.target_coarse, random).visible) {
      EXPECT_EQ(s.target_coarse.at(c), NodeState::kFilled);
      ++shown;
    }
  EXPECT_GT(shown, 0u);
}
TEST(Masks, FineMasksShowNothingOrGrowthStatesOrRandomHoles) {  // sections 4.1 and 5.3
  // A corridor of six empty nodes leads to a filled block: no growth state gets that far.
  CompletionSample s;
  const CoordBBox box(Coord(0), Coord(14, 5, 5));
  s.target_nodes.level = 1, s.target_nodes.box = box;
  s.condition.ijk = {Coord(0, 0, 0)};
  std::vector<Coord> candidates;
  for (int x = 1; x <= 6; ++x) candidates.push_back(Coord(x, 0, 0));
  for (auto c = CoordBBox(Coord(7, 0, 0), Coord(14, 5, 5)).begin(); c; ++c) {
    candidates.push_back(*c);
    setState(&s.target_nodes, *c, NodeState::kFilled);
  }
  const double filled = double(candidates.size() - 6);
  torch::Generator random = at::detail::createCPUGenerator(18);
  std::vector<double> hidden;
  int growth = 0;
  for (int i = 0; i < 2400; ++i) {
    const FineMask m = drawFineMask(candidates, s, toyConfig(), random);
    if (m.visible.empty())
      ++growth;
    else
      hidden.push_back(1 - double(m.visible.size()) / filled);
  }
  EXPECT_NEAR(growth / 2400., .875, .035);
  EXPECT_LT(distanceFromUniform(hidden, .5, 1), .1);
}

TEST(Masks, FineMasksPartitionTheCandidates) {  // sections 4.1 and 5.3
  const CompletionSample s = toySample();
  const std::vector<Coord> candidates = unobservedNodes(s.seen_nodes, s.seen_nodes.box);
  const std::map<Coord, int> level = serialLevels(candidates, s.condition.ijk);
  torch::Generator random = at::detail::createCPUGenerator(19);
  std::set<int> depths, asked_alone;
  size_t wrong = 0, total = 0;
  for (int i = 0; i < 1200; ++i) {
    const FineMask m = drawFineMask(candidates, s, toyConfig(), random);
    std::set<Coord> seen;
    size_t n = 0;
    for (const auto* part : {&m.visible, &m.false_visible, &m.frontier, &m.others})
      seen.insert(part->begin(), part->end()), n += part->size();
    ASSERT_EQ(n, candidates.size());
    ASSERT_EQ(seen, std::set<Coord>(candidates.begin(), candidates.end()));
    for (const Coord& c : m.visible) ASSERT_EQ(s.target_nodes.at(c), NodeState::kFilled);
    for (const Coord& c : m.false_visible) ASSERT_NE(s.target_nodes.at(c), NodeState::kFilled);
    if (m.visible.empty() &&
        m.false_visible.empty()) {  // nothing but the condition tokens: one level is asked
      const int asked = level.at(m.frontier.at(0));
      for (const Coord& c : m.frontier) EXPECT_EQ(level.at(c), asked);
      asked_alone.insert(asked);
      continue;
    }
    wrong += m.false_visible.size(), total += candidates.size();
    // The frontier touches what is visible. In a growth state all that is filled up to a level is.
    std::set<Coord> context(s.condition.ijk.begin(), s.condition.ijk.end());
    int deepest = 0, nearest_hidden = 1 << 20;
    for (const Coord& c : m.visible) deepest = std::max(deepest, level.at(c)), context.insert(c);
    for (const auto* part : {&m.frontier, &m.others})
      for (const Coord& c : *part)
        if (s.target_nodes.at(c) == NodeState::kFilled)
          nearest_hidden = std::min(nearest_hidden, level.at(c));
    if (deepest < nearest_hidden) {
      depths.insert(deepest);
      for (const Coord& c : m.frontier) EXPECT_EQ(level.at(c), deepest + 1);
    } else {
      for (const Coord& c : m.frontier)
        EXPECT_TRUE(std::any_of(context.begin(), context.end(), [&](const Coord& n) {
          const Coord d = n - c;
          return std::max({std::abs(d.x()), std::abs(d.y()), std::abs(d.z())}) <= 1;
        }));
    }
  }
  EXPECT_EQ(depths, (std::set<int>{1, 2, 3, 4, 5}));
  for (const auto& entry : level) EXPECT_TRUE(asked_alone.count(entry.second)) << entry.second;
  EXPECT_GT(wrong, 0u);
  EXPECT_LT(double(wrong), .06 * double(total));
}

TEST(Masks, BoundsAreTheSamplesOwnOrAroundOrWithinThem) {
  const CompletionSample s = toySample();
  const CoordBBox own = s.condition.frame.bounds;
  torch::Generator random = at::detail::createCPUGenerator(20);
  int kept = 0, outwards = 0, inwards = 0;
  for (int i = 0; i < 600; ++i) {
    const CoordBBox b = drawBounds(s, toyConfig(), random);
    kept += b == own;
    bool holds = false;
    for (const Coord& token : s.condition.ijk) holds |= b.isInside(firstVoxel(token, 1));
    EXPECT_TRUE(holds);
    for (int axis = 0; axis < 3; ++axis) {
      EXPECT_EQ((b.min()[axis] - own.min()[axis]) % 4, 0);
      EXPECT_EQ((b.max()[axis] - own.max()[axis]) % 4, 0);
      EXPECT_LE(static_cast<float>(b.dim()[axis]) * s.condition.frame.voxel_m, 16.01F);
      EXPECT_GT(b.dim()[axis], 0);
      outwards += b.min()[axis]<own.min()[axis], inwards += b.min()[axis]> own.min()[axis];
    }
  }
  EXPECT_NEAR(kept, 300, 60);
  EXPECT_GT(outwards, 100);
  EXPECT_GT(inwards, 20);
}

TEST(Masks, SharesAreThoseOfTheConfiguration) {
  const CompletionSample s = toySample();
  const std::vector<Coord> candidates = unobservedNodes(s.seen_nodes, s.seen_nodes.box);
  const CoordBBox own = s.condition.frame.bounds;
  CompleterConfig c = toyConfig();
  const auto share = [&](const auto& drawn) {
    torch::Generator random = at::detail::createCPUGenerator(21);
    int n = 0;
    for (int i = 0; i < 400; ++i) n += drawn(random);
    return n / 400.;
  };
  const auto shows = [&](torch::Generator& random) {
    const FineMask m = drawFineMask(candidates, s, c, random);
    return !m.visible.empty();
  };
  const auto wrong = [&](torch::Generator& random) {
    return !drawFineMask(candidates, s, c, random).false_visible.empty();
  };
  const auto moved = [&](torch::Generator& random) { return drawBounds(s, c, random) != own; };
  c.alone_share = 1, c.window_share = 0;
  EXPECT_EQ(share(shows), 0);
  EXPECT_EQ(share(moved), 0);
  c.alone_share = 0, c.context_false_positives = 0, c.window_share = 1;
  EXPECT_GT(share(shows), .8);  // a growth state of depth 0 shows nothing
  EXPECT_EQ(share(wrong), 0);
  EXPECT_GT(share(moved), .9);
  c.context_false_positives = .3f;
  EXPECT_GT(share(wrong), .8);
}

}  // namespace
}  // namespace vdbc
