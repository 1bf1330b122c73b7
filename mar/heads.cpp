#include "mar/heads.h"

#include <cmath>

namespace vdbc {

namespace nn = torch::nn;

Tensor focalLoss(const Tensor& logits, const Tensor& truth, const Tensor& weights, double gamma,
                 double alpha) {
  const Tensor bce =
      torch::binary_cross_entropy_with_logits(logits, truth, {}, {}, at::Reduction::None);
  const Tensor p = logits.sigmoid();
  const Tensor miss = truth * (1 - p) + (1 - truth) * p;  // 1 - p_t
  const Tensor alpha_t = truth * alpha + (1 - truth) * (1 - alpha);
  const Tensor focus = gamma == 0 ? torch::ones_like(miss) : miss.pow(gamma);
  return (weights * alpha_t * focus * bce).mean();
}

OccupancyHead::OccupancyHead(int width) {
  first = register_module("first", Linear(width, width));
  second = register_module("second", Linear(width, width));
  third = register_module("third", Linear(width, 1));
}

Tensor OccupancyHead::forward(const Tensor& h) {
  return third->forward(torch::gelu(second->forward(torch::gelu(first->forward(h))))).squeeze(1);
}

std::vector<float> cosineAlphaBar(int steps) {
  auto f = [&](double t) {
    const double c = std::cos((t / steps + .008) / 1.008 * M_PI / 2);
    return c * c;
  };
  std::vector<float> bar;
  for (int t = 1; t <= steps; ++t) bar.push_back(float(std::max(1e-4, f(t) / f(0))));
  return bar;
}

float snrWeight(SnrWeight kind, float alpha_bar) {
  return kind == SnrWeight::kSnr ? alpha_bar : std::min(1 / alpha_bar, 20.f);
}

DiffusionHead::DiffusionHead(int width, int latent, int hidden, int steps_)
    : latent_dim(latent), steps(steps_), alpha_bar(torch::tensor(cosineAlphaBar(steps_))) {
  linear = register_module("linear", Linear(width, latent));
  in = register_module("in", Linear(latent, hidden));
  condition = register_module("condition", Linear(width, hidden));
  time = register_module("time", Linear(64, hidden));
  for (int i = 0; i < 2; ++i) {
    modulation.push_back(
        register_module("modulation" + std::to_string(i), Linear(hidden, 3 * hidden)));
    layers.push_back(register_module("layer" + std::to_string(i),
                                     std::make_shared<Mlp>(hidden, hidden, hidden)));
  }
  out_modulation = register_module("out_modulation", Linear(hidden, 2 * hidden));
  out = register_module("out", Linear(hidden, latent));
  zeroStart();
}

void DiffusionHead::zeroStart() {
  torch::NoGradGuard no_grad;
  for (auto& m : modulation) m->weight.zero_(), m->bias.zero_();
  out_modulation->weight.zero_(), out_modulation->bias.zero_();
  out->weight.zero_(), out->bias.zero_();
}

Tensor DiffusionHead::noise(const Tensor& x, const Tensor& t, const Tensor& h) {
  const Tensor octaves =
      torch::exp(torch::arange(32, torch::kFloat32) * float(-std::log(1e4) / 31));
  const Tensor angle = (t.to(torch::kFloat32) * (1000.f / float(steps))).unsqueeze(1) * octaves;
  const Tensor c =
      torch::silu(condition->forward(h) + time->forward(torch::cat({angle.sin(), angle.cos()}, 1)));
  auto normed = [](const Tensor& v) { return torch::layer_norm(v, {v.size(1)}); };
  Tensor y = in->forward(x);
  for (size_t i = 0; i < layers.size(); ++i) {
    const auto m = modulation[i]->forward(c).chunk(3, 1);  // shift, scale, gate
    y = y + m[2] * layers[i]->forward(normed(y) * (1 + m[1]) + m[0]);
  }
  const auto m = out_modulation->forward(c).chunk(2, 1);
  return out->forward(normed(y) * (1 + m[1]) + m[0]);
}

DiffusionHead::Loss DiffusionHead::loss(const Tensor& h, const Tensor& target,
                                        const Tensor& colour_way, int draws, SnrWeight kind,
                                        torch::Generator& random) {
  Loss l;
  const Tensor predicted = mean(h), error = predicted - target;
  l.linear = error.square().mean() + torch::matmul(error, colour_way.t()).square().mean();
  l.diffusion = torch::zeros({});
  if (draws == 0) return l;
  const Tensor x0 = (target - predicted).detach().repeat({draws, 1});
  const Tensor t = torch::randint(steps, {x0.size(0)}, random, torch::kInt64);
  const Tensor bar = alpha_bar.index_select(0, t).unsqueeze(1);
  const Tensor weight = kind == SnrWeight::kSnr ? bar : (1 / bar).clamp_max(20);
  const Tensor epsilon = torch::randn(x0.sizes(), random);
  const Tensor x = bar.sqrt() * x0 + (1 - bar).sqrt() * epsilon;
  l.diffusion = (weight * (noise(x, t, h.repeat({draws, 1})) - epsilon).square()).mean();
  return l;
}

// Residuals around the mean are of latents of unit deviation (standardise()).
constexpr double kLargest = 4;

Tensor DiffusionHead::sample(const Tensor& h, int sampling_steps, double temperature,
                             torch::Generator& random) {
  const Tensor centre = mean(h);
  if (sampling_steps <= 0 || temperature <= 0) return centre;
  const float* bars = alpha_bar.data_ptr<float>();
  Tensor x = torch::randn(centre.sizes(), random) * temperature;
  for (int i = 0; i < sampling_steps; ++i) {
    const int now = (steps - 1) - int(int64_t(steps - 1) * i / sampling_steps);
    const int next = (steps - 1) - int(int64_t(steps - 1) * (i + 1) / sampling_steps);
    const double bar = bars[now], bar_next = i + 1 == sampling_steps ? 1.0 : double(bars[next]);
    const Tensor predicted = noise(x, torch::full({x.size(0)}, now, torch::kInt64), h);
    // The first steps divide by .01: an error of the noise becomes 100 of x0. No latent lies there.
    const Tensor x0 =
        ((x - std::sqrt(1 - bar) * predicted) / std::sqrt(bar)).clamp(-kLargest, kLargest);
    const Tensor epsilon = (x - std::sqrt(bar) * x0) / std::sqrt(1 - bar);
    x = std::sqrt(bar_next) * x0 + std::sqrt(1 - bar_next) * epsilon;
  }
  return centre + x;
}

}  // namespace vdbc
