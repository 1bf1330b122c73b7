// Laws of completion (docs/method.md, section 4), on a toy scene and networks of toy size.
#include "mar/completer.h"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <set>
#include <thread>

#include "encoder/weights.h"
#include "mar/context.h"
#include "mar/thinning.h"
#include "tests/files.h"
#include "tests/toy_completer.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

class CompleterFile : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_ / name; }
  Completer completerOf(const CompleterConfig& c) {
    net_ = makeNet(c, 30);
    TensorFile file;
    addModule(*net_, "", &file);
    file.metadata = {{"completer", c.toJson()}, {"trained_on", "rooms:3-4"}};
    writeTensors(file, path("completer.safetensors"));
    return Completer(path("completer.safetensors"));
  }
  Place complete(const Completer& completer, const CompleteSettings& settings) {
    return completer.complete(startOf(sample_), settings, silent_);
  }
  /// All that growth asked about, before surfaces are thinned and holes closed.
  Place visited(const Completer& completer, const Place& start, const CompleteSettings& settings) {
    Place all;
    completer.complete(start, settings, silent_,
                       [&](const Place& so_far, int32_t) { all = so_far; });
    return all;
  }
  /// The coarse stage's probabilities, from the network itself.
  std::map<Coord, float> gate() const {
    torch::NoGradGuard no_grad;
    const SceneTokens t = sceneTokens(sample_.seen_nodes, sample_.seen_coarse);
    const std::vector<Coord> unknown = unobservedNodes(t.coarse, t.coarse.box);
    const Tensor p =
        net_->coarseLogits(coarseInputs(t, {}, unknown, net_->config.coarse_empty_tokens),
                           sample_.condition.frame)
            .sigmoid();
    std::map<Coord, float> gate;
    for (const Coord& c : t.coarse_filled) gate[c] = 1;
    for (size_t i = 0; i < unknown.size(); ++i) gate[unknown[i]] = p[int64_t(i)].item<float>();
    return gate;
  }
  /// Unobserved nodes of the coarse nodes above the threshold that hang together with filled ones.
  std::vector<Coord> candidates(float coarse_tau) const {
    const std::map<Coord, float> gate = this->gate();
    std::set<Coord> open;
    for (const Coord& c : sceneTokens(sample_.seen_nodes, sample_.seen_coarse).coarse_filled)
      open.insert(c);
    for (size_t before = 0; before != open.size();) {
      before = open.size();
      for (const auto& [node, p] : gate)
        for (const Coord& c : CoordBBox(node.offsetBy(-1), node.offsetBy(1)))
          if (p > coarse_tau && open.count(c)) open.insert(node);
    }
    std::vector<Coord> nodes;
    for (const Coord& node : open)
      for (int slot = 0; slot < 8; ++slot) {
        const Coord c = childCoord(node, slot);
        if (sample_.seen_nodes.at(c) == NodeState::kUnobserved) nodes.push_back(c);
      }
    return nodes;
  }
  void expectObservedRowsFirst(const Place& whole) const {
    const Place& seen = sample_.condition;
    ASSERT_GE(whole.size(), seen.size());
    ASSERT_EQ(int64_t(whole.z.size()), whole.size() * kDim);
    EXPECT_TRUE(std::equal(seen.ijk.begin(), seen.ijk.end(), whole.ijk.begin()));
    EXPECT_EQ(std::memcmp(seen.z.data(), whole.z.data(), seen.z.size() * sizeof(float)), 0);
    for (int64_t i = 0; i < whole.size(); ++i) {
      EXPECT_EQ(whole.generated[size_t(i)], i >= seen.size());
      EXPECT_EQ(whole.bfs_level[size_t(i)] == 0, i < seen.size());
    }
  }
  static void expectNoDuplicates(const Place& grid) {
    EXPECT_EQ(std::set<Coord>(grid.ijk.begin(), grid.ijk.end()).size(), grid.ijk.size());
  }

  const CompletionSample sample_ = toySample();
  const TemporaryFolder folder_;
  std::shared_ptr<CompleterNet> net_;
  Progress silent_;
};

