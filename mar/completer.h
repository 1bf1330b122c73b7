#pragma once
// The masked auto-regressive completer: which unseen tokens are occupied, and with which latents
// (paper sec. 4, spec A1-A14).
#include <functional>
#include <memory>
#include <string>

#include "vdb/frontier.h"
#include "vdb/place.h"

namespace vdbc {

/// Every size of the completer; saved inside the weights file.
struct CompleterConfig {
  std::string preset = "small";
  int latent_dim = 64, latent_groups = 1;  // as the encoder's (spec E10)
  int width = 128, heads = 4, layers = 3;  // fine stage; layers each in H1 and H2
  int coarse_width = 96, coarse_heads = 3, coarse_layers = 2;  // coarse stage, one tree level up
  int diffusion_width = 256, diffusion_steps = 1000, diffusion_draws = 2;
  bool paper_snr_weight = false;  // SNR / (1 + SNR) instead of min(1 / alpha_bar, 20)
  bool rotary_positions = true;   // 3-D RoPE in self-attention
  bool position_code = true;      // sinusoidal code on every token
  bool coarse_stage = true;       // false: one dense stage, every unobserved token is a candidate
  // What the fine stage sees around a chunk of targets, nearest first.
  int context_tokens = 384, empty_tokens = 64, chunk_tokens = 160;
  int coarse_empty_tokens = 256, coarse_chunk_tokens = 1024;
  // Loss.
  float focal_gamma = 0, focal_alpha = .5f;
  float unobserved_weight = .25f;  // of U, labelled empty; 0 masks U from the loss as in the paper
  // Generated tokens in training's context, up to: deviation of noise on their latents, share of
  // wrong ones.
  float context_noise = .2f, context_false_positives = .06f;

  static CompleterConfig small() { return {}; }
  static CompleterConfig paper();
  std::string toJson() const;
  static CompleterConfig fromJson(const std::string& text, const std::string& where);
};

struct CompleteSettings {
  float tau = .2f;         // a token is kept if its occupancy probability exceeds this
  float coarse_tau = .1f;  // the coarse stage's gate: high recall
  /// Dropped tokens above this probability are taken back where they close a hole (a minimum cut
  /// between what was seen empty and the border of the volume); 1: none.
  float hole_tau = .1f;
  Neighbours neighbours = Neighbours::kCorners26;
  int sampling_steps = 0;  // DDIM steps of the diffusion head; 0: its linear mean
  double temperature = 1;
  /// Generated tokens are context of the levels after them (A11), not only the observed ones.
  bool generated_context = false;
  int context_tokens = 0,
      chunk_tokens = 0;  // of the fine stage instead of the weights' own; 0: those
  bool random_order =
      false;  // growth levels in which tokens come at random, as large as the breadth-first ones
  bool refine_observed = false;  // rewrite condition latents with the refinement head (A8)
  uint64_t seed = 1;
  /// Tokens (coordinates of the latents' level) that may be generated; all where null.
  std::shared_ptr<const TokenMask> region;
  /// Growth levels below it are taken as done.
  int32_t first_level = 1;
  /// `start` is a LevelListener's: generated tokens that do not exceed tau were dropped.
  bool resumed = false;
};

/// Called after each growth level with all tokens so far (dropped ones too, if holes are to be
/// closed) and the level that comes next. Completing those tokens from that level on, `resumed`,
/// gives, bit by bit, what the uninterrupted run gives.
using LevelListener = std::function<void(const Place& so_far, int32_t next_level)>;

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

  /// `start` plus generated tokens: coarse gate, then growth level by level. `start` has observed
  /// tokens first; generated ones after them stay as they are and are not visited again. Its rows
  /// come first, bit-identical unless refine_observed; generated latents are rounded to half
  /// precision, so that files hold them exactly. Tokens that are F or E in `start.seen` are never
  /// visited. Places beyond 12.8 m are looked at in overlapping windows, by the coarse stage and by
  /// the position code; windows without anything filled stay as they are. Same seed, same place.
  Place complete(const Place& start, const CompleteSettings& settings, Progress& progress,
                 const LevelListener& listener = nullptr) const;

  /// The same with given occupancy: latents for `occupied` tokens (an oracle).
  Place completeAt(const Place& start, const std::vector<Coord>& occupied,
                   const CompleteSettings& settings, Progress& progress) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vdbc
