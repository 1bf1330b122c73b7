// Laws of the completer's token-wise heads (docs/method.md, sections 4.4 and 4.5).
#include "mar/heads.h"

#include <gtest/gtest.h>
#include <torch/optim/adamw.h>

#include <cmath>

#include "tests/toy_completer.h"

namespace vdbc {
namespace {

TEST(FocalLoss, WithGammaZeroAndAlphaHalfIsHalfTheCrossEntropy) {  // section 4.4
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

TEST(FocalLoss, EqualsItsFormula) {  // section 4.4, Lin et al. 2017, eq. 5
  for (const double x : {-4., -.5, 0., 2.})
    for (const float t : {0.f, 1.f}) {
      const double p = 1 / (1 + std::exp(-x)), p_t = t > 0 ? p : 1 - p, alpha_t = t > 0 ? .3 : .7;
      EXPECT_NEAR(focalLoss(torch::full({1}, x), torch::full({1}, t), torch::ones({1}), 2, .3)
                      .item<double>(),
                  -alpha_t * std::pow(1 - p_t, 2) * std::log(p_t), 1e-6);
    }
}

TEST(FocalLoss, GradientMatchesFiniteDifferences) {  // section 4.4
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

TEST(OccupancyHead, IsThreeLinearLayersWithOneLogit) {  // section 4.4
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

TEST(NoiseSchedule, FollowsTheCosine) {  // section 4.5, Nichol & Dhariwal 2021, eq. 17
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

TEST(NoiseSchedule, WeightsAreTheirFormulas) {  // section 4.5
  for (const float bar : {.999f, .7f, .2f, .06f, .01f}) {
    const float snr = bar / (1 - bar);
    EXPECT_NEAR(snrWeight(SnrWeight::kSnr, bar), snr / (1 + snr), 1e-5);
    // An error of epsilon, times sqrt((1 - bar) / bar), is one of x0.
    EXPECT_NEAR(snrWeight(SnrWeight::kInverse, bar), std::min(20.f, (1 + 1 / snr)), 1e-4);
  }
}

TEST(DiffusionHead, FreshOutputIsExactlyZero) {  // section 4.5
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

TEST(DiffusionHead, LossIsTheWeightedErrorOfTheNoise) {  // section 4.5: term by term
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

TEST(DiffusionHead, LinearMeanIsBehindAStopGradient) {  // section 4.5
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

TEST(DiffusionHead, RecoversATwoModeMixture) {  // section 4.5
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

}  // namespace
}  // namespace vdbc
