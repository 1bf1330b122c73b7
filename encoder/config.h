#pragma once
// What the encoder-decoder's weights were made for.
#include <string>

#include "encoder/positions.h"

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
  int latent_groups = 1;    // of the GroupNorm after sampling, per token; 0: none
  float kl_weight = 1e-4f;  // beta; image error and KL are both means (docs/method.md, section 3.7)
  float occupancy_weight = 0.02f;  // of BCE-up
  int gaussians_per_voxel = 8;     // M
  float guide_alpha = -1;          // fixed share of learned attention, or -1: learned, starts at .5
  bool guide_log_counts = false;   // softmax(log(1 + count)) instead of softmax(count)
  float false_positives = 0.25f;   // injected when splitting, as a share of the truth
  PositionConfig positions;

  static EncoderConfig small() { return {}; }
  /// The paper's sizes: M = 216, width 512, 12 heads-worth of attention; for GPUs.
  static EncoderConfig paper();
  std::string toJson() const;
  /// Fields that the text lacks have their defaults. Throws Error on unknown fields and sizes that
  /// cannot work; `where` names the file.
  static EncoderConfig fromJson(const std::string& text, const std::string& where);

  template <typename Config, typename Visit>
  static void fields(Config& c, Visit&& visit) {
    visit("preset", c.preset), visit("voxel_m", c.voxel_m), visit("levels", c.levels);
    visit("patches_across", c.patches_across), visit("patch_px", c.patch_px);
    visit("voxel_width", c.voxel_width), visit("width", c.width), visit("heads", c.heads);
    visit("blocks", c.blocks), visit("decoder_blocks", c.decoder_blocks), visit("window", c.window);
    visit("latent_dim", c.latent_dim), visit("latent_groups", c.latent_groups);
    visit("kl_weight", c.kl_weight), visit("occupancy_weight", c.occupancy_weight);
    visit("gaussians_per_voxel", c.gaussians_per_voxel), visit("guide_alpha", c.guide_alpha);
    visit("guide_log_counts", c.guide_log_counts), visit("false_positives", c.false_positives);
    PositionConfig::fields(c.positions, visit);
  }
};

}  // namespace vdbc