TEST_F(CompleterFile, ObservedRowsAreUntouchedAndNoNodeComesTwice) {  // sections 4.1 and 4.8
  const Completer completer = completerOf(toyConfig());
  for (const int steps : {0, 4}) {
    CompleteSettings settings;
    settings.sampling_steps = steps, settings.hole_tau = 1;
    const Place whole = complete(completer, settings);
    EXPECT_GT(whole.size(), sample_.condition.size());
    expectObservedRowsFirst(whole);
    expectNoDuplicates(whole);
    for (int64_t i = sample_.condition.size(); i < whole.size(); ++i) {
      EXPECT_EQ(sample_.seen_nodes.at(whole.ijk[size_t(i)]), NodeState::kUnobserved);
      EXPECT_TRUE(sample_.seen_nodes.box.isInside(whole.ijk[size_t(i)]));
      EXPECT_GT(whole.probability[size_t(i)], settings.tau);
    }
    for (const float z : whole.z) ASSERT_TRUE(std::isfinite(z));
  }
}

TEST_F(CompleterFile, VisitsEveryCandidateOnceInBreadthFirstOrder) {  // sections 4.7 and 4.8
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = 0;  // keeps whatever is visited
  for (const float coarse_tau : {0.f, .5f, .9999f}) {
    settings.coarse_tau = coarse_tau;
    const Place whole = visited(completer, startOf(sample_), settings);
    expectNoDuplicates(whole);
    const std::vector<Coord> open = candidates(coarse_tau);
    EXPECT_EQ(std::set<Coord>(whole.ijk.begin() + sample_.condition.size(), whole.ijk.end()),
              std::set<Coord>(open.begin(), open.end()));
    const std::map<Coord, int> level = serialLevels(open, sample_.condition.ijk);
    int last = 0;
    for (const auto& entry : level) last = std::max(last, entry.second);
    for (int64_t i = sample_.condition.size(); i < whole.size(); ++i) {
      const auto found = level.find(whole.ijk[size_t(i)]);
      EXPECT_EQ(whole.bfs_level[size_t(i)], found == level.end() ? last + 1 : found->second);
      EXPECT_GE(whole.bfs_level[size_t(i)], whole.bfs_level[size_t(i) - 1]);
    }
  }
}

TEST_F(CompleterFile, NothingThatItKeepsOnlyThickensASurface) {  // section 4.10
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = .5f, settings.hole_tau = 1;
  // From what was observed; then beside half of what that made, which stays as it is.
  Place start = startOf(sample_);
  for (const bool has_given : {false, true}) {
    const Place whole = completer.complete(start, settings, silent_),
                all = visited(completer, start, settings),
                generated =
                    keepRows(all, [&](size_t i) { return int64_t(i) >= sample_.condition.size(); });
    const std::vector<uint8_t> thick = thickTokens(generated);
    std::set<Coord> expected(start.ijk.begin(), start.ijk.end());
    for (size_t i = 0; i < thick.size(); ++i)
      if (!thick[i] && generated.probability[i] > settings.tau) expected.insert(generated.ijk[i]);
    EXPECT_GT(std::count(thick.begin(), thick.end(), uint8_t(1)), 0);
    EXPECT_EQ(std::set<Coord>(whole.ijk.begin(), whole.ijk.end()), expected) << has_given;
    start = keepRows(whole, [&](size_t i) { return !whole.generated[i] || whole.ijk[i].y() < 5; });
  }
  // Tokens that were given stay, however thick they make a surface.
  const Place all = visited(completer, startOf(sample_), settings);
  settings.region = std::make_shared<const TokenMask>();  // nothing new
  EXPECT_EQ(completer.complete(all, settings, silent_).ijk, all.ijk);
}

TEST_F(CompleterFile, TheFineStageStaysInsideWhatTheCoarseStageKept) {  // section 4.7
  const Completer completer = completerOf(toyConfig());
  const std::map<Coord, float> open = gate();
  std::vector<float> sorted;
  for (const auto& entry : open)
    if (entry.second < 1) sorted.push_back(entry.second);
  std::sort(sorted.begin(), sorted.end());
  CompleteSettings settings;
  // Opens about half of the unknown nodes; lies between two probabilities, whose last bits depend
  // on the chunks that they were predicted in.
  size_t middle = sorted.size() / 2;
  while (middle + 1 < sorted.size() && sorted[middle + 1] - sorted[middle] < 1e-5f) ++middle;
  ASSERT_LT(middle + 1, sorted.size());
  settings.coarse_tau = .5f * (sorted[middle] + sorted[middle + 1]);
  const Place whole = complete(completer, settings);
  int64_t outside_filled = 0;
  for (int64_t i = sample_.condition.size(); i < whole.size(); ++i) {
    EXPECT_GT(open.at(tokenCoord(whole.ijk[size_t(i)], 1)), settings.coarse_tau);
    outside_filled += open.at(tokenCoord(whole.ijk[size_t(i)], 1)) < 1;
  }
  EXPECT_GT(outside_filled, 0);
}

