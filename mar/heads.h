#pragma once
// Private: the completer's token-wise heads: occupancy and diffusion (docs/method.md, sections 4.4
// to 4.6).
#include "encoder/layers.h"

namespace vdbc {

/// Focal loss, mean of weights * alpha_t (1 - p_t)^gamma * BCE; alpha_t = alpha for truth 1, 1 -
/// alpha for 0. gamma 0 and alpha .5 is half the BCE. logits, truth, weights: [N]. Lin et al. 2017.
Tensor focalLoss(const Tensor& logits, const Tensor& truth, const Tensor& weights, double gamma,
                 double alpha);

/// Three linear layers with GELU, one logit a token.
struct OccupancyHead : torch::nn::Module {
  explicit OccupancyHead(int width);
  Tensor forward(const Tensor& h);  // [N, C] -> [N]
  Linear first{nullptr}, second{nullptr}, third{nullptr};
};

/// Cosine noise schedule of T steps (Nichol & Dhariwal 2021): alpha_bar[t], t = 0..T-1, falling.
std::vector<float> cosineAlphaBar(int steps);

/// Which noise levels count how much in the loss. The paper contradicts itself here: both are kept.
enum class SnrWeight {
  kInverse,  // min(1 / alpha_bar, 20): a plain error of x0 scaled up with noise; trains fastest
             // here
  kSnr       // SNR / (1 + SNR) = alpha_bar: falls with noise (the paper's remark)
};
float snrWeight(SnrWeight kind, float alpha_bar);

/// Predicts a latent from a token: a linear mean, and a DDPM over the residual around it. The
/// denoiser is token-wise, adaLN-conditioned, zero-initialised at its output (Li et al. 2024;
/// Peebles & Xie 2023).
struct DiffusionHead : torch::nn::Module {
  DiffusionHead(int width, int latent_dim, int hidden, int steps);

  Tensor mean(const Tensor& h) { return linear->forward(h); }  // [N, C] -> [N, D]
  /// Noise predicted in x [N, D] at steps t [N] (int64), given tokens h [N, C].
  Tensor noise(const Tensor& x, const Tensor& t, const Tensor& h);
  struct Loss {
    Tensor linear, diffusion;
  };
  /// Squared errors, mean over tokens and channels, of the linear mean also over its colours:
  /// `colour_way` [K, D] makes them. `draws` noise levels a token (0: the linear mean alone).
  /// Behind the linear mean is a stop-gradient.
  Loss loss(const Tensor& h, const Tensor& target, const Tensor& colour_way, int draws,
            SnrWeight weight, torch::Generator& random);
  /// `sampling_steps` deterministic (DDIM) steps from noise of deviation `temperature`; 0 steps, or
  /// temperature 0, is the linear mean.
  Tensor sample(const Tensor& h, int sampling_steps, double temperature, torch::Generator& random);
  /// Zeroes what must start at zero; call after initialiseXavier().
  void zeroStart();

  int latent_dim, steps;
  Tensor alpha_bar;  // [T], constant, not a parameter
  Linear linear{nullptr}, in{nullptr}, condition{nullptr}, time{nullptr}, out{nullptr};
  std::vector<Linear> modulation;
  std::vector<std::shared_ptr<Mlp>> layers;
  Linear out_modulation{nullptr};
};

}  // namespace vdbc
