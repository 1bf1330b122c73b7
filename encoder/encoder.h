#pragma once
// The encoder-decoder: views -> sparse latent grid -> Gaussians (paper sec. 3, spec E1-E14).
#include <memory>
#include <string>

#include "encoder/observation.h"
#include "splat/gaussians.h"
#include "vdb/place.h"

namespace vdbc {

/// Every size of the encoder-decoder; saved inside the weights file.
struct EncoderConfig {
  std::string preset = "small";
  float voxel_m = 0.1f;     // voxel edge it was trained at, metres
  int levels = 1;           // tree levels between voxels and latents: 0, 1, 2 = 1x, 8x, 64x
  int patches_across = 14;  // patches along the image's width
  int patch_px = 16;        // pixels a patch is resized to
  int voxel_width = 48;     // channels of voxel tokens
  int width = 96;           // channels of latent-level tokens
  int heads = 3;
  int blocks = 2;  // bidirectional blocks, L
  int decoder_blocks = 2;
  int window = 256;  // tokens per self-attention window
  int latent_dim = 64;
  int latent_groups = 1;           // of the GroupNorm after sampling, per token; 0: none
  float kl_weight = 1e-4f;         // beta; image error and KL are both means (spec E12)
  float occupancy_weight = 0.02f;  // of BCE-up
  int gaussians_per_voxel = 8;     // M
  float guide_alpha = -1;          // fixed share of learned attention, or -1: learned, starts at .5
  bool guide_log_counts = false;   // softmax(log(1 + count)) instead of softmax(count)
  float false_positives = 0.25f;   // injected when splitting, as a share of the truth

  static EncoderConfig small() { return {}; }
  /// The paper's sizes: M = 216, width 512, 12 heads-worth of attention; for GPUs.
  static EncoderConfig paper();
  std::string toJson() const;
  /// Throws Error on missing fields or sizes that cannot work; `where` names the file.
  static EncoderConfig fromJson(const std::string& text, const std::string& where);
};

/// Decoded content, voxel by voxel: Gaussians of voxel i are rows [i * M, (i + 1) * M).
struct DecodedGrid {
  std::vector<Coord> voxels;             // [V]
  std::vector<int32_t> node;             // [V] row of the latent it came from
  std::vector<float> child_probability;  // [V] of BCE-up; 1 where the voxel was observed
  Gaussians gaussians;                   // [V * M] world frame, SH degree 0
};

/// Trained networks, loaded once. Thread-safe for concurrent const calls is not promised.
class Encoder {
 public:
  /// Throws Error if the file is missing, corrupt or of another kind.
  explicit Encoder(const std::string& weights_path);
  ~Encoder();
  Encoder(Encoder&&) noexcept;

  const EncoderConfig& config() const;
  /// Names the weights' values, 16 hex digits.
  std::string hash() const;
  /// The scenes it was trained on, as the file says (`rooms:SEED-SEED`).
  std::string trainedOn() const;
  /// What observe() needs for encode(): `settings` with the grid, patches and level of the weights.
  ObserveSettings observing(ObserveSettings settings = {}) const;

  /// The place as observed: latents (posterior means, normalised, rounded to half precision) of the
  /// observed tokens. The same for condition and target views.
  Place encode(const std::vector<View>& views, const Observation& observation,
               Progress& progress) const;

  /// What the decoder's linear way makes of a latent, the mean colours of its octants: [24 *
  /// latent_dim], a row a channel (opponent colours).
  std::vector<float> colourWay() const;

  /// Splits every token and makes M Gaussians a voxel. Voxels in `seen->filled` are kept exactly,
  /// in observed nodes nothing that `seen->empty` holds is filled, other children where BCE-up
  /// exceeds `child_threshold`; a generated token keeps at least its likeliest child.
  DecodedGrid decode(const Place& place, float child_threshold, Progress& progress) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vdbc
