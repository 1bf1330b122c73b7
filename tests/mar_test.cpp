// Laws of the masked auto-regressive completer and of its training (spec A1-A8, A10-A14), on a toy
// scene and networks of toy size.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <deque>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <random>
#include <set>

#include "encoder/trainer.h"
#include "encoder/weights.h"
#include "mar/closing.h"
#include "mar/completer.h"
#include "mar/completer_train.h"
#include "mar/heads.h"
#include "mar/network.h"
#include "mar/training_masks.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

// --- a toy scene: a floor and a wall, the near half of it seen -----------------------------------

constexpr int kDim = 8;

NodeStates makeStates(int level, const CoordBBox& box) {
  NodeStates s;
  s.level = level, s.box = box;
  s.states.assign(size_t(box.volume()), NodeState::kUnobserved);
  return s;
}

NodeStates pooled(const NodeStates& fine) {
  NodeStates s =
      makeStates(2, CoordBBox(tokenCoord(fine.box.min(), 1), tokenCoord(fine.box.max(), 1)));
  for (auto c = s.box.begin(); c; ++c) {
    int filled = 0, empty = 0;
    for (int slot = 0; slot < 8; ++slot) {
      const NodeState state = fine.at(childCoord(*c, slot));
      filled += state == NodeState::kFilled, empty += state == NodeState::kEmpty;
    }
    s.states[size_t(s.index(*c))] = filled       ? NodeState::kFilled
                                    : empty == 8 ? NodeState::kEmpty
                                                 : NodeState::kUnobserved;
  }
  return s;
}

bool isSolid(const Coord& c) { return c.z() == 1 || c.y() == 9; }

Place gridOf(const NodeStates& nodes, const VoxelFrame& frame) {
  Place g;
  g.frame = frame, g.dim = kDim;
  for (auto c = nodes.box.begin(); c; ++c) {
    if (nodes.at(*c) != NodeState::kFilled) continue;
    g.ijk.push_back(*c);
    for (int d = 0; d < kDim; ++d)
      g.z.push_back(std::sin(.3f * float((*c).x() * (d + 1)) + float((*c).z() == 1) * float(d)));
  }
  g.generated.assign(g.ijk.size(), 0);
  g.probability.assign(g.ijk.size(), 1.f);
  g.bfs_level.assign(g.ijk.size(), 0);
  return g;
}

/// 12 x 10 x 6 nodes; the condition sees x < 5 up to the wall, the dense views all but the top
/// layer.
CompletionSample toySample(int seen_x = 5) {
  CompletionSample s;
  VoxelFrame frame;
  frame.bounds = CoordBBox(Coord(0), Coord(23, 19, 11));
  const CoordBBox box(Coord(0), Coord(11, 9, 5));
  s.seen_nodes = makeStates(1, box), s.target_nodes = makeStates(1, box);
  for (auto c = box.begin(); c; ++c) {
    const Coord ijk = *c;
    const size_t i = size_t(s.seen_nodes.index(ijk));
    if (ijk.z() == 5 || ijk.z() == 0) continue;  // nobody sees there
    s.target_nodes.states[i] = isSolid(ijk) ? NodeState::kFilled : NodeState::kEmpty;
    if (ijk.x() < seen_x) s.seen_nodes.states[i] = s.target_nodes.states[i];
  }
  s.seen_coarse = pooled(s.seen_nodes), s.target_coarse = pooled(s.target_nodes);
  s.condition = gridOf(s.seen_nodes, frame), s.target = gridOf(s.target_nodes, frame);
  return s;
}

std::shared_ptr<const SeenSpace> spaceOf(const NodeStates& nodes) {
  const auto space = std::make_shared<SeenSpace>();
  for (auto c = nodes.box.begin(); c; ++c)
    for (int slot = 0; slot < 8; ++slot) {
      if (nodes.at(*c) == NodeState::kFilled) space->filled.setValueOn(childCoord(*c, slot));
      if (nodes.at(*c) == NodeState::kEmpty) space->empty.setValueOn(childCoord(*c, slot));
    }
  return space;
}

/// The condition with what was seen, as the completer takes it.
Place startOf(const CompletionSample& sample) {
  Place start = sample.condition;
  start.seen = spaceOf(sample.seen_nodes);
  return start;
}

CompleterConfig toyConfig() {
  CompleterConfig c;
  c.preset = "toy", c.latent_dim = kDim, c.latent_groups = kDim / 4;
  c.width = 24, c.heads = 2, c.layers = 2, c.coarse_width = 16, c.coarse_heads = 1;
  c.diffusion_width = 16, c.diffusion_steps = 100;
  c.context_tokens = 40, c.empty_tokens = 12, c.chunk_tokens = 16, c.coarse_empty_tokens = 8;
  return c;
}

std::shared_ptr<CompleterNet> makeNet(const CompleterConfig& c, uint64_t seed) {
  torch::manual_seed(seed);
  auto net = std::make_shared<CompleterNet>(c);
  torch::NoGradGuard no_grad;
  // Spreads the probabilities, which a fresh network puts all near one half.
  net->occupancy->third->weight.mul_(4), net->coarse_occupancy->third->weight.mul_(4);
  net->latent_mean.fill_(-.42), net->latent_deviation.fill_(.33);
  return net;
}

int64_t parameterCount(const torch::nn::Module& module) {
  int64_t n = 0;
  for (const Tensor& p : module.parameters()) n += p.numel();
  return n;
}

double largestDifference(const Tensor& a, const Tensor& b) {
  return (a - b).abs().max().item<double>();
}

