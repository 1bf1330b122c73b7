#include "mar/config.h"

#include "encoder/config_fields.h"

namespace vdbc {

CompleterConfig CompleterConfig::paper() {
  CompleterConfig c;
  c.preset = "paper";
  c.latent_dim = 32, c.latent_groups = 8;
  c.width = 512, c.heads = 16, c.layers = 5;
  c.coarse_width = 512, c.coarse_heads = 16, c.coarse_layers = 2;
  c.diffusion_width = 512, c.paper_snr_weight = true;
  c.context_tokens = 4096, c.empty_tokens = 512, c.chunk_tokens = 2048;
  c.coarse_chunk_tokens = 8192, c.diffusion_draws = 4;
  c.focal_gamma = 2, c.unobserved_weight = 0;
  return c;
}

std::string CompleterConfig::toJson() const { return configJson(*this); }

CompleterConfig CompleterConfig::fromJson(const std::string& text, const std::string& where) {
  const auto c = configFromJson<CompleterConfig>("CompleterConfig", text, where);
  auto within = [&](const char* name, auto value, auto low, auto high) {
    require(value >= low && value <= high, "CompleterConfig: ", where, ": expected ", name, " in [",
            low, ", ", high, "], found ", value);
  };
  within("latent_dim", c.latent_dim, 1, 1024),
      within("latent_groups", c.latent_groups, 0, c.latent_dim), within("width", c.width, 1, 4096);
  within("heads", c.heads, 1, 64), within("layers", c.layers, 1, 64);
  within("coarse_width", c.coarse_width, 1, 4096), within("coarse_heads", c.coarse_heads, 1, 64);
  within("coarse_layers", c.coarse_layers, 1, 64);
  within("diffusion_width", c.diffusion_width, 1, 4096);
  within("diffusion_steps", c.diffusion_steps, 2, 100000),
      within("diffusion_draws", c.diffusion_draws, 0, 1024);
  within("context_tokens", c.context_tokens, 1, 1 << 20);
  within("empty_tokens", c.empty_tokens, 0, 1 << 20),
      within("chunk_tokens", c.chunk_tokens, 1, 1 << 20);
  within("coarse_empty_tokens", c.coarse_empty_tokens, 0, 1 << 20);
  within("coarse_chunk_tokens", c.coarse_chunk_tokens, 1, 1 << 20);
  within("extent_m", c.positions.extent_m, 1.f, 1000.f);
  within("window_overlap_m", c.window_overlap_m, 0.f, c.positions.extent_m / 4);
  require((c.latent_groups == 0 || c.latent_dim % c.latent_groups == 0) &&
              c.width % (2 * c.heads) == 0 && c.coarse_width % (2 * c.coarse_heads) == 0,
          "CompleterConfig: ", where,
          ": widths are not multiples of twice their heads, or the latents of their groups");
  return c;
}

}  // namespace vdbc
