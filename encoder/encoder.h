#pragma once
// The encoder-decoder: views -> sparse latent grid -> Gaussians (paper sec. 3; docs/method.md,
// sections 2 and 3).
#include <memory>
#include <string>

#include "encoder/config.h"
#include "encoder/observation.h"
#include "splat/gaussians.h"
#include "vdb/place.h"

namespace vdbc {

/// Decoded content, voxel by voxel: Gaussians of voxel i are rows [i * M, (i + 1) * M).
struct DecodedGrid {
  std::vector<Coord> voxels;             // [V]
  std::vector<int32_t> node;             // [V] row of the latent it came from
  std::vector<float> child_probability;  // [V] of BCE-up; 1 where the voxel was observed
  Gaussians gaussians;                   // [V * M] from the grid's origin, SH degree 0
};

/// Trained networks, loaded once. Const functions may be called from several threads at once. They
/// run in parallel in the caller's task arena (vdb/threads.h); the same bytes for any number of
/// threads.
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