TEST_F(CompleterFile, WithoutACoarseStageEveryUnobservedNodeIsACandidate) {
  CompleterConfig c = toyConfig();
  c.coarse_stage = false;
  const Completer completer = completerOf(c);
  CompleteSettings settings;
  settings.tau = 0, settings.coarse_tau = .9999f;
  const Place whole = visited(completer, startOf(sample_), settings);
  std::set<Coord> unobserved;
  for (auto node = sample_.seen_nodes.box.begin(); node; ++node)
    if (sample_.seen_nodes.at(*node) == NodeState::kUnobserved) unobserved.insert(*node);
  const std::set<Coord> made(whole.ijk.begin() + sample_.condition.size(), whole.ijk.end());
  EXPECT_EQ(made, unobserved);
}

TEST_F(CompleterFile, RandomOrderHasLevelsOfTheSameSizes) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = 0, settings.coarse_tau = 0;
  const auto levels = [&] {
    const Place whole = visited(completer, startOf(sample_), settings);
    std::map<Coord, int32_t> level;
    for (size_t i = size_t(sample_.condition.size()); i < whole.ijk.size(); ++i)
      level[whole.ijk[i]] = whole.bfs_level[i];
    return level;
  };
  const auto sizes = [](const std::map<Coord, int32_t>& level) {
    std::map<int32_t, int> n;
    for (const auto& entry : level) ++n[entry.second];
    return n;
  };
  const std::map<Coord, int32_t> nearest_first = levels();
  settings.random_order = true;
  const std::map<Coord, int32_t> first = levels(), again = levels();
  settings.seed = 2;
  const std::map<Coord, int32_t> second = levels();
  EXPECT_EQ(first, again);
  for (const auto* other : {&first, &second}) {
    EXPECT_EQ(sizes(*other), sizes(nearest_first));
    EXPECT_NE(*other, nearest_first);
  }
  EXPECT_NE(first, second);
}

TEST_F(CompleterFile, SizesGivenAreThoseOfTheWeightsAtTheirValue) {
  const CompleterConfig c = toyConfig();
  const Completer completer = completerOf(c);
  CompleteSettings settings;
  const Place own = complete(completer, settings);
  settings.context_tokens = c.context_tokens, settings.chunk_tokens = c.chunk_tokens;
  EXPECT_EQ(complete(completer, settings).probability, own.probability);
  settings.context_tokens = 5;
  const Place nearer = complete(completer, settings);
  EXPECT_NE(nearer.probability, own.probability);
  settings.context_tokens = 0, settings.chunk_tokens = 5;
  EXPECT_NE(complete(completer, settings).probability, own.probability);
}

TEST_F(CompleterFile, OnlyGrowthThatSeesWhatItMadeGetsNormalisedLatents) {
  const Completer completer = completerOf(toyConfig());
  const auto largestMean = [&](bool generated_context) {
    CompleteSettings settings;
    settings.generated_context = generated_context;
    const Place whole = complete(completer, settings);
    const Tensor z =
        torch::tensor(whole.z).view({whole.size(), kDim}).slice(0, sample_.condition.size());
    return z.view({-1, kDim / 4, 4}).mean(2).abs().max().item<double>();  // of a channel group;
                                                                          // GroupNorm makes it 0
  };
  EXPECT_LT(largestMean(true), 1e-3);
  EXPECT_GT(largestMean(false), .05);
}

TEST_F(CompleterFile, NothingBeatsAThresholdOfOne) {  // section 4.9
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = 1, settings.hole_tau = 1;
  EXPECT_EQ(complete(completer, settings).size(), sample_.condition.size());
}

TEST_F(CompleterFile, SameSeedSameGrid) {  // section 4.8
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.sampling_steps = 4;
  const Place a = complete(completer, settings), b = complete(completer, settings);
  EXPECT_EQ(a.ijk, b.ijk);
  EXPECT_EQ(a.z, b.z);
  EXPECT_EQ(a.probability, b.probability);
  settings.seed = 2;
  EXPECT_NE(complete(completer, settings).z, a.z);
  settings.seed = 1, settings.temperature = 0;
  const Place cold = complete(completer, settings);
  settings.seed = 2;
  EXPECT_EQ(complete(completer, settings).z, cold.z) << "without temperature nothing is random";
}

