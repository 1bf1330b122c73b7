#include "encoder/config.h"

#include "encoder/config_fields.h"

namespace vdbc {

EncoderConfig EncoderConfig::paper() {
  EncoderConfig c;
  c.preset = "paper";
  c.voxel_width = 256, c.width = 512, c.heads = 16;
  c.blocks = 6, c.decoder_blocks = 6, c.window = 1024;
  c.latent_dim = 32, c.latent_groups = 8;
  c.kl_weight = .1f;
  c.gaussians_per_voxel = 216;
  return c;
}

std::string EncoderConfig::toJson() const { return configJson(*this); }

EncoderConfig EncoderConfig::fromJson(const std::string& text, const std::string& where) {
  const auto c = configFromJson<EncoderConfig>("EncoderConfig", text, where);
  auto within = [&](const char* name, int value, int low, int high) {
    require(value >= low && value <= high, "EncoderConfig: ", where, ": expected ", name, " in [",
            low, ", ", high, "], found ", value);
  };
  within("levels", c.levels, 0, 2), within("patches_across", c.patches_across, 1, 256);
  within("patch_px", c.patch_px, 1, 64), within("voxel_width", c.voxel_width, 1, 4096);
  within("width", c.width, 1, 4096), within("heads", c.heads, 1, 64);
  within("blocks", c.blocks, 1, 64), within("decoder_blocks", c.decoder_blocks, 0, 64);
  within("window", c.window, 2, 1 << 16), within("latent_dim", c.latent_dim, 1, 1024);
  within("latent_groups", c.latent_groups, 0, c.latent_dim);
  within("gaussians_per_voxel", c.gaussians_per_voxel, 1, 512);
  require(c.width % (2 * c.heads) == 0 &&
              (c.latent_groups == 0 || c.latent_dim % c.latent_groups == 0) && c.voxel_m > 0,
          "EncoderConfig: ", where, ": width, heads, groups or voxel size do not fit each other");
  return c;
}

}  // namespace vdbc
