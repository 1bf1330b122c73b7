#pragma once
// The masked auto-regressive completer: which unseen tokens are occupied, and with which latents
// (paper sec. 4; docs/method.md, section 4).
#include <functional>
#include <memory>
#include <string>

#include "mar/config.h"
#include "vdb/frontier.h"
#include "vdb/place.h"

namespace vdbc {

struct CompleteSettings {
  /// A token is kept if its occupancy probability exceeds this, unless it only thickens a surface
  /// (docs/method.md, section 4.10).
  float tau = .45f;
  float coarse_tau = .1f;  // the coarse stage's gate: high recall
  /// Dropped tokens, thinned ones too, above this probability are taken back where they close a
  /// small hole (a minimum cut between what was seen empty and the border of the volume); 1: none.
  float hole_tau = .1f;
  Neighbours neighbours = Neighbours::kCorners26;
  int sampling_steps = 0;  // DDIM steps of the diffusion head; 0: its linear mean
  double temperature = 1;
  /// Generated tokens are context of the levels after them (docs/method.md, section 4.8), not only
  /// the observed ones.
  bool generated_context = false;
  int context_tokens = 0,
      chunk_tokens = 0;  // of the fine stage instead of the weights' own; 0: those
  bool random_order =
      false;  // growth levels in which tokens come at random, as large as the breadth-first ones
  bool refine_observed = false;  // rewrite condition latents with the refinement head (section 4.6)
  uint64_t seed = 1;
  /// Tokens (coordinates of the latents' level) that may be generated; all where null.
  std::shared_ptr<const TokenMask> region;
  /// Growth levels below it are taken as done.
  int32_t first_level = 1;
  /// Of a `start` that is a LevelListener's: how many rows that completion began with; what comes
  /// after them and does not exceed tau was dropped. -1: it is none.
  int64_t begun_with = -1;
};

/// Called after each growth level with all tokens so far, dropped ones too, and the level that
/// comes next. Completing those tokens from that level on, with `begun_with`, gives, bit by bit,
/// what the uninterrupted run gives.
using LevelListener = std::function<void(const Place& so_far, int32_t next_level)>;

/// Trained networks, loaded once. Const calls may run at the same time from several threads.
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

  /// `start` plus generated tokens: coarse gate, then growth level by level, then surfaces are
  /// thinned to one token and small holes closed. `start` has observed tokens first; generated ones
  /// after them stay as they are and are not visited again. Its rows come first, bit-identical
  /// unless refine_observed; generated latents are rounded to half precision, so that files hold
  /// them exactly. Tokens that are F or E in `start.seen` are never visited. Places larger than the
  /// configuration's `extent_m` are looked at in overlapping windows, by the coarse stage and by
  /// the position code; windows without anything filled stay as they are. Time and memory follow
  /// what was seen and what is generated, not the volume. Same seed, same place, whatever the
  /// number of threads.
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
