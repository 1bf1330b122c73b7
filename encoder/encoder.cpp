#include "encoder/encoder.h"

#include <atomic>
#include <cmath>

#include "encoder/network.h"
#include "encoder/weights.h"

namespace vdbc {

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

ObserveSettings Encoder::observing(ObserveSettings s) const {
  s.volume.voxel_m = config().voxel_m;
  s.patches_across = config().patches_across;
  s.level = config().levels;
  return s;
}

std::vector<float> Encoder::colourWay() const {
  const Tensor w = impl_->net->colour_shortcut->weight.detach().contiguous();
  return {w.data_ptr<float>(), w.data_ptr<float>() + w.numel()};
}

Place Encoder::encode(const std::vector<View>& views, const Observation& o,
                      Progress& progress) const {
  const Inference inference;
  report(progress, -1);
  const EncoderConfig& c = config();
  // Rounded as files hold them: what is decoded or completed now is what a file would give.
  const Tensor z = impl_->net->normalise(impl_->net->encode(encoderInput(views, o, c)).mean)
                       .to(torch::kHalf)
                       .to(torch::kFloat32)
                       .contiguous();
  Place place;
  place.frame = o.frame, place.seen = o.seen, place.encoder_hash = hash();
  place.level = c.levels, place.dim = c.latent_dim;
  place.ijk = o.tokens.coords(c.levels);
  place.z.assign(z.data_ptr<float>(), z.data_ptr<float>() + z.numel());
  place.probability.assign(place.ijk.size(), 1.f);
  place.bfs_level.assign(place.ijk.size(), 0);
  place.generated.assign(place.ijk.size(), 0);
  return place;
}

namespace {

// The children that survive one split, and how sure that is.
struct Children {
  std::vector<int64_t> parent, slot;
  std::vector<Coord> coords;
  std::vector<float> probability;
  std::vector<int32_t> node;  // row of the latent
};

// Writes Gaussians of the grid frame over those of `g` from `first` on, turned to the world's axes.
void copyTurned(const GaussianTensors& t, const VoxelFrame& frame, size_t first, Gaussians* g) {
  auto copy = [](const Tensor& from, void* to) {
    const Tensor c = from.contiguous();
    std::memcpy(to, c.data_ptr(), c.nbytes());
  };
  copy(t.mean, &g->mean[first]), copy(t.log_scale, &g->log_scale[first]);
  copy(t.rotation, &g->rotation[first]), copy(t.opacity_logit, &g->opacity_logit[first]);
  copy(t.sh, &g->sh[3 * first]);
  const Eigen::Matrix3f rotation = frame.world_from_grid.linear().cast<float>();
  const Eigen::Quaternionf turn(rotation);
  for (size_t i = first; i < first + size_t(t.mean.size(0)); ++i) {
    g->mean[i] = rotation * g->mean[i];
    const Eigen::Vector4f q = g->rotation[i];
    const Eigen::Quaternionf r = (turn * Eigen::Quaternionf(q[0], q[1], q[2], q[3])).normalized();
    g->rotation[i] = {r.w(), r.x(), r.y(), r.z()};
  }
}

}  // namespace

DecodedGrid Encoder::decode(const Place& place, float child_threshold, Progress& progress) const {
  const Inference inference;
  const EncoderConfig& c = config();
  require(place.dim == c.latent_dim && place.level == c.levels,
          "Encoder::decode: the place: expected ", c.latent_dim, " channels at level ", c.levels,
          ", found ", place.dim, " at level ", place.level);
  DecodedGrid out;
  if (place.size() == 0) {
    out.gaussians.resize(0, 0);
    return out;
  }
  std::vector<Coord> coords = place.ijk;
  DecoderTokens tokens = impl_->net->decodeTokens(
      torch::tensor(place.z).view({place.size(), place.dim}), coordTensor(coords), zOrder(coords));
  report(progress, -1);

  std::vector<int32_t> node(coords.size());
  for (size_t i = 0; i < node.size(); ++i) node[i] = int32_t(i);
  std::vector<float> probability(coords.size(), 1.f);
  for (int split = 0; split < c.levels; ++split) {
    const Tensor p = impl_->net->childLogits(tokens, split).sigmoid().contiguous();
    const auto chance = p.accessor<float, 2>();
    openvdb::tree::ValueAccessor<const TokenMask> filled(place.seen->filled),
        empty(place.seen->empty);
    const int child_level = c.levels - 1 - split;
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
        if (anyVoxelOn(filled, child, child_level)) {
          keep(slot, 1.f);
          continue;
        }
        if (allVoxelsOn(empty, child, child_level)) continue;  // seen empty: stays empty
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
  constexpr int64_t kPiece = 4096;
  const int64_t voxels = int64_t(coords.size()), m = c.gaussians_per_voxel;
  const Tensor all_coords = coordTensor(coords);
  out.gaussians.resize(voxels * m, 0);
  out.gaussians.origin = place.frame.world_from_grid.translation();
  std::atomic<int64_t> done{0};
  inTasks((voxels + kPiece - 1) / kPiece, [&](int64_t piece) {
    const int64_t begin = piece * kPiece, end = std::min(voxels, begin + kPiece);
    copyTurned(impl_->net->gaussians(tokens.rows(begin, end), all_coords.slice(0, begin, end),
                                     place.frame.voxel_m),
               place.frame, size_t(begin * m), &out.gaussians);
    report(progress, int(100 * (done += end - begin) / voxels));
  });
  out.voxels = std::move(coords), out.node = std::move(node);
  out.child_probability = std::move(probability);
  return out;
}

}  // namespace vdbc