TEST_F(CompleterFile, KeptTokensConditionTheNextLevel) {  // section 4.8
  CompleterConfig c = toyConfig();
  c.chunk_tokens = 4096;
  const Completer completer = completerOf(c);
  CompleteSettings settings;
  settings.tau = 0, settings.generated_context = true;
  const Place whole = visited(completer, startOf(sample_), settings);
  // By hand: level 2 with level 1 in its context, and, to tell it apart, without.
  const SceneTokens t = sceneTokens(sample_.seen_nodes, sample_.seen_coarse);
  const std::map<Coord, float> open = gate();
  torch::NoGradGuard no_grad;
  TokenSets in;
  Eigen::Vector3d centre = Eigen::Vector3d::Zero();
  std::vector<float> truth, parents;
  for (int64_t i = 0; i < whole.size(); ++i)
    if (whole.bfs_level[size_t(i)] == 2) {
      const Coord ijk = whole.ijk[size_t(i)];
      in[kTarget].coords.push_back(ijk);
      centre += Eigen::Vector3d(ijk.x(), ijk.y(), ijk.z());
      truth.push_back(whole.probability[size_t(i)]);
      parents.push_back(open.at(tokenCoord(ijk, 1)));
    }
  ASSERT_GT(truth.size(), 1u);
  centre /= double(truth.size());
  in[kTarget].features = torch::tensor(parents).unsqueeze(1);
  for (int64_t row : nearestRows(t.empty_shell, centre, c.empty_tokens))
    in[kEmptyToken].coords.push_back(t.empty_shell[size_t(row)]);
  std::vector<Coord> context;
  for (int64_t i = 0; i < whole.size(); ++i)
    if (whole.bfs_level[size_t(i)] < 2) context.push_back(whole.ijk[size_t(i)]);
  std::vector<int64_t> rows[2];
  for (int64_t row : nearestRows(context, centre, c.context_tokens)) {
    const size_t kind = row >= sample_.condition.size();
    rows[kind].push_back(row);
    in[kind].coords.push_back(context[size_t(row)]);
  }
  ASSERT_FALSE(rows[1].empty());
  const Tensor z = net_->standardise(torch::tensor(whole.z).view({-1, kDim}));
  for (size_t kind : {0, 1})
    in[kind].features = z.index_select(0, torch::tensor(rows[kind], torch::kInt64));
  EXPECT_LT(largestDifference(net_->fine(in, sample_.condition.frame).logits.sigmoid(),
                              torch::tensor(truth)),
            1e-5);
  in[kVisible] = {torch::zeros({0, kDim}), {}};
  EXPECT_GT(largestDifference(net_->fine(in, sample_.condition.frame).logits.sigmoid(),
                              torch::tensor(truth)),
            1e-4);
}

TEST_F(CompleterFile, GoesOnFromAnyLevelAsIfItHadNeverStopped) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = .3f;
  const Place some = complete(completer, settings);
  // From what was observed; and with tokens that were given, some of them below tau.
  const Place given =
      keepRows(some, [&](size_t i) { return !some.generated[i] || some.ijk[i].y() < 5; });
  settings.tau = .5f, settings.hole_tau = .1f, settings.sampling_steps = 3;
  ASSERT_LT(*std::min_element(given.probability.begin(), given.probability.end()), settings.tau);
  for (const Place& start : {startOf(sample_), given})
    for (const bool generated_context : {false, true}) {
      settings.generated_context = generated_context;
      settings.first_level = 1, settings.begun_with = -1;
      std::vector<std::pair<Place, int32_t>> stops;
      const Place whole = completer.complete(start, settings, silent_,
                                             [&](const Place& so_far, int32_t next_level) {
                                               stops.push_back({so_far, next_level});
                                             });
      ASSERT_GE(stops.size(), 3u);
      for (const auto& [so_far, next_level] : stops) {
        SCOPED_TRACE(next_level);
        settings.first_level = next_level, settings.begun_with = start.size();
        const Place rest = completer.complete(so_far, settings, silent_);
        EXPECT_EQ(rest.ijk, whole.ijk);
        EXPECT_EQ(std::memcmp(rest.z.data(), whole.z.data(), whole.z.size() * sizeof(float)), 0);
        EXPECT_EQ(rest.probability, whole.probability);
        EXPECT_EQ(rest.bfs_level, whole.bfs_level);
        EXPECT_EQ(rest.generated, whole.generated);
      }
    }
}

