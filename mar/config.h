#pragma once
// What the completer's weights were made for.
#include <string>

#include "encoder/positions.h"
#include "mar/calibration.h"

namespace vdbc {

/// Every size and constant of the completer; saved inside the weights file.
struct CompleterConfig {
  std::string preset = "small";
  int latent_dim = 64, latent_groups = 1;                      // as the encoder's
  int width = 128, heads = 4, layers = 3;                      // fine stage; layers each in H1, H2
  int coarse_width = 96, coarse_heads = 3, coarse_layers = 2;  // coarse stage, one tree level up
  int diffusion_width = 256, diffusion_steps = 1000, diffusion_draws = 2;
  bool paper_snr_weight = false;  // SNR / (1 + SNR) instead of min(1 / alpha_bar, 20)
  bool rotary_positions = true;   // 3-D RoPE in self-attention
  bool position_code = true;      // sinusoidal code on every token
  bool coarse_stage = true;       // false: one dense stage, every unobserved token is a candidate
  PositionConfig positions;
  /// Places wider than positions.extent_m are looked at in windows that overlap by so much at each
  /// side, metres.
  float window_overlap_m = 1.6f;
  // What the fine stage sees around a chunk of targets, nearest first.
  int context_tokens = 384, empty_tokens = 64, chunk_tokens = 160;
  int coarse_empty_tokens = 256, coarse_chunk_tokens = 1024;
  Calibration calibration;  // of the fine stage's probabilities

  // Loss.
  float focal_gamma = 0, focal_alpha = .5f;
  float unobserved_weight = .25f;  // of U, labelled empty; 0 masks U from the loss as in the paper
  float diffusion_weight = .5f, refinement_weight = .25f;  // occupancy and linear mean: 1
  // What a training step hides and asks.
  float frontier_share = .6f;   // of a chunk's targets, at most
  float alone_share = .75f;     // of the samples: condition tokens are all that is visible
  float own_gate_share = .75f;  // of the second half's samples: behind the coarse stage as it is
  float window_share = .5f;     // of the samples: looked at through another window
  // Generated tokens in training's context, up to: deviation of noise on their latents, share of
  // wrong ones.
  float context_noise = .2f, context_false_positives = .06f;

  static CompleterConfig small() { return {}; }
  /// The paper's sizes; for GPUs.
  static CompleterConfig paper();
  std::string toJson() const;
  /// Fields that the text lacks have their defaults. Throws Error on unknown fields and sizes that
  /// cannot work; `where` names the file.
  static CompleterConfig fromJson(const std::string& text, const std::string& where);

  template <typename Config, typename Visit>
  static void fields(Config& c, Visit&& visit) {
    visit("preset", c.preset), visit("latent_dim", c.latent_dim);
    visit("latent_groups", c.latent_groups), visit("width", c.width), visit("heads", c.heads);
    visit("layers", c.layers), visit("coarse_width", c.coarse_width);
    visit("coarse_heads", c.coarse_heads), visit("coarse_layers", c.coarse_layers);
    visit("diffusion_width", c.diffusion_width), visit("diffusion_steps", c.diffusion_steps);
    visit("diffusion_draws", c.diffusion_draws), visit("paper_snr_weight", c.paper_snr_weight);
    visit("rotary_positions", c.rotary_positions), visit("position_code", c.position_code);
    visit("coarse_stage", c.coarse_stage);
    PositionConfig::fields(c.positions, visit);
    visit("window_overlap_m", c.window_overlap_m), visit("context_tokens", c.context_tokens);
    visit("empty_tokens", c.empty_tokens), visit("chunk_tokens", c.chunk_tokens);
    visit("coarse_empty_tokens", c.coarse_empty_tokens);
    visit("coarse_chunk_tokens", c.coarse_chunk_tokens);
    Calibration::fields(c.calibration, visit), visit("focal_gamma", c.focal_gamma);
    visit("focal_alpha", c.focal_alpha), visit("unobserved_weight", c.unobserved_weight);
    visit("diffusion_weight", c.diffusion_weight);
    visit("refinement_weight", c.refinement_weight), visit("frontier_share", c.frontier_share);
    visit("alone_share", c.alone_share), visit("own_gate_share", c.own_gate_share);
    visit("window_share", c.window_share), visit("context_noise", c.context_noise);
    visit("context_false_positives", c.context_false_positives);
  }
};

}  // namespace vdbc
