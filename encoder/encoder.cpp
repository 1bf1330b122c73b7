#include "encoder/encoder.h"

#include <cmath>
#include <nlohmann/json.hpp>

#include "encoder/network.h"
#include "encoder/weights.h"

namespace vdbc {

using nlohmann::json;

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

namespace {
// One list of the fields serves writing and reading.
template <typename Config, typename Visit>
void visitFields(Config& c, Visit&& visit) {
  visit("preset", c.preset), visit("voxel_m", c.voxel_m), visit("levels", c.levels);
  visit("patches_across", c.patches_across), visit("patch_px", c.patch_px);
  visit("voxel_width", c.voxel_width), visit("width", c.width), visit("heads", c.heads);
  visit("blocks", c.blocks), visit("decoder_blocks", c.decoder_blocks), visit("window", c.window);
  visit("latent_dim", c.latent_dim), visit("latent_groups", c.latent_groups);
  visit("kl_weight", c.kl_weight), visit("occupancy_weight", c.occupancy_weight);
  visit("gaussians_per_voxel", c.gaussians_per_voxel), visit("guide_alpha", c.guide_alpha);
  visit("guide_log_counts", c.guide_log_counts), visit("false_positives", c.false_positives);
}
}  // namespace

std::string EncoderConfig::toJson() const {
  json j;
  visitFields(*this, [&](const char* name, const auto& value) { j[name] = value; });
  return j.dump();
}

EncoderConfig EncoderConfig::fromJson(const std::string& text, const std::string& where) {
  EncoderConfig c;
  try {
    const json j = json::parse(text);
    visitFields(c, [&](const char* name, auto& value) { j.at(name).get_to(value); });
  } catch (const json::exception& e) {
    throw Error(joinText("EncoderConfig: ", where, ": bad configuration: ", e.what()));
  }
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

struct Encoder::Impl {
  std::shared_ptr<EncoderNet> net;
  std::string hash, trained_on;
};

Encoder::Encoder(const std::string& path) : impl_(std::make_unique<Impl>()) {
  const TensorFile file = readTensors(path);
  const auto config = file.metadata.find("encoder");
  require(config != file.metadata.end(), "Encoder: ", path,
          ": expected encoder weights, found a file of another kind");
  impl_->net = std::make_shared<EncoderNet>(EncoderConfig::fromJson(config->second, path));
  loadModule(*impl_->net, "", file, path);
  impl_->net->eval();
  impl_->hash = weightsHash(*impl_->net);
  const auto scenes = file.metadata.find("trained_on");
  if (scenes != file.metadata.end()) impl_->trained_on = scenes->second;
}
Encoder::~Encoder() = default;
Encoder::Encoder(Encoder&&) noexcept = default;

const EncoderConfig& Encoder::config() const { return impl_->net->config; }
std::string Encoder::hash() const { return impl_->hash; }
std::string Encoder::trainedOn() const { return impl_->trained_on; }

ObservationSettings Encoder::observationSettings() const {
  ObservationSettings s;
  s.patches_across = config().patches_across;
  s.level = config().levels;
  return s;
}

std::vector<float> Encoder::colourWay() const {
  const Tensor w = impl_->net->colour_shortcut->weight.detach().contiguous();
  return {w.data_ptr<float>(), w.data_ptr<float>() + w.numel()};
}

LatentGrid Encoder::encode(const std::vector<View>& views, const Observation& o,
                           Progress& progress) const {
  const Inference inference;
  report(progress, -1);
  const EncoderConfig& c = config();
  // Rounded as files hold them: what is decoded or completed now is what a file would give.
  const Tensor z = impl_->net->normalise(impl_->net->encode(encoderInput(views, o, c)).mean)
                       .to(torch::kHalf)
                       .to(torch::kFloat32)
                       .contiguous();
  LatentGrid grid;
  grid.frame = o.frame, grid.level = c.levels, grid.dim = c.latent_dim;
  grid.ijk = o.tokens.coords(c.levels);
  grid.z.assign(z.data_ptr<float>(), z.data_ptr<float>() + z.numel());
  grid.observed.assign(grid.ijk.size(), 1);
  grid.probability.assign(grid.ijk.size(), 1.f);
  grid.bfs_level.assign(grid.ijk.size(), 0);
  return grid;
}

namespace {

// The children that survive one split, and how sure that is.
struct Children {
  std::vector<int64_t> parent, slot;
  std::vector<Coord> coords;
  std::vector<float> probability;
  std::vector<int32_t> node;  // row of the latent
};

// Writes Gaussians of the grid frame over those of `g` from `first` on, in the world's.
void copyToWorld(const GaussianTensors& t, const VoxelFrame& frame, size_t first, Gaussians* g) {
  auto copy = [](const Tensor& from, void* to) {
    const Tensor c = from.contiguous();
    std::memcpy(to, c.data_ptr(), c.nbytes());
  };
  copy(t.mean, &g->mean[first]), copy(t.log_scale, &g->log_scale[first]);
  copy(t.rotation, &g->rotation[first]), copy(t.opacity_logit, &g->opacity_logit[first]);
  copy(t.sh, &g->sh[3 * first]);
  const Eigen::Isometry3f world_from_grid = frame.world_from_grid.cast<float>();
  const Eigen::Quaternionf turn(world_from_grid.linear());
  for (size_t i = first; i < first + size_t(t.mean.size(0)); ++i) {
    g->mean[i] = world_from_grid * g->mean[i];
    const Eigen::Vector4f q = g->rotation[i];
    const Eigen::Quaternionf r = (turn * Eigen::Quaternionf(q[0], q[1], q[2], q[3])).normalized();
    g->rotation[i] = {r.w(), r.x(), r.y(), r.z()};
  }
}

}  // namespace

DecodedGrid Encoder::decode(const LatentGrid& latents, const ObservedSpace& seen,
                            float child_threshold, Progress& progress) const {
  const Inference inference;
  const EncoderConfig& c = config();
  require(latents.dim == c.latent_dim && latents.level == c.levels,
          "Encoder::decode: the latent grid: expected ", c.latent_dim, " channels at level ",
          c.levels, ", found ", latents.dim, " at level ", latents.level);
  DecodedGrid out;
  if (latents.size() == 0) {
    out.gaussians.resize(0, 0);
    return out;
  }
  std::vector<Coord> coords = latents.ijk;
  DecoderTokens tokens =
      impl_->net->decodeTokens(torch::tensor(latents.z).view({latents.size(), latents.dim}),
                               coordTensor(coords), zOrder(coords));
  report(progress, -1);

  std::vector<int32_t> node(coords.size());
  for (size_t i = 0; i < node.size(); ++i) node[i] = int32_t(i);
  std::vector<float> probability(coords.size(), 1.f);
  for (int split = 0; split < c.levels; ++split) {
    const Tensor p = impl_->net->childLogits(tokens, split).sigmoid().contiguous();
    const auto chance = p.accessor<float, 2>();
    openvdb::tree::ValueAccessor<const TokenMask> filled(seen.filled), empty(seen.empty);
    const int side = 1 << (c.levels - 1 - split);  // of a child, in voxels
    auto activeBelow = [&](const auto& mask, const Coord& child) {
      int active = 0;
      for (int v = 0; v < side * side * side; ++v)
        active += mask.isValueOn(voxelOf(child, side, v));
      return active;
    };
    Children kept;
    for (size_t i = 0; i < coords.size(); ++i) {
      int likeliest = -1;
      bool any = false;
      auto keep = [&](int slot, float prob) {
        kept.parent.push_back(int64_t(i)), kept.slot.push_back(slot);
        kept.coords.push_back(childCoord(coords[i], slot));
        kept.probability.push_back(prob), kept.node.push_back(node[i]);
        any = true;
      };
      for (int slot = 0; slot < 8; ++slot) {
        const Coord child = childCoord(coords[i], slot);
        if (activeBelow(filled, child) > 0) {
          keep(slot, 1.f);
          continue;
        }
        if (activeBelow(empty, child) == side * side * side) continue;  // seen empty: stays empty
        const float q = chance[int64_t(i)][slot];
        if (q > child_threshold) keep(slot, q);
        if (likeliest < 0 || q > chance[int64_t(i)][likeliest]) likeliest = slot;
      }
      if (!any && likeliest >= 0) keep(likeliest, chance[int64_t(i)][likeliest]);
    }
    tokens = impl_->net->splitTokens(tokens, {torch::tensor(kept.parent), torch::tensor(kept.slot)},
                                     split);
    coords = std::move(kept.coords), node = std::move(kept.node);
    probability = std::move(kept.probability);
    report(progress, -1);
  }
  // Some voxels at a time: with hundreds of Gaussians a voxel the last layer's output is many times
  // the result.
  constexpr int64_t kChunk = 4096;
  const int64_t voxels = int64_t(coords.size()), m = c.gaussians_per_voxel;
  const Tensor all_coords = coordTensor(coords);
  out.gaussians.resize(voxels * m, 0);
  for (int64_t begin = 0; begin < voxels; begin += kChunk) {
    const int64_t end = std::min(voxels, begin + kChunk);
    copyToWorld(impl_->net->gaussians(tokens.rows(begin, end), all_coords.slice(0, begin, end),
                                      latents.frame.voxel_m),
                latents.frame, size_t(begin * m), &out.gaussians);
    report(progress, int(100 * end / voxels));
  }
  out.voxels = std::move(coords), out.node = std::move(node);
  out.child_probability = std::move(probability);
  return out;
}

}  // namespace vdbc