TEST_F(CompleterFile, LatentsAreWhatFilesHold) {
  const Completer completer = completerOf(toyConfig());
  const Place whole = complete(completer, CompleteSettings());
  const Tensor z = torch::tensor(std::vector<float>(
      whole.z.begin() + std::ptrdiff_t(sample_.condition.z.size()), whole.z.end()));
  ASSERT_GT(z.numel(), 0);
  EXPECT_TRUE(torch::equal(z, z.to(torch::kHalf).to(torch::kFloat32)));
}

TEST_F(CompleterFile, NothingIsGeneratedOutsideOfTheRegion) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = 0;
  const Place everywhere = visited(completer, startOf(sample_), settings);
  auto region = std::make_shared<TokenMask>();
  region->fill(CoordBBox(Coord(6, 0, 0), Coord(9, 9, 5)), true, true);
  settings.region = region;
  const Place some = visited(completer, startOf(sample_), settings);
  expectObservedRowsFirst(some);
  std::map<Coord, int32_t> expected, found;
  for (int64_t i = sample_.condition.size(); i < everywhere.size(); ++i)
    if (region->isValueOn(everywhere.ijk[size_t(i)]))
      expected[everywhere.ijk[size_t(i)]] = everywhere.bfs_level[size_t(i)];
  for (int64_t i = sample_.condition.size(); i < some.size(); ++i)
    found[some.ijk[size_t(i)]] = some.bfs_level[size_t(i)];
  EXPECT_FALSE(found.empty());
  EXPECT_EQ(found, expected) << "levels are distances from what was observed, region or not";
}

TEST_F(CompleterFile, GeneratedTokensOfTheStartStay) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = .4f;
  const Place first = complete(completer, settings);
  const Place start =
      keepRows(first, [&](size_t i) { return !first.generated[i] || first.ijk[i].y() < 5; });
  ASSERT_GT(start.size(), sample_.condition.size());
  settings.seed = 2, settings.sampling_steps = 2,
  settings.tau = .9f;  // also those that it would drop
  const Place again = completer.complete(start, settings, silent_);
  ASSERT_GE(again.size(), start.size());
  expectNoDuplicates(again);
  EXPECT_TRUE(std::equal(start.ijk.begin(), start.ijk.end(), again.ijk.begin()));
  EXPECT_EQ(std::memcmp(start.z.data(), again.z.data(), start.z.size() * sizeof(float)), 0);
  Place mixed = start;
  std::swap(mixed.generated.front(), mixed.generated.back());
  EXPECT_THROW(completer.complete(mixed, settings, silent_), Error);
}

TEST_F(CompleterFile, WithoutGeneratedContextAHigherTauOnlyDrops) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = .3f, settings.hole_tau = 1;
  const Place low = complete(completer, settings);
  settings.tau = .55f;
  const Place high = complete(completer, settings);
  const Place dropped = keepRows(low, [&](size_t i) { return low.probability[i] > .55f; });
  EXPECT_LT(high.size(), low.size());
  EXPECT_GT(high.size(), sample_.condition.size());
  EXPECT_EQ(high.ijk, dropped.ijk);
  EXPECT_EQ(high.z, dropped.z);
}

TEST_F(CompleterFile, PlacesBeyondOneWindowAreVisitedOnceEverywhere) {
  // A floor of 30 m, seen at one end and in the middle; nothing is known of the rest.
  const Completer completer = completerOf(toyConfig());
  Place seen;
  seen.dim = kDim;
  seen.frame.bounds = CoordBBox(Coord(0), Coord(303, 15, 7));
  const auto space = std::make_shared<SeenSpace>();
  space->box = seen.frame.bounds;
  for (int x0 : {0, 70})
    for (auto c = CoordBBox(Coord(x0, 0, 1), Coord(x0 + 3, 3, 1)).begin(); c; ++c) {
      seen.ijk.push_back(*c);
      for (int d = 0; d < kDim; ++d) seen.z.push_back(std::sin(float(d)));
      for (int slot = 0; slot < 8; ++slot) space->filled.setValueOn(childCoord(*c, slot));
    }
  seen.seen = space;
  seen.generated.assign(seen.ijk.size(), 0), seen.probability.assign(seen.ijk.size(), 1.f);
  seen.bfs_level.assign(seen.ijk.size(), 0);
  CompleteSettings settings;
  settings.tau = 0, settings.coarse_tau = 0;
  const Place whole = visited(completer, seen, settings);
  expectNoDuplicates(whole);
  // Two windows hold what was seen, to 16.8 m; two more are too far from anything seen.
  EXPECT_EQ(whole.size(), 84 * 8 * 4);
  for (const Coord& c : whole.ijk) EXPECT_LT(c.x(), 84);
  for (const float z : whole.z) ASSERT_TRUE(std::isfinite(z));
  settings.refine_observed = true;  // each in its own window too
  const Place refined = completer.complete(seen, settings, silent_);
  for (const float z : refined.z) ASSERT_TRUE(std::isfinite(z));
  for (size_t i = 0; i < seen.ijk.size(); ++i) EXPECT_NE(refined.z[i * kDim], seen.z[i * kDim]);
}

