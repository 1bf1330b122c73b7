#pragma once
// The masked auto-regressive completer: which unseen tokens are occupied, and with which latents
// (paper sec. 4, spec A1-A14).
#include <memory>
#include <string>

#include "vdb/frontier.h"
#include "vdb/latent_grid.h"

namespace vdbc {

/// Every size of the completer; saved inside the weights file.
struct CompleterConfig {
  std::string preset = "small";
  int latent_dim = 32, latent_groups = 8;               // as the encoder's (spec E10)
  int width = 128, heads = 4, layers = 3;               // fine stage; layers each in H1 and H2
  int coarse_width = 96, coarse_heads = 3, coarse_layers = 2;  // coarse stage, one tree level up
  int diffusion_width = 256, diffusion_steps = 1000, diffusion_draws = 2;
  bool paper_snr_weight = false;  // SNR / (1 + SNR) instead of min(1 / alpha_bar, 20)
  bool rotary_positions = true;   // 3-D RoPE in self-attention
  bool position_code = true;      // sinusoidal code on every token
  // What the fine stage sees around a chunk of targets, nearest first.
  int context_tokens = 384, empty_tokens = 64, chunk_tokens = 160;
  int coarse_empty_tokens = 256, coarse_chunk_tokens = 1024;
  // Loss.
  float focal_gamma = 0, focal_alpha = .5f;
  float unobserved_weight = .25f;  // of U, labelled empty; 0 masks U from the loss as in the paper

  static CompleterConfig small() { return {}; }
  static CompleterConfig paper();
  std::string toJson() const;
  static CompleterConfig fromJson(const std::string& text, const std::string& where);
};

struct CompleteSettings {
  float tau = .15f;           // a token is kept if its occupancy probability exceeds this
  float coarse_tau = .05f;   // the coarse stage's gate: high recall
  Neighbours neighbours = Neighbours::kCorners26;
  int sampling_steps = 0;    // DDIM steps of the diffusion head; 0: its linear mean
  double temperature = 1;
  bool refine_observed = false;  // rewrite condition latents with the refinement head (A8)
  uint64_t seed = 1;
};

/// Trained networks, loaded once.
class Completer {
 public:
  /// Throws Error if the file is missing, corrupt or of another kind.
  explicit Completer(const std::string& weights_path);
  ~Completer();
  Completer(Completer&&) noexcept;

  const CompleterConfig& config() const;
  std::string hash() const;
  /// The scenes it was trained on, as the file says (`rooms:SEED-SEED`).
  std::string trainedOn() const;

  /// `seen` plus generated tokens: coarse gate, then growth level by level (A10-A13). Rows of `seen`
  /// come first, bit-identical unless refine_observed. `space` says what was seen empty; tokens that
  /// are F or E in it are never visited. Same seed and threads, same grid.
  LatentGrid complete(const LatentGrid& seen, const ObservedSpace& space,
                      const CompleteSettings& settings, Progress& progress) const;

  /// The same with given occupancy: latents for `occupied` tokens (spec: oracle).
  LatentGrid completeAt(const LatentGrid& seen, const ObservedSpace& space,
                        const std::vector<Coord>& occupied, const CompleteSettings& settings,
                        Progress& progress) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vdbc