std::string bytesOf(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

class InFolder : public testing::Test {
 protected:
  void SetUp() override {
    std::string pattern = testing::TempDir() + "vdbc_mar_XXXXXX";
    ASSERT_NE(mkdtemp(pattern.data()), nullptr);
    folder_ = pattern;
  }
  void TearDown() override { fs::remove_all(folder_); }
  std::string path(const std::string& name) const { return folder_ + "/" + name; }

 private:
  std::string folder_;
};

// --- heads ---------------------------------------------------------------------------------------

TEST(FocalLoss, WithGammaZeroAndAlphaHalfIsHalfTheCrossEntropy) {  // A6
  torch::manual_seed(1);
  const Tensor logits = 3 * torch::randn({50}),
               truth = (torch::rand({50}) < .4).to(torch::kFloat32), weights = torch::rand({50});
  double sum = 0;
  for (int64_t i = 0; i < 50; ++i) {
    const double p = 1 / (1 + std::exp(-logits[i].item<double>()));
    sum -= weights[i].item<double>() * std::log(truth[i].item<float>() > 0 ? p : 1 - p);
  }
  EXPECT_NEAR(focalLoss(logits, truth, weights, 0, .5).item<double>(), sum / 50 / 2, 1e-6);
}

TEST(FocalLoss, EqualsItsFormula) {  // A6, Lin et al. 2017, eq. 5
  for (const double x : {-4., -.5, 0., 2.})
    for (const float t : {0.f, 1.f}) {
      const double p = 1 / (1 + std::exp(-x)), p_t = t > 0 ? p : 1 - p, alpha_t = t > 0 ? .3 : .7;
      EXPECT_NEAR(focalLoss(torch::full({1}, x), torch::full({1}, t), torch::ones({1}), 2, .3)
                      .item<double>(),
                  -alpha_t * std::pow(1 - p_t, 2) * std::log(p_t), 1e-6);
    }
}

TEST(FocalLoss, GradientMatchesFiniteDifferences) {  // A6
  torch::manual_seed(2);
  for (const double gamma : {0., 1., 2.}) {
    const Tensor logits = 2 * torch::randn({12}, torch::kFloat64),
                 truth = (torch::rand({12}) < .5).to(torch::kFloat64),
                 weights = torch::rand({12}, torch::kFloat64);
    const Tensor x = logits.clone().set_requires_grad(true);
    focalLoss(x, truth, weights, gamma, .25).backward();
    for (int64_t i = 0; i < 12; ++i) {
      Tensor up = logits.clone(), down = logits.clone();
      up[i] += 1e-5, down[i] -= 1e-5;
      const double slope =
          (focalLoss(up, truth, weights, gamma, .25) - focalLoss(down, truth, weights, gamma, .25))
              .item<double>() /
          2e-5;
      EXPECT_NEAR(x.grad()[i].item<double>(), slope, 1e-8);
    }
  }
}

TEST(OccupancyHead, IsThreeLinearLayersWithOneLogit) {  // A6
  torch::manual_seed(3);
  OccupancyHead head(20);
  EXPECT_EQ(parameterCount(head), 2 * (20 * 20 + 20) + 20 + 1);
  const Tensor h = torch::randn({7, 20});
  const auto layer = [](const Tensor& x, const Linear& l) {
    return torch::matmul(x, l->weight.t()) + l->bias;
  };
  const auto gelu = [](const Tensor& x) { return x * .5 * (1 + torch::erf(x / std::sqrt(2.))); };
  const Tensor truth = layer(gelu(layer(gelu(layer(h, head.first)), head.second)), head.third);
  EXPECT_LT(largestDifference(head.forward(h), truth.squeeze(1)), 1e-5);
}

TEST(NoiseSchedule, FollowsTheCosine) {  // A7, Nichol & Dhariwal 2021, eq. 17
  const std::vector<float> bar = cosineAlphaBar(1000);
  ASSERT_EQ(bar.size(), 1000u);
  const auto f = [](double t) {
    return std::pow(std::cos((t / 1000 + .008) / 1.008 * M_PI / 2), 2);
  };
  for (int t = 0; t < 1000; ++t) {
    EXPECT_NEAR(bar[size_t(t)], std::max(1e-4, f(t + 1) / f(0)), 1e-6);
    if (t > 0) {
      EXPECT_LE(bar[size_t(t)], bar[size_t(t) - 1]);
    }
  }
  EXPECT_GT(bar[0], .9999f);
}

TEST(NoiseSchedule, WeightsAreTheirFormulas) {  // A7
  for (const float bar : {.999f, .7f, .2f, .06f, .01f}) {
    const float snr = bar / (1 - bar);
    EXPECT_NEAR(snrWeight(SnrWeight::kSnr, bar), snr / (1 + snr), 1e-5);
    // An error of epsilon, times sqrt((1 - bar) / bar), is one of x0.
    EXPECT_NEAR(snrWeight(SnrWeight::kInverse, bar), std::min(20.f, (1 + 1 / snr)), 1e-4);
  }
}

TEST(DiffusionHead, FreshOutputIsExactlyZero) {  // A7
  torch::manual_seed(4);
  DiffusionHead head(24, 5, 32, 1000);
  initialiseXavier(head);
  head.zeroStart();
  const Tensor noise =
      head.noise(torch::randn({9, 5}), torch::arange(9) * 100, torch::randn({9, 24}));
  EXPECT_EQ(noise.abs().max().item<double>(), 0);
  // Not for good: its last layer gets a gradient.
  torch::Generator random = at::detail::createCPUGenerator(1);
  head.loss(torch::randn({9, 24}), torch::randn({9, 5}), torch::eye(5), 2, SnrWeight::kSnr, random)
      .diffusion.backward();
  EXPECT_GT(head.out->weight.grad().abs().sum().item<double>() +
                head.out->bias.grad().abs().sum().item<double>(),
            0);
}

TEST(DiffusionHead, LossIsTheWeightedErrorOfTheNoise) {  // A7: term by term
  torch::manual_seed(5);
  DiffusionHead head(6, 3, 8, 50);
  const Tensor h = torch::randn({4, 6}), target = torch::randn({4, 3}),
               way = torch::tensor({{2.f, 0.f, -1.f}});
  for (const SnrWeight kind : {SnrWeight::kSnr, SnrWeight::kInverse}) {
    torch::Generator random = at::detail::createCPUGenerator(6);
    const auto l = head.loss(h, target, way, 3, kind, random);
    const Tensor error = head.mean(h) - target;
    const Tensor colour_error = 2 * error.select(1, 0) - error.select(1, 2);
    EXPECT_NEAR(l.linear.item<double>(),
                (error.square().mean() + colour_error.square().mean()).item<double>(), 1e-5);
    // A fresh head predicts 0, so the error is the noise itself.
    torch::Generator again = at::detail::createCPUGenerator(6);
    const Tensor t = torch::randint(50, {12}, again, torch::kInt64),
                 epsilon = torch::randn({12, 3}, again);
    double sum = 0;
    for (int64_t i = 0; i < 12; ++i)
      sum += snrWeight(kind, cosineAlphaBar(50)[size_t(t[i].item<int64_t>())]) *
             epsilon[i].square().sum().item<double>();
    EXPECT_NEAR(l.diffusion.item<double>(), sum / 36, 1e-4 * sum / 36);
  }
}

TEST(DiffusionHead, LinearMeanIsBehindAStopGradient) {  // A7
  torch::manual_seed(6);
  DiffusionHead head(6, 3, 8, 50);
  {
    torch::NoGradGuard no_grad;
    head.out->weight.normal_();
  }
  torch::Generator random = at::detail::createCPUGenerator(7);
  const auto l = head.loss(torch::randn({40, 6}), torch::randn({40, 3}), torch::eye(3), 2,
                           SnrWeight::kInverse, random);
  l.diffusion.backward();
  EXPECT_FALSE(head.linear->weight.grad().defined());
  EXPECT_GT(head.out->weight.grad().abs().sum().item<double>(), 0);
}

TEST(DiffusionHead, WithoutStepsOrTemperatureItIsTheLinearMean) {
  torch::manual_seed(7);
  DiffusionHead head(6, 3, 8, 50);
  const Tensor h = torch::randn({4, 6});
  torch::Generator random = at::detail::createCPUGenerator(8);
  EXPECT_TRUE(torch::equal(head.sample(h, 0, 1, random), head.mean(h)));
  EXPECT_TRUE(torch::equal(head.sample(h, 25, 0, random), head.mean(h)));
}

TEST(DiffusionHead, RecoversATwoModeMixture) {  // A7
  torch::manual_seed(8);
  DiffusionHead head(4, 2, 64, 1000);
  initialiseXavier(head);
  head.zeroStart();
  torch::Generator random = at::detail::createCPUGenerator(9);
  const Tensor modes = torch::tensor({{-1.2f, .6f}, {.7f, -.5f}});
  constexpr double kMass = .3;  // of the first mode
  torch::optim::AdamW optimiser(head.parameters(),
                                torch::optim::AdamWOptions(3e-3).weight_decay(0));
  const Tensor h = torch::ones({256, 4});
  constexpr int kSteps = 1200;
  for (int step = 0; step < kSteps; ++step) {
    static_cast<torch::optim::AdamWOptions&>(optimiser.param_groups()[0].options())
        .lr(cosineRate(3e-3, step, kSteps, 20, .01));
    const Tensor which = (torch::rand({256}, random) >= kMass).to(torch::kInt64);
    const Tensor target = modes.index_select(0, which) + .1f * torch::randn({256, 2}, random);
    optimiser.zero_grad();
    const auto l = head.loss(h, target, torch::eye(2), 2, SnrWeight::kInverse, random);
    (l.linear + l.diffusion).backward();
    optimiser.step();
  }
  torch::NoGradGuard no_grad;
  const Tensor x = head.sample(torch::ones({4000, 4}), 50, 1, random);
  const Tensor first = x.select(1, 0) < -.25f;
  EXPECT_NEAR(first.to(torch::kFloat32).mean().item<double>(), kMass, .03);
  for (int mode = 0; mode < 2; ++mode) {
    const Tensor part = x.index_select(0, (mode == 0 ? first : ~first).nonzero().flatten());
    EXPECT_LT(largestDifference(part.mean(0), modes[mode]), .05);
    EXPECT_LT(part.std(0).max().item<double>(), .2) << "a mode of deviation .1";
  }
}

// --- the transformer -----------------------------------------------------------------------------

using Inputs = std::array<TokenSet, kTokenKinds>;

Inputs toyInputs() {
  const CompletionSample s = toySample();
  Inputs in;
  torch::manual_seed(9);
  for (int64_t i = 0; i < 20; ++i) in[kCondition].coords.push_back(s.condition.ijk[size_t(i)]);
  in[kVisible].coords = {Coord(5, 2, 1), Coord(6, 2, 1), Coord(6, 3, 1)};
  in[kEmptyToken].coords = {Coord(4, 2, 2), Coord(4, 4, 3)};
  in[kTarget].coords = {Coord(7, 2, 1), Coord(7, 2, 2), Coord(7, 3, 1), Coord(8, 9, 2),
                        Coord(9, 1, 1)};
  in[kCondition].features = torch::randn({20, kDim});
  in[kVisible].features = torch::randn({3, kDim});
  in[kTarget].features = torch::rand({5, 1});
  return in;
}

TEST(MaskedTransformer, FirstHalfDoesNotSeeTheTargets) {  // A4
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const auto net = makeNet(toyConfig(), 10);
  Inputs in = toyInputs();
  const auto before = net->trunk->forward(in, 1, s.condition.frame);
  in[kTarget].coords = {Coord(0, 0, 0), Coord(11, 9, 5)};
  in[kTarget].features = torch::full({2, 1}, 100.f);
  const auto after = net->trunk->forward(in, 1, s.condition.frame);
  EXPECT_EQ(before.context.size(0), 25);
  EXPECT_TRUE(torch::equal(before.context, after.context));
  // The second half does see them.
  EXPECT_GT(largestDifference(before.tokens.slice(0, 0, 25), after.tokens.slice(0, 0, 25)), 1e-3);
}

TEST(MaskedTransformer, EveryKindOfContextReachesTheTargets) {  // A4
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const auto net = makeNet(toyConfig(), 11);
  const Tensor before = net->fine(toyInputs(), s.condition.frame).logits;
  for (int kind : {kCondition, kVisible, kEmptyToken, kTarget}) {
    Inputs in = toyInputs();
    if (kind == kEmptyToken)
      in[kEmptyToken].coords[0] = Coord(3, 3, 3);
    else
      in[size_t(kind)].features[0] += 1;
    EXPECT_GT(largestDifference(net->fine(in, s.condition.frame).logits, before), 1e-6) << kind;
  }
}

TEST(MaskedTransformer, PermutedTargetsGivePermutedLogits) {
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const auto net = makeNet(toyConfig(), 12);
  Inputs in = toyInputs();
  const Tensor before = net->fine(in, s.condition.frame).logits;
  std::reverse(in[kTarget].coords.begin(), in[kTarget].coords.end());
  in[kTarget].features = in[kTarget].features.flip({0});
  EXPECT_LT(largestDifference(net->fine(in, s.condition.frame).logits, before.flip({0})), 1e-5);
}

TEST(MaskedTransformer, ParameterCountIsItsFormula) {  // A4
  for (const auto& [width, layers] : {std::pair<int64_t, int>{24, 2}, {48, 5}}) {
    const StageSizes sizes{int(width), 2, layers, {kDim, kDim, 0, 1}};
    const int64_t block = 12 * width * width + 13 * width;  // 4 projections, MLP of 4 x, 2 norms
    const int64_t embeddings = (kDim + kDim + 1 + 1) * width + kTokenKinds * (width + 2 * width);
    const int64_t positions = (kSinusoidalDim + 1) * width;
    EXPECT_EQ(parameterCount(MaskedTransformer(sizes, true, true)),
              embeddings + positions + 2 * layers * block + 2 * width);
  }
  const CompleterConfig paper = CompleterConfig::paper();
  EXPECT_EQ(paper.layers, 5);
  EXPECT_EQ(paper.width, 512);
  EXPECT_EQ(paper.coarse_layers, 2);
  EXPECT_EQ(paper.unobserved_weight, 0);
}

Inputs shifted(Inputs in, const Coord& by) {
  for (TokenSet& set : in)
    for (Coord& c : set.coords) c += by;
  return in;
}

TEST(MaskedTransformer, OnlyTheSinusoidalCodeKnowsWhereTheSceneIs) {  // A5
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  for (const bool code : {false, true}) {
    CompleterConfig c = toyConfig();
    c.position_code = code;
    const auto net = makeNet(c, 13);
    const Tensor here = net->fine(toyInputs(), s.condition.frame).logits;
    const Tensor there = net->fine(shifted(toyInputs(), Coord(8, -6, 4)), s.condition.frame).logits;
    if (code) {
      EXPECT_GT(largestDifference(here, there), 1e-3);
    } else {
      EXPECT_LT(largestDifference(here, there), 1e-5);
      // Rotary positions know where tokens are to each other.
      Inputs in = toyInputs();
      in[kTarget].coords[0] += Coord(0, 0, 2);
      EXPECT_GT(largestDifference(net->fine(in, s.condition.frame).logits, here), 1e-4);
    }
  }
}

TEST(CompleterNet, StandardiseAndRestoreAreInverse) {  // A14
  const auto net = makeNet(toyConfig(), 14);
  const Tensor z = torch::randn({9, kDim});
  EXPECT_LT(largestDifference(net->restore(net->standardise(z)), z), 1e-6);
}

// --- scenes as tokens ----------------------------------------------------------------------------

TEST(SceneTokens, ListNodesByStateAndShell) {
  const CompletionSample s = toySample();
  const SceneTokens t = sceneTokens(s.seen_nodes, s.seen_coarse);
  const auto listed = [](const std::vector<Coord>& coords, const Coord& c) {
    return std::count(coords.begin(), coords.end(), c);
  };
  const auto touches = [](const NodeStates& states, const Coord& c) {
    for (auto n = CoordBBox(c.offsetBy(-1), c.offsetBy(1)).begin(); n; ++n)
      if (states.box.isInside(*n) && states.at(*n) == NodeState::kUnobserved) return true;
    return false;
  };
  for (auto c = s.seen_nodes.box.begin(); c; ++c)
    EXPECT_EQ(listed(t.empty_shell, *c),
              s.seen_nodes.at(*c) == NodeState::kEmpty && touches(s.seen_nodes, *c));
  for (auto c = s.seen_coarse.box.begin(); c; ++c) {
    const NodeState state = s.seen_coarse.at(*c);
    EXPECT_EQ(listed(t.coarse_filled, *c), state == NodeState::kFilled);
    EXPECT_EQ(listed(t.coarse_unknown, *c), state == NodeState::kUnobserved);
    EXPECT_EQ(listed(t.coarse_empty, *c), state == NodeState::kEmpty && touches(s.seen_coarse, *c));
  }
}

TEST(SceneTokens, CoarseFeaturesAreTheStatesOfTheChildren) {
  const CompletionSample s = toySample();
  const std::vector<Coord> nodes = {Coord(0, 0, 0), Coord(2, 3, 1), Coord(5, 4, 2)};
  const Tensor f = coarseFeatures(nodes, s.seen_nodes);
  for (int64_t i = 0; i < 3; ++i)
    for (int slot = 0; slot < 8; ++slot) {
      const NodeState state = s.seen_nodes.at(childCoord(nodes[size_t(i)], slot));
      EXPECT_EQ(f[i][3 * slot].item<float>(), state == NodeState::kFilled);
      EXPECT_EQ(f[i][3 * slot + 1].item<float>(), state == NodeState::kEmpty);
      EXPECT_EQ(f[i][3 * slot + 2].item<float>(), state == NodeState::kUnobserved);
    }
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
}

// --- masks ---------------------------------------------------------------------------------------

/// Largest difference of the draws' distribution from the uniform one on [low, high].
double distanceFromUniform(std::vector<double> draws, double low, double high) {
  std::sort(draws.begin(), draws.end());
  double worst = 0;
  for (size_t i = 0; i < draws.size(); ++i)
    worst = std::max(
        worst, std::abs((double(i) + .5) / double(draws.size()) - (draws[i] - low) / (high - low)));
  return worst;
}

TEST(Masks, CoarseSharesAreDrawnAsTheSpecSays) {  // A2
  std::vector<Coord> unknown;
  for (auto c = CoordBBox(Coord(0), Coord(9, 9, 9)).begin(); c; ++c) unknown.push_back(*c);
  NodeStates truth = makeStates(2, CoordBBox(Coord(0), Coord(9, 9, 9)));
  std::fill(truth.states.begin(), truth.states.end(), NodeState::kFilled);
  torch::Generator random = at::detail::createCPUGenerator(16);
  std::vector<double> worked_on, hidden;
  int all_hidden = 0;
  for (int i = 0; i < 1500; ++i) {
    const CoarseMask m = drawCoarseMask(unknown, truth, random);
    std::set<Coord> both(m.visible.begin(), m.visible.end());
    both.insert(m.targets.begin(), m.targets.end());
    ASSERT_EQ(both.size(), m.visible.size() + m.targets.size())
        << "A3: visible and targets overlap";
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

TEST(Masks, OnlyFilledNodesAreShown) {  // A2
  const CompletionSample s = toySample();
  const SceneTokens t = sceneTokens(s.seen_nodes, s.seen_coarse);
  torch::Generator random = at::detail::createCPUGenerator(17);
  size_t shown = 0;
  for (int i = 0; i < 200; ++i)
    for (const Coord& c : drawCoarseMask(t.coarse_unknown, s.target_coarse, random).visible) {
      EXPECT_EQ(s.target_coarse.at(c), NodeState::kFilled);
      ++shown;
    }
  EXPECT_GT(shown, 0u);
}

/// Distance of each candidate from the seeds by a plain queue, 26 neighbours.
std::map<Coord, int> serialLevels(const std::vector<Coord>& candidates,
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

TEST(Masks, FineMasksShowNothingOrGrowthStatesOrRandomHoles) {  // A2, A3
  // A corridor of six empty nodes leads to a filled block: no growth state gets that far.
  CompletionSample s;
  const CoordBBox box(Coord(0), Coord(14, 5, 5));
  s.target_nodes = makeStates(1, box);
  s.condition.ijk = {Coord(0, 0, 0)};
  std::vector<Coord> candidates;
  for (int x = 1; x <= 6; ++x) candidates.push_back(Coord(x, 0, 0));
  for (auto c = CoordBBox(Coord(7, 0, 0), Coord(14, 5, 5)).begin(); c; ++c) {
    candidates.push_back(*c);
    s.target_nodes.states[size_t(s.target_nodes.index(*c))] = NodeState::kFilled;
  }
  const double filled = double(candidates.size() - 6);
  torch::Generator random = at::detail::createCPUGenerator(18);
  std::vector<double> hidden;
  int growth = 0;
  for (int i = 0; i < 2400; ++i) {
    const FineMask m = drawFineMask(candidates, s, .06, random);
    if (m.visible.empty())
      ++growth;
    else
      hidden.push_back(1 - double(m.visible.size()) / filled);
  }
  EXPECT_NEAR(growth / 2400., .875, .035);
  EXPECT_LT(distanceFromUniform(hidden, .5, 1), .1);
}

TEST(Masks, FineMasksPartitionTheCandidates) {  // A2, A3
  const CompletionSample s = toySample();
  std::vector<Coord> candidates;
  for (auto c = s.seen_nodes.box.begin(); c; ++c)
    if (s.seen_nodes.at(*c) == NodeState::kUnobserved) candidates.push_back(*c);
  const std::map<Coord, int> level = serialLevels(candidates, s.condition.ijk);
  torch::Generator random = at::detail::createCPUGenerator(19);
  std::set<int> depths, asked_alone;
  size_t wrong = 0, total = 0;
  for (int i = 0; i < 1200; ++i) {
    const FineMask m = drawFineMask(candidates, s, .06, random);
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
    const CoordBBox b = drawBounds(s, random);
    kept += b == own;
    bool holds = false;
    for (const Coord& token : s.condition.ijk)
      holds |= b.isInside(Coord(2 * token.x(), 2 * token.y(), 2 * token.z()));
    EXPECT_TRUE(holds);
    for (int axis = 0; axis < 3; ++axis) {
      EXPECT_EQ((b.min()[axis] - own.min()[axis]) % 4, 0);
      EXPECT_EQ((b.max()[axis] - own.max()[axis]) % 4, 0);
      EXPECT_LE(b.dim()[axis] * s.condition.frame.voxel_m, 16.01);
      EXPECT_GT(b.dim()[axis], 0);
      outwards += b.min()[axis]<own.min()[axis], inwards += b.min()[axis]> own.min()[axis];
    }
  }
  EXPECT_NEAR(kept, 300, 60);
  EXPECT_GT(outwards, 100);
  EXPECT_GT(inwards, 20);
}

TEST(SceneTokens, StatesInABoxAreThoseThereAndUnobservedBeyond) {
  const NodeStates s = toySample().seen_nodes;
  const auto voxel = [](const Coord& node) {
    return Coord(2 * node.x(), 2 * node.y(), 2 * node.z());
  };
  const CoordBBox box(voxel(s.box.min()) + Coord(4, -8, 0), voxel(s.box.max()) + Coord(9, -3, 1));
  const NodeStates part = statesIn(s, box);
  EXPECT_EQ(part.level, 1);
  EXPECT_EQ(part.box, CoordBBox(s.box.min() + Coord(2, -4, 0), s.box.max() + Coord(4, -2, 0)));
  int inside = 0;
  for (auto node = part.box.begin(); node; ++node) {
    inside += s.box.isInside(*node);
    EXPECT_EQ(part.at(*node), s.box.isInside(*node) ? s.at(*node) : NodeState::kUnobserved);
  }
  EXPECT_GT(inside, 0);
  EXPECT_LT(inside, int(part.states.size()));
}

// --- one training step ---------------------------------------------------------------------------

TEST(CompleterStep, LowersTheLossWithEitherWeight) {  // A14
  for (const bool paper : {false, true}) {
    CompleterConfig c = toyConfig();
    c.paper_snr_weight = paper;
    const CompleterStep step = completerStep(c, toySample(), 20);
    EXPECT_TRUE(std::isfinite(step.before));
    EXPECT_LT(step.after, step.before);
    EXPECT_GT(step.gradient_sum, 0);
  }
}

TEST(CompleterStep, RefinementSendsNoGradientToTheTrunk) {  // A8
  CompletionSample s = toySample();
  const CompleterStep step = completerStep(toyConfig(), s, 21);
  EXPECT_EQ(step.trunk_gradient_of_refinement, 0);
  EXPECT_GT(step.gradient_sum, 0);
  // The refinement loss is there: targets at the condition's own places enter nothing else.
  std::set<Coord> own(s.condition.ijk.begin(), s.condition.ijk.end());
  for (size_t i = 0; i < s.target.ijk.size(); ++i)
    if (own.count(s.target.ijk[i])) s.target.z[i * kDim] += 3;
  EXPECT_NE(completerStep(toyConfig(), s, 21).before, step.before);
}

TEST(CompleterStep, GarbageInTheUnobservedChangesNoBit) {  // A1, the paper's option
  CompleterConfig c = toyConfig();
  c.unobserved_weight = 0;
  const auto withGarbage = [](float value) {
    CompletionSample s = toySample();
    for (auto n = s.target_nodes.box.begin(); n; ++n)
      if (s.target_nodes.at(*n) == NodeState::kUnobserved) {
        s.target.ijk.push_back(*n);
        s.target.z.insert(s.target.z.end(), kDim, value * float((*n).x() + 1));
        s.target.generated.push_back(0), s.target.probability.push_back(1),
            s.target.bfs_level.push_back(0);
      }
    return s;
  };
  for (uint64_t seed = 22; seed < 26; ++seed) {
    const CompleterStep clean = completerStep(c, toySample(), seed);
    for (const float value : {1.f, -777.f, std::numeric_limits<float>::quiet_NaN()}) {
      const CompleterStep step = completerStep(c, withGarbage(value), seed);
      EXPECT_EQ(step.before, clean.before);
      EXPECT_EQ(step.after, clean.after);
      EXPECT_EQ(step.gradient_sum, clean.gradient_sum);
    }
  }
}

TEST(CompleterStep, UnobservedTargetsWeighWhatTheConfigurationSays) {  // A1
  // Nothing but U to learn from: with weight 0 occupancy gives no loss, and it is linear in the
  // weight.
  CompletionSample s = toySample();
  for (NodeStates* truth : {&s.target_nodes, &s.target_coarse})
    for (auto n = truth->box.begin(); n; ++n) {
      const NodeStates& seen = truth == &s.target_nodes ? s.seen_nodes : s.seen_coarse;
      truth->states[size_t(truth->index(*n))] = seen.at(*n);
    }
  s.target = s.condition;
  const auto loss = [&](float weight) {
    CompleterConfig c = toyConfig();
    c.unobserved_weight = weight;
    return completerStep(c, s, 29).before;
  };
  const double none = loss(0), quarter = loss(.25f), full = loss(1);
  EXPECT_GT(full - none, .1);
  EXPECT_NEAR((quarter - none) / (full - none), .25, 1e-4);
}

// --- completion ----------------------------------------------------------------------------------

class CompleterFile : public InFolder {
 protected:
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
  /// The coarse stage's probabilities, from the network itself.
  std::map<Coord, float> gate() const {
    torch::NoGradGuard no_grad;
    const SceneTokens t = sceneTokens(sample_.seen_nodes, sample_.seen_coarse);
    const Tensor p =
        net_->coarseLogits(coarseInputs(t, {}, t.coarse_unknown, net_->config.coarse_empty_tokens),
                           sample_.condition.frame)
            .sigmoid();
    std::map<Coord, float> gate;
    for (const Coord& c : t.coarse_filled) gate[c] = 1;
    for (size_t i = 0; i < t.coarse_unknown.size(); ++i)
      gate[t.coarse_unknown[i]] = p[int64_t(i)].item<float>();
    return gate;
  }
  /// Unobserved nodes of the coarse nodes above the threshold.
  std::vector<Coord> candidates(float coarse_tau) const {
    std::vector<Coord> nodes;
    for (const auto& [node, p] : gate())
      for (int slot = 0; slot < 8; ++slot) {
        const Coord c = childCoord(node, slot);
        if (p > coarse_tau && sample_.seen_nodes.at(c) == NodeState::kUnobserved)
          nodes.push_back(c);
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
  std::shared_ptr<CompleterNet> net_;
  Progress silent_;
};

TEST_F(CompleterFile, ObservedRowsAreUntouchedAndNoNodeComesTwice) {  // A3, A11
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

TEST_F(CompleterFile, VisitsEveryCandidateOnceInBreadthFirstOrder) {  // A10, A11, A12
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = 0;  // keeps whatever is visited
  for (const float coarse_tau : {0.f, .5f, .9999f}) {
    settings.coarse_tau = coarse_tau;
    const Place whole = complete(completer, settings);
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

TEST_F(CompleterFile, TheFineStageStaysInsideWhatTheCoarseStageKept) {  // A10
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
  const Place whole = complete(completer, settings);
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
    const Place whole = complete(completer, settings);
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

TEST_F(CompleterFile, NothingBeatsAThresholdOfOne) {  // A13
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = 1, settings.hole_tau = 1;
  EXPECT_EQ(complete(completer, settings).size(), sample_.condition.size());
}

TEST_F(CompleterFile, SameSeedSameGrid) {  // A11
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

TEST_F(CompleterFile, KeptTokensConditionTheNextLevel) {  // A11
  CompleterConfig c = toyConfig();
  c.chunk_tokens = 4096;
  const Completer completer = completerOf(c);
  CompleteSettings settings;
  settings.tau = 0, settings.generated_context = true;
  const Place whole = complete(completer, settings);
  // By hand: level 2 with level 1 in its context, and, to tell it apart, without.
  const SceneTokens t = sceneTokens(sample_.seen_nodes, sample_.seen_coarse);
  const std::map<Coord, float> open = gate();
  torch::NoGradGuard no_grad;
  Inputs in;
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
  for (const bool generated_context : {false, true}) {
    CompleteSettings settings;
    settings.tau = .5f, settings.hole_tau = .1f, settings.sampling_steps = 3;
    settings.generated_context = generated_context;
    std::vector<std::pair<Place, int32_t>> stops;
    const Place whole = completer.complete(startOf(sample_), settings, silent_,
                                           [&](const Place& so_far, int32_t next_level) {
                                             stops.push_back({so_far, next_level});
                                           });
    ASSERT_GE(stops.size(), 3u);
    for (const auto& [so_far, next_level] : stops) {
      SCOPED_TRACE(next_level);
      settings.first_level = next_level, settings.resumed = true;
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
  const Place everywhere = complete(completer, settings);
  auto region = std::make_shared<TokenMask>();
  region->fill(CoordBBox(Coord(6, 0, 0), Coord(9, 9, 5)), true, true);
  settings.region = region;
  const Place some = complete(completer, settings);
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
  // A floor of 30 m, seen at one end and in the middle; dense states of the rest are unknown.
  const Completer completer = completerOf(toyConfig());
  Place seen;
  seen.dim = kDim;
  seen.frame.bounds = CoordBBox(Coord(0), Coord(303, 15, 7));
  const auto space = std::make_shared<SeenSpace>();
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
  const Place whole = completer.complete(seen, settings, silent_);
  expectNoDuplicates(whole);
  // Four windows of 38 nodes; the last one is too far from anything seen.
  EXPECT_EQ(whole.size(), 3 * 38 * 8 * 4);
  for (const Coord& c : whole.ijk) EXPECT_LT(c.x(), 3 * 38);
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

TEST_F(CompleterFile, RefinementRewritesObservedLatentsAlone) {  // A8
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
  grid.seen = spaceOf(sample_.seen_nodes);
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
  NodeStates all = sample_.seen_nodes;
  for (NodeState& s : all.states)
    if (s == NodeState::kUnobserved) s = NodeState::kEmpty;
  Place start = sample_.condition;
  start.seen = spaceOf(all);
  const Place whole = completer.complete(start, {}, silent_);
  EXPECT_EQ(whole.ijk, sample_.condition.ijk);
  EXPECT_EQ(whole.z, sample_.condition.z);
}

// --- closing holes -------------------------------------------------------------------------------

/// Whether the border can be reached from the seen empty nodes through faces.
bool isOpen(const NodeStates& nodes, const std::set<Coord>& solid) {
  std::set<Coord> reached;
  std::deque<Coord> queue;
  for (auto c = nodes.box.begin(); c; ++c)
    if (nodes.at(*c) == NodeState::kEmpty) reached.insert(*c), queue.push_back(*c);
  while (!queue.empty()) {
    const Coord at = queue.front();
    queue.pop_front();
    for (int axis = 0; axis < 3; ++axis)
      for (int side : {-1, 1}) {
        Coord n = at;
        n[axis] += side;
        if (!nodes.box.isInside(n)) return true;
        if (!solid.count(n) && reached.insert(n).second) queue.push_back(n);
      }
  }
  return false;
}

TEST(ClosingTokens, AreTheCheapestOfAllThatClose) {  // against every subset
  // One seen empty node in a 5^3 block; the 26 nodes around it are walls but for some holes.
  const CoordBBox box(Coord(0), Coord(4));
  std::mt19937 random(3);
  std::uniform_real_distribution<float> chance(.05f, .95f);
  int closed = 0;
  for (int trial = 0; trial < 40; ++trial) {
    NodeStates nodes = makeStates(1, box);
    nodes.states[size_t(nodes.index(Coord(2)))] = NodeState::kEmpty;
    std::vector<Coord> walls;
    std::map<Coord, float> dropped;
    for (auto c = CoordBBox(Coord(1), Coord(3)).begin(); c; ++c) {
      if (*c == Coord(2)) continue;
      if (random() % 3 == 0 && dropped.size() < 11)
        dropped[*c] = chance(random);
      else
        walls.push_back(*c);
    }
    // Another way to close the same holes, one node further out.
    if (!dropped.empty() && dropped.size() < 12) {
      Coord outer = dropped.begin()->first;
      for (int axis = 0; axis < 3; ++axis)
        if (outer[axis] != 2) {
          outer[axis] += outer[axis] - 2;
          break;
        }
      dropped[outer] = chance(random);
    }
    double best = 1e30;
    std::set<Coord> cheapest;
    const std::vector<std::pair<Coord, float>> list(dropped.begin(), dropped.end());
    for (size_t subset = 0; subset < size_t(1) << list.size(); ++subset) {
      std::set<Coord> solid(walls.begin(), walls.end()), chosen;
      double cost = 0;
      for (size_t i = 0; i < list.size(); ++i)
        if (subset >> i & 1) chosen.insert(list[i].first), cost -= std::log(double(list[i].second));
      if (cost >= best) continue;
      solid.insert(chosen.begin(), chosen.end());
      if (!isOpen(nodes, solid)) best = cost, cheapest = chosen;
    }
    const std::vector<Coord> found = closingTokens(nodes, walls, dropped, 0);
    EXPECT_EQ(std::set<Coord>(found.begin(), found.end()), cheapest) << trial;
    closed += !cheapest.empty();
    float likeliest = 0;
    for (const Coord& c : found) likeliest = std::max(likeliest, dropped.at(c));
    EXPECT_TRUE(closingTokens(nodes, walls, dropped, likeliest).empty());
  }
  EXPECT_GT(closed, 20);
}

TEST(ClosingTokens, WhatCannotBeClosedIsClosedAsFarAsItCan) {
  // A tunnel of seen empty nodes with two mouths: one has a dropped token in it, one has none.
  NodeStates nodes = makeStates(1, CoordBBox(Coord(0), Coord(8, 2, 2)));
  std::vector<Coord> walls;
  for (auto c = nodes.box.begin(); c; ++c) {
    const bool inside = (*c).y() == 1 && (*c).z() == 1;
    if (!inside)
      walls.push_back(*c);
    else if ((*c).x() >= 2 && (*c).x() <= 6)
      nodes.states[size_t(nodes.index(*c))] = NodeState::kEmpty;
  }
  const Coord mouth(1, 1, 1);
  EXPECT_EQ(closingTokens(nodes, walls, {{mouth, .2f}}, .1f), std::vector<Coord>{mouth});
  EXPECT_TRUE(closingTokens(nodes, walls, {{mouth, .2f}}, .3f).empty());
  EXPECT_TRUE(closingTokens(nodes, walls, {}, 0).empty());
}

TEST_F(CompleterFile, HolesAreClosedWithDroppedTokensAlone) {
  const Completer completer = completerOf(toyConfig());
  CompleteSettings settings;
  settings.tau = .5f, settings.hole_tau = 1;
  const Place open = complete(completer, settings);
  settings.tau = 0;
  const Place everything = complete(completer, settings);
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
    EXPECT_LE(closed.probability[i], .5f);
    EXPECT_EQ(closed.probability[i], everything.probability[same]);
    EXPECT_EQ(closed.bfs_level[i], everything.bfs_level[same]);
    EXPECT_TRUE(
        std::equal(&closed.z[i * kDim], &closed.z[i * kDim] + kDim, &everything.z[same * kDim]));
  }
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
    std::ofstream(bad, std::ios::binary) << bytes.substr(0, n);
    EXPECT_THROW(Completer{bad}, Error) << n;
  }
}

TEST(CompleterConfig, JsonRoundTripIsExact) {
  for (const CompleterConfig& c : {CompleterConfig::small(), CompleterConfig::paper(), toyConfig()})
    EXPECT_EQ(CompleterConfig::fromJson(c.toJson(), "test").toJson(), c.toJson());
}

// --- samples in files ----------------------------------------------------------------------------

class SampleFile : public InFolder {};

TEST_F(SampleFile, RoundTripIsExact) {
  const CompletionSample s = toySample();
  writeSample(s, path("sample"));
  const CompletionSample r = readSample(path("sample"));
  for (const auto& [a, b] :
       {std::make_pair(&s.condition, &r.condition), std::make_pair(&s.target, &r.target)}) {
    EXPECT_EQ(a->ijk, b->ijk);
    EXPECT_EQ(a->z, b->z);
    EXPECT_EQ(a->dim, b->dim);
    EXPECT_EQ(a->generated, b->generated);
    EXPECT_EQ(a->probability, b->probability);
    EXPECT_EQ(a->bfs_level, b->bfs_level);
    EXPECT_EQ(a->frame.bounds, b->frame.bounds);
    EXPECT_EQ(a->frame.voxel_m, b->frame.voxel_m);
  }
  for (const auto& [a, b] : {std::make_pair(&s.seen_nodes, &r.seen_nodes),
                             std::make_pair(&s.seen_coarse, &r.seen_coarse),
                             std::make_pair(&s.target_nodes, &r.target_nodes),
                             std::make_pair(&s.target_coarse, &r.target_coarse)}) {
    EXPECT_EQ(a->level, b->level);
    EXPECT_EQ(a->box, b->box);
    EXPECT_EQ(a->states, b->states);
  }
}

TEST_F(SampleFile, BadFilesThrow) {
  writeSample(toySample(), path("sample"));
  const std::string bytes = bytesOf(path("sample"));
  for (size_t n = 0; n < bytes.size(); n += 97) {
    std::ofstream(path("bad"), std::ios::binary) << bytes.substr(0, n);
    EXPECT_THROW(readSample(path("bad")), Error) << n;
  }
  const TensorFile file = readTensors(path("sample"));
  const auto rejected = [&](const std::string& name, const Tensor& value) {
    TensorFile changed = file;
    changed.tensors[name] = value;
    writeTensors(changed, path("bad"));
    EXPECT_THROW(readSample(path("bad")), Error) << name;
  };
  rejected("condition.ijk", torch::zeros({3, 3}, torch::kInt32));
  rejected("condition.z", torch::zeros({2, kDim}));
  rejected("target.z", torch::zeros({5}));
  rejected("bounds", torch::zeros({5}, torch::kInt32));
  rejected("seen_nodes", torch::zeros({3}, torch::kInt32));
  rejected("seen_nodes", torch::full({200}, 0x03030303, torch::kInt32));
  rejected("seen_nodes", torch::tensor({1, 0, 0, 0, 8000, 8000, 8000, 0}, torch::kInt32));
  rejected("seen_nodes", torch::tensor({1, 0, 0, 0, -1, -1, -1}, torch::kInt32));
  Tensor states = file.tensors.at("seen_nodes").clone();
  states[9] = 7;  // no state
  rejected("seen_nodes", states);
}

// --- training ------------------------------------------------------------------------------------

class StopAtHalf : public Progress {
 public:
  bool wasInterrupted(int percent = -1) override { return percent == 50; }
};

class CompleterResume : public InFolder {};
const std::vector<float> kOneColour = {1, -1, 0, 0, 0, 0, 0, 0};

TEST_F(CompleterResume, AnInterruptedRunEndsAsAnUninterruptedOne) {  // A14
  const CompleterConfig c = toyConfig();
  const SampleSource samples = [](uint64_t index) { return toySample(3 + int(index)); };
  TrainSettings settings;
  settings.steps = 6, settings.warmup = 2, settings.validate_every = settings.checkpoint_every = 3;
  settings.metadata["trained_on"] = "toys";
  const auto train = [&](const std::string& name, bool resume, Progress& progress) {
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    settings.resume = resume;
    std::vector<TrainLogRow> rows;
    trainCompleter(
        c, kOneColour, samples, 4, samples, 2, settings,
        [&](const TrainLogRow& row) { rows.push_back(row); }, progress);
    return rows;
  };
  Progress silent;
  const std::vector<TrainLogRow> rows = train("whole", false, silent);
  ASSERT_EQ(rows.size(), 2u);
  for (const char* value :
       {"loss", "coarse", "fine", "linear", "diffusion", "refinement", "val_f1"})
    EXPECT_TRUE(std::isfinite(rows[1].values.at(value))) << value;
  StopAtHalf stop;
  EXPECT_THROW(train("parts", false, stop), Cancelled);
  EXPECT_TRUE(bytesOf(path("parts.safetensors")) != bytesOf(path("whole.safetensors")));
  train("parts", true, silent);
  EXPECT_TRUE(bytesOf(path("parts.safetensors")) == bytesOf(path("whole.safetensors")));
  EXPECT_TRUE(bytesOf(path("parts/checkpoint.safetensors")) ==
              bytesOf(path("whole/checkpoint.safetensors")));
  EXPECT_TRUE(bytesOf(path("parts/log.csv")) == bytesOf(path("whole/log.csv")));
  const Completer completer(path("whole.safetensors"));
  EXPECT_EQ(completer.trainedOn(), "toys");
  // Latents were scaled to unit deviation, over the scenes it was trained on.
  const TensorFile file = readTensors(path("whole.safetensors"));
  std::vector<Tensor> all;
  for (uint64_t i = 0; i < 4; ++i)
    all.push_back(torch::tensor(samples(i).target.z).view({-1, kDim}));
  const Tensor z = torch::cat(all);
  EXPECT_LT(largestDifference((z - file.tensors.at("latent_mean")).mean(0), torch::zeros({kDim})),
            1e-5);
  EXPECT_LT(largestDifference(
                ((z - file.tensors.at("latent_mean")) / file.tensors.at("latent_deviation")).std(0),
                torch::ones({kDim})),
            1e-4);
  settings.resume = true;
  settings.work_folder = path("none");
  EXPECT_THROW(trainCompleter(c, kOneColour, samples, 4, samples, 0, settings, nullptr, silent),
               Error);
}

TEST_F(CompleterResume, ATrainingCanStartFromGivenWeights) {
  CompleterConfig c = toyConfig();
  const SampleSource samples = [](uint64_t index) { return toySample(3 + int(index)); };
  TrainSettings settings;
  settings.steps = 2, settings.validate_every = settings.checkpoint_every = 2;
  Progress silent;
  const auto train = [&](const std::string& name) {
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    trainCompleter(c, kOneColour, samples, 2, samples, 0, settings, nullptr, silent);
    return readTensors(settings.weights_path).tensors;
  };
  const auto first = train("first");
  // Other samples' latents, another seed and other settings: with a rate of 0 nothing of them
  // shows.
  settings.from = path("first.safetensors"), settings.learning_rate = 0, settings.seed = 2;
  c.rotary_positions = false;
  for (const auto& [name, tensor] : train("second"))
    EXPECT_TRUE(torch::equal(tensor, first.at(name))) << name;
  c.width = 16;
  EXPECT_THROW(train("third"), Error);
}

}  // namespace
}  // namespace vdbc