TEST_F(CompleterFile, OracleMakesExactlyTheGivenTokens) {  // the oracle of the evaluation
  const Completer completer = completerOf(toyConfig());
  std::vector<Coord> occupied = sample_.target.ijk;  // with what was seen already
  occupied.push_back(occupied.back());               // and one twice
  const Place whole = completer.completeAt(startOf(sample_), occupied, CompleteSettings(), silent_);
  expectObservedRowsFirst(whole);
  expectNoDuplicates(whole);
  EXPECT_EQ(std::set<Coord>(whole.ijk.begin(), whole.ijk.end()),
            std::set<Coord>(sample_.target.ijk.begin(), sample_.target.ijk.end()));
}

TEST_F(CompleterFile, RefinementRewritesObservedLatentsAlone) {  // section 4.6
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  const Place plain = complete(completer, settings);
  settings.refine_observed = true;
  const Place refined = complete(completer, settings);
  EXPECT_EQ(refined.ijk, plain.ijk);
  EXPECT_EQ(refined.generated, plain.generated);
  const auto seen = std::ptrdiff_t(sample_.condition.z.size());
  EXPECT_TRUE(std::equal(plain.z.begin() + seen, plain.z.end(), refined.z.begin() + seen));
  for (size_t i = 0; i < size_t(sample_.condition.size()); ++i)
    EXPECT_FALSE(
        std::equal(&plain.z[i * kDim], &plain.z[(i + 1) * kDim - 1] + 1, &refined.z[i * kDim]))
        << i;
}

TEST_F(CompleterFile, RefusesWhatItCannotComplete) {
  const Completer completer = completerOf(toyConfig());
  Place grid = startOf(sample_);
  grid.level = 2;
  EXPECT_THROW(completer.complete(grid, {}, silent_), Error);
  grid = Place();
  grid.seen = startOf(sample_).seen;
  grid.dim = kDim;
  EXPECT_THROW(completer.complete(grid, {}, silent_), Error);
  grid = startOf(sample_), grid.dim = 4;
  EXPECT_THROW(completer.complete(grid, {}, silent_), Error);
}

class StopAtOnce : public Progress {
 public:
  bool wasInterrupted(int) override { return true; }
};

TEST_F(CompleterFile, CanBeStopped) {
  const Completer completer = completerOf(toyConfig());
  StopAtOnce stop;
  EXPECT_THROW(completer.complete(startOf(sample_), {}, stop), Cancelled);
}

TEST_F(CompleterFile, NothingUnseenLeavesTheGridAsItIs) {
  const Completer completer = completerOf(toyConfig());
  Place start = startOf(sample_);
  const auto all = std::make_shared<SeenSpace>(*start.seen);
  for (auto c = all->box.begin(); c; ++c)
    if (all->at(*c) == NodeState::kUnobserved) setState(all.get(), *c, NodeState::kEmpty);
  start.seen = all;
  const Place whole = completer.complete(start, {}, silent_);
  EXPECT_EQ(whole.ijk, sample_.condition.ijk);
  EXPECT_EQ(whole.z, sample_.condition.z);
}

TEST_F(CompleterFile, HolesAreClosedWithDroppedTokensAlone) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = .5f, settings.hole_tau = 1;
  const Place open = complete(completer, settings);
  settings.tau = 0;
  const Place everything = visited(completer, startOf(sample_), settings);
  settings.tau = .5f, settings.hole_tau = .01f;
  const Place closed = complete(completer, settings);
  expectNoDuplicates(closed);
  ASSERT_GT(closed.size(), open.size());
  EXPECT_TRUE(std::equal(open.ijk.begin(), open.ijk.end(), closed.ijk.begin()));
  EXPECT_TRUE(std::equal(open.z.begin(), open.z.end(), closed.z.begin()));
  std::map<Coord, size_t> row;
  for (size_t i = 0; i < everything.ijk.size(); ++i) row[everything.ijk[i]] = i;
  for (size_t i = size_t(open.size()); i < size_t(closed.size()); ++i) {
    const size_t same = row.at(closed.ijk[i]);
    EXPECT_EQ(closed.probability[i], everything.probability[same]);
    EXPECT_EQ(closed.bfs_level[i], everything.bfs_level[same]);
    EXPECT_TRUE(
        std::equal(&closed.z[i * kDim], &closed.z[i * kDim] + kDim, &everything.z[same * kDim]));
  }
}

void expectSame(const Place& a, const Place& b) {
  EXPECT_TRUE(equalRows(a, b));
  ASSERT_EQ(a.z.size(), b.z.size());
  EXPECT_EQ(std::memcmp(a.z.data(), b.z.data(), a.z.size() * sizeof(float)), 0);
}

/// All that a completion can be asked to do.
CompleteSettings fullSettings() {
  CompleteSettings settings;
  settings.tau = .5f, settings.hole_tau = .05f, settings.sampling_steps = 3;
  settings.refine_observed = true;
  return settings;
}

TEST_F(CompleterFile, SameBytesOnAnyNumberOfThreads) {
  const tbb::global_control four(tbb::global_control::max_allowed_parallelism, 4);
  const Completer completer = completerOf(toyConfig());
  for (const bool generated_context : {false, true}) {
    CompleteSettings settings = fullSettings();
    settings.generated_context = generated_context;
    const auto run = [&](int threads) {
      return withThreads(threads, [&] { return complete(completer, settings); });
    };
    const Place one = run(1);
    ASSERT_GT(one.size(), sample_.condition.size() + 3 * toyConfig().chunk_tokens) << "few chunks";
    for (int threads : {1, 2, 4}) expectSame(run(threads), one);
  }
}

TEST_F(CompleterFile, CallsFromSeveralThreadsDoNotMeet) {
  const Completer completer = completerOf(toyConfig());
  const auto run = [&](uint64_t seed) {
    CompleteSettings settings = fullSettings();
    settings.seed = seed;
    Progress silent;
    return completer.complete(startOf(sample_), settings, silent);
  };
  const Place serial[2] = {run(1), run(2)};
  EXPECT_NE(serial[0].z, serial[1].z);
  Place parallel[2];
  std::thread other([&] { parallel[1] = run(2); });
  parallel[0] = run(1);
  other.join();
  for (size_t i : {0, 1}) expectSame(parallel[i], serial[i]);
}

TEST_F(CompleterFile, EveryChunkDrawsFromItsOwnGenerator) {
  // With the same context and noise of their own, chunks of a level do not repeat each other.
  CompleterConfig c = toyConfig();
  c.chunk_tokens = 1;
  const Completer completer = completerOf(c);
  CompleteSettings settings;
  settings.tau = 0, settings.hole_tau = 1;
  const Place mean = complete(completer, settings);
  settings.sampling_steps = 3;
  const Place drawn = complete(completer, settings);
  ASSERT_EQ(drawn.ijk, mean.ijk);
  std::set<std::vector<float>> noise;
  for (size_t i = size_t(sample_.condition.size()); i < drawn.ijk.size(); ++i) {
    std::vector<float> difference(kDim);
    for (size_t d = 0; d < kDim; ++d) difference[d] = drawn.z[i * kDim + d] - mean.z[i * kDim + d];
    noise.insert(difference);
  }
  EXPECT_EQ(int64_t(noise.size()), drawn.size() - sample_.condition.size());
}

/// Counts how often the work asks whether to go on: at each level, and before each chunk.
class Counting : public Progress {
 public:
  bool wasInterrupted(int) override { return ++asked, false; }
  std::atomic<int> asked{0};
};

TEST_F(CompleterFile, WhatIsFarFromAllThatWasSeenChangesNoBitAndCostsNothing) {
  // Voxels of 40 cm; windows of 20 voxels a side, of which the toy scene touches a few. Volumes of
  // 91 m and 955 m a side; the larger one has 13 billion voxels.
  const Completer completer = completerOf(toyConfig());
  const auto completeIn = [&](int side, Counting* counting) {
    Place start = startOf(sample_);
    start.frame.voxel_m = .4f;
    start.frame.bounds = CoordBBox(Coord(0), Coord(side - 1));
    const auto space = std::make_shared<SeenSpace>(*start.seen);
    space->box = start.frame.bounds;
    start.seen = space;
    return completer.complete(start, fullSettings(), *counting);
  };
  Counting wide, wider;
  const Place whole = completeIn(228, &wide);
  EXPECT_GT(whole.size(), sample_.condition.size());
  expectSame(completeIn(2388, &wider), whole);
  EXPECT_EQ(int(wider.asked), int(wide.asked));
}

TEST_F(CompleterFile, TheGateAsksFromWhatWasSeenOutwards) {
  CompleterConfig c = toyConfig();
  c.coarse_chunk_tokens = 8;
  const Completer completer = completerOf(c);
  Place start = startOf(sample_);
  start.frame.bounds = CoordBBox(Coord(0), Coord(127, 19, 11));  // one window
  const auto space = std::make_shared<SeenSpace>(*start.seen);
  space->box = start.frame.bounds;
  start.seen = space;
  const auto chunksAsked = [&](float coarse_tau) {
    CompleteSettings settings;
    settings.coarse_tau = coarse_tau, settings.hole_tau = 1;
    settings.first_level = 1 << 20;  // the gate alone
    Counting counting;
    completer.complete(start, settings, counting);
    return int(counting.asked);
  };
  const SeenSpace coarse = poolSeen(*space, 2);
  int all = 0, beside_filled = 0;
  for (const std::vector<Coord>& chunk : chunksOf(unobservedNodes(coarse, coarse.box), 8)) {
    ++all;
    beside_filled += std::any_of(chunk.begin(), chunk.end(), [&](const Coord& node) {
      for (auto n = CoordBBox(node.offsetBy(-1), node.offsetBy(1)).begin(); n; ++n)
        if (coarse.at(*n) == NodeState::kFilled) return true;
      return false;
    });
  }
  EXPECT_GT(all, 40);
  EXPECT_LT(beside_filled, 20);
  EXPECT_EQ(chunksAsked(0), all) << "all that it says opens the next";
  EXPECT_EQ(chunksAsked(1), beside_filled) << "nothing that it says does";
}

TEST_F(CompleterFile, LoadsWhatWasSavedAndRejectsTheRest) {
  const CompleterConfig c = toyConfig();
  const Completer completer = completerOf(c);
  EXPECT_EQ(completer.config().toJson(), c.toJson());
  EXPECT_EQ(completer.hash(), weightsHash(*net_));
  EXPECT_EQ(completer.trainedOn(), "rooms:3-4");
  const std::string good = path("completer.safetensors"), bad = path("bad.safetensors");
  const TensorFile file = readTensors(good);
  const auto rejected = [&](const auto& change) {
    TensorFile changed = file;
    for (auto& t : changed.tensors) t.second = t.second.detach().clone();
    change(changed);
    writeTensors(changed, bad);
    EXPECT_THROW(Completer{bad}, Error);
  };
  rejected([](TensorFile& f) {  // weights of an encoder
    f.metadata["encoder"] = f.metadata["completer"];
    f.metadata.erase("completer");
  });
  rejected([](TensorFile& f) { f.metadata["completer"] = "{}"; });
  rejected([](TensorFile& f) { f.tensors.erase("latent_mean"); });
  rejected(
      [](TensorFile& f) { f.tensors["latent_mean"][0] = std::numeric_limits<float>::quiet_NaN(); });
  for (const auto& break_it : std::vector<void (*)(CompleterConfig&)>{
           [](CompleterConfig& e) { e.heads = 0; }, [](CompleterConfig& e) { e.heads = 5; },
           [](CompleterConfig& e) { e.width = 1 << 20; },
           [](CompleterConfig& e) { e.chunk_tokens = 0; },
           [](CompleterConfig& e) { e.diffusion_steps = 0; },
           [](CompleterConfig& e) { e.layers = 3; }})
    rejected([&](TensorFile& f) {
      CompleterConfig e = c;
      break_it(e);
      f.metadata["completer"] = e.toJson();
    });
  const std::string bytes = bytesOf(good);
  for (size_t n = 0; n < bytes.size(); n += bytes.size() / 20) {
    writeBytes(bad, bytes.substr(0, n));
    EXPECT_THROW(Completer{bad}, Error) << n;
  }
}

}  // namespace
}  // namespace vdbc
