#include "encoder/network.h"

#include <cmath>
#include <random>

#include "vdb/frontier.h"

namespace vdbc {

namespace nn = torch::nn;

Tensor CountAttention::apply(const Tensor& values) const {
  const Tensor uniform = floor * values.sum(0, true);
  return uniform.index_add(0, rows, values.index_select(0, columns) * weight.unsqueeze(1));
}

CountAttention countAttention(const std::vector<int32_t>& rows, const std::vector<int32_t>& columns,
                              const std::vector<float>& counts, int64_t n, int64_t m,
                              bool log_counts) {
  std::vector<double> top(size_t(n), 0.0), sum(size_t(n), 0.0);
  std::vector<int64_t> entries(size_t(n), 0);
  auto logit = [&](size_t k) {
    return log_counts ? std::log1p(double(counts[k])) : double(counts[k]);
  };
  for (size_t k = 0; k < rows.size(); ++k)
    top[size_t(rows[k])] = std::max(top[size_t(rows[k])], logit(k));
  for (size_t k = 0; k < rows.size(); ++k) {
    sum[size_t(rows[k])] += std::exp(logit(k) - top[size_t(rows[k])]);
    ++entries[size_t(rows[k])];
  }
  CountAttention a;
  a.rows = torch::empty({int64_t(rows.size())}, torch::kInt64);
  a.columns = torch::empty_like(a.rows);
  a.weight = torch::empty({int64_t(rows.size())});
  a.floor = torch::empty({n, 1});
  for (int64_t i = 0; i < n; ++i) {
    const double zero = std::exp(-top[size_t(i)]);
    sum[size_t(i)] += double(m - entries[size_t(i)]) * zero;
    a.floor.data_ptr<float>()[i] = float(zero / sum[size_t(i)]);
  }
  for (size_t k = 0; k < rows.size(); ++k) {
    const size_t i = size_t(rows[k]);
    a.rows.data_ptr<int64_t>()[k] = rows[k];
    a.columns.data_ptr<int64_t>()[k] = columns[k];
    a.weight.data_ptr<float>()[k] =
        float((std::exp(logit(k) - top[i]) - std::exp(-top[i])) / sum[i]);
  }
  return a;
}

namespace {

// Patches of all views, [P, 3 * px * px], about unit deviation.
Tensor patchPixels(const std::vector<View>& views, const Observation& o, int px) {
  std::vector<Tensor> all(views.size());
  inTasks(int64_t(views.size()), [&](int64_t i) {
    const PatchLattice& l = o.lattices[size_t(i)];
    const Image image = resizeImage(views[size_t(i)].colour, l.columns * px, l.rows * px);
    const Tensor t =
        torch::from_blob(const_cast<float*>(image.data.data()), {l.rows, px, l.columns, px, 3});
    all[size_t(i)] =
        (t.permute({0, 2, 1, 3, 4}).reshape({l.rows * l.columns, px * px * 3}) - .5f) * 4;
  });
  return torch::cat(all);
}

// Where each patch looks from and to: centre ray 3, camera place 3 and mean point 3 (normalised),
// share 1.
Tensor patchGeometry(const std::vector<View>& views, const Observation& o,
                     const PositionConfig& positions) {
  std::vector<float> rays;
  for (size_t i = 0; i < views.size(); ++i) {
    const PatchLattice& l = o.lattices[i];
    const Camera& c = views[i].camera;
    const Eigen::Isometry3d grid_from_camera =
        o.frame.world_from_grid.inverse() * c.world_from_camera;
    for (int y = 0; y < l.rows; ++y)
      for (int x = 0; x < l.columns; ++x) {
        const double u = (x + .5) * c.width / l.columns, v = (y + .5) * c.height / l.rows;
        const Eigen::Vector3d d =
            (grid_from_camera.linear() * Eigen::Vector3d((u - c.cx) / c.fx, (v - c.cy) / c.fy, 1))
                .normalized();
        for (int k = 0; k < 3; ++k) rays.push_back(float(d[k]));
        for (int k = 0; k < 3; ++k) rays.push_back(float(grid_from_camera.translation()[k]));
      }
  }
  const Tensor r = torch::tensor(rays).view({o.patches, 6});
  const Tensor points = torch::tensor(o.patch_points).view({o.patches, 4});
  const Tensor share = points.slice(1, 3, 4);
  const Tensor seen = (share > 0).to(torch::kFloat32);
  return torch::cat({r.slice(1, 0, 3), normalisedPositions(r.slice(1, 3, 6), o.frame, positions),
                     normalisedPositions(points.slice(1, 0, 3), o.frame, positions) * seen, share},
                    1);
}

}  // namespace

EncoderInput encoderInput(const std::vector<View>& views, const Observation& o,
                          const EncoderConfig& config) {
  EncoderInput in;
  in.voxel_features = torch::tensor(o.voxel_features).view({o.tokens.size(0), kVoxelFeatures});
  for (int level = 1; level <= config.levels; ++level) {
    const auto& children = o.tokens.children(level);
    Tensor t = torch::empty({int64_t(children.size()), 8}, torch::kInt64);
    int64_t* row = t.data_ptr<int64_t>();
    for (const auto& c : children)
      for (int32_t child : c) *row++ = child < 0 ? o.tokens.size(level - 1) : child;
    in.children.push_back(t);
  }
  const auto& coords = o.tokens.coords(config.levels);
  in.coords = coordTensor(coords);
  in.positions = tokenPositions(in.coords, config.levels, o.frame, config.positions);
  in.order = zOrder(coords);
  in.patches = patchPixels(views, o, config.patch_px);
  in.patch_geometry = patchGeometry(views, o, config.positions);

  const int64_t tokens = in.coords.size(0);
  require(int64_t(o.row_begin.size()) == tokens + 1,
          "encoderInput: the observation counts pixels of another tree level than the latents'");
  std::vector<int32_t> rows;
  for (int32_t v = 0; v < tokens; ++v)
    rows.insert(rows.end(), size_t(o.row_begin[size_t(v) + 1] - o.row_begin[size_t(v)]), v);
  in.voxels_from_patches =
      countAttention(rows, o.patch, o.count, tokens, o.patches, config.guide_log_counts);
  in.patches_from_voxels =
      countAttention(o.patch, rows, o.count, o.patches, tokens, config.guide_log_counts);
  return in;
}

BidirectionalBlock::BidirectionalBlock(const EncoderConfig& c, bool updates_patches) : config(c) {
  auto norm = [&] { return nn::LayerNorm(nn::LayerNormOptions({c.width})); };
  self3 = register_module("self3", std::make_shared<SelfBlock>(c.width, c.heads));
  cross3 = register_module("cross3", std::make_shared<Attention>(c.width, c.heads));
  norm3 = register_module("norm3", norm());
  context2 = register_module("context2", norm());
  alpha = register_parameter("alpha", torch::zeros({1}), c.guide_alpha < 0);
  if (!updates_patches) return;
  self2 = register_module("self2", std::make_shared<SelfBlock>(c.width, c.heads));
  cross2 = register_module("cross2", std::make_shared<Attention>(c.width, c.heads));
  norm2 = register_module("norm2", norm());
  context3 = register_module("context3", norm());
}

Tensor BidirectionalBlock::share() const {
  return config.guide_alpha < 0 ? alpha.sigmoid() : torch::full({1}, config.guide_alpha);
}

void BidirectionalBlock::forward(Tensor* x3, Tensor* x2, const EncoderInput& in, const Rotary& pos,
                                 int layer) {
  *x3 = *x3 + cross3->guided(norm3->forward(*x3), context2->forward(*x2), share(),
                             [&](const Tensor& v) { return in.voxels_from_patches.apply(v); });
  *x3 = self3->windowed(*x3, &pos, in.order, config.window, layer % 2 == 1);
  if (!self2) return;
  *x2 = *x2 + cross2->guided(norm2->forward(*x2), context3->forward(*x3), share(),
                             [&](const Tensor& v) { return in.patches_from_voxels.apply(v); });
  *x2 = self2->forward(*x2, nullptr);  // full: views have no order
}

EncoderNet::EncoderNet(const EncoderConfig& c) : config(c) {
  const int64_t d = c.width, dv = c.voxel_width, m = c.gaussians_per_voxel;
  auto norm = [&](int64_t width) { return nn::LayerNorm(nn::LayerNormOptions({width})); };
  voxel_in =
      register_module("voxel_in", std::make_shared<Mlp>(kVoxelFeatures, 2 * dv, c.levels ? dv : d));
  for (int l = 1; l <= c.levels; ++l)
    aggregate.push_back(register_module("aggregate" + std::to_string(l),
                                        std::make_shared<Mlp>(8 * (l == 1 ? dv : d), 2 * d, d)));
  position_in = register_module("position_in", Linear(kSinusoidalDim, d));
  patch_in = register_module("patch_in", Linear(3 * c.patch_px * c.patch_px, d));
  geometry_in = register_module("geometry_in", Linear(10 + 2 * kSinusoidalDim, d));
  for (int b = 0; b < c.blocks; ++b)
    blocks.push_back(register_module("block" + std::to_string(b),
                                     std::make_shared<BidirectionalBlock>(c, b + 1 < c.blocks)));
  feature_shortcut = register_module("feature_shortcut", Linear(kVoxelFeatures + 24, c.latent_dim));
  colour_shortcut = register_module("colour_shortcut", Linear(c.latent_dim, 24));
  posterior_norm = register_module("posterior_norm", norm(d));
  posterior = register_module("posterior", Linear(d, 2 * c.latent_dim));
  latent_in = register_module("latent_in", Linear(c.latent_dim, d));
  for (int b = 0; b < c.decoder_blocks; ++b)
    decoder_blocks.push_back(register_module("decoder_block" + std::to_string(b),
                                             std::make_shared<SelfBlock>(d, c.heads)));
  decoder_norm = register_module("decoder_norm", norm(d));
  for (int split = 0; split < c.levels; ++split) {
    child_logits.push_back(register_module("child_logits" + std::to_string(split), Linear(d, 8)));
    child_tokens.push_back(register_module("child_tokens" + std::to_string(split),
                                           Linear(d, 8 * (split + 1 == c.levels ? dv : d))));
  }
  const int64_t last = c.levels ? dv : d;
  gaussian_mlp = register_module("gaussian_mlp", std::make_shared<Mlp>(last, 4 * last, last));
  gaussian_norm = register_module("gaussian_norm", norm(last));
  gaussian_out = register_module("gaussian_out", Linear(last, m * 14));

  initialiseXavier(*this);
  torch::NoGradGuard no_grad;
  posterior->bias.slice(0, c.latent_dim).fill_(-4);  // starts nearly deterministic
  gaussian_out->weight.mul_(.3);
  // One colour a token at first; the octants learn to differ (starting apart costs .2 dB after 400
  // steps).
  colour_shortcut->weight.copy_(colour_shortcut->weight.slice(0, 0, 3).repeat({8, 1}));
  feature_shortcut->weight.slice(1, kVoxelFeatures).zero_();
}

namespace {

// Colours [..., 3] around 0 as luminance and two differences, scaled to about unit deviation: hues
// differ by hundredths, and a network that sees them beside brightness learns grey first and colour
// much later.
Tensor opponentColours(const Tensor& srgb) {
  const Tensor y = srgb.mean(-1, true);
  return torch::cat(
      {(y - .5f) * 4, (srgb.slice(-1, 0, 1) - y) * 12, (srgb.slice(-1, 2, 3) - y) * 12}, -1);
}
// The reverse for the network's outputs: display colour less .5.
Tensor srgbFromOpponent(const Tensor& o) {
  const Tensor y = o.slice(-1, 0, 1) / 2, r = o.slice(-1, 1, 2), b = o.slice(-1, 2, 3);
  return torch::cat({y + r, y - r - b, y + b}, -1);
}

// Voxel features as the first layer sees them; octants without pixels stay 0.
Tensor scaledFeatures(const Tensor& f) {
  const Tensor octants = f.slice(1, kOctantColours, kMeanColour).view({-1, 8, 4}),
               share = octants.slice(2, 3, 4);
  const Tensor colours = opponentColours(octants.slice(2, 0, 3)) * (share > 0);
  return torch::cat({torch::cat({colours, share * 4}, 2).view({-1, 32}),
                     opponentColours(f.slice(1, kMeanColour, kPixelCount)),
                     f.slice(1, kPixelCount, kVoxelFeatures) * 2},
                    1);
}

}  // namespace

EncoderNet::Posterior EncoderNet::encode(const EncoderInput& in) {
  Tensor pooled = scaledFeatures(in.voxel_features);
  Tensor octants = pooled.slice(1, kOctantColours, kMeanColour)
                       .view({-1, 8, 4})
                       .slice(2, 0, 3);  // colours, [N, 8, 3]
  Tensor x3 = voxel_in->forward(pooled);
  for (size_t l = 0; l < aggregate.size(); ++l) {
    const Tensor& children = in.children[l];
    auto gather = [&](const Tensor& rows) {  // [N, 8, C], absent children 0
      return torch::cat({rows, torch::zeros({1, rows.size(1)})})
          .index_select(0, children.flatten())
          .view({children.size(0), 8, rows.size(1)});
    };
    const Tensor present = (children < x3.size(0)).sum(1, true).to(torch::kFloat32);
    octants = gather(pooled.slice(1, kMeanColour, kPixelCount));
    pooled = gather(pooled).sum(1) / present;
    x3 = aggregate[l]->forward(gather(x3).flatten(1));
  }
  x3 = x3 + position_in->forward(sinusoidalCode(in.positions));
  Tensor x2 = patch_in->forward(in.patches) +
              geometry_in->forward(
                  torch::cat({in.patch_geometry, sinusoidalCode(in.patch_geometry.slice(1, 3, 6)),
                              sinusoidalCode(in.patch_geometry.slice(1, 6, 9))},
                             1));
  const Rotary pos = rotary(in.coords, config.width / config.heads, config.positions);
  for (size_t b = 0; b < blocks.size(); ++b) blocks[b]->forward(&x3, &x2, in, pos, int(b));
  const auto halves = posterior->forward(posterior_norm->forward(x3)).chunk(2, 1);
  const Tensor shallow = feature_shortcut->forward(torch::cat({pooled, octants.flatten(1)}, 1));
  return {halves[0] + shallow, halves[1].clamp(-12, 4)};
}

Tensor EncoderNet::normalise(const Tensor& z) {
  return config.latent_groups ? torch::group_norm(z, config.latent_groups) : z;
}

DecoderTokens EncoderNet::decodeTokens(const Tensor& z, const Tensor& coords, const Tensor& order) {
  Tensor x = latent_in->forward(z);
  const Rotary pos = rotary(coords, config.width / config.heads, config.positions);
  for (size_t b = 0; b < decoder_blocks.size(); ++b)
    x = decoder_blocks[b]->windowed(x, &pos, order, config.window, b % 2 == 1);
  return {decoder_norm->forward(x), colour_shortcut->forward(z).view({-1, 8, 3})};
}

Tensor EncoderNet::childLogits(const DecoderTokens& tokens, int split) {
  return child_logits[size_t(split)]->forward(tokens.features);
}

DecoderTokens EncoderNet::splitTokens(const DecoderTokens& tokens, const Split& s, int split) {
  const Tensor rows = s.parent * 8 + s.slot;
  const Tensor features =
      inRowBlocks(tokens.features.size(0), [&](int64_t begin, int64_t end) {
        return child_tokens[size_t(split)]->forward(rowRange(tokens.features, begin, end));
      }).view({tokens.features.size(0) * 8, -1});
  const Tensor colours = tokens.colours.reshape({-1, 1, 3}).index_select(0, rows);
  return {features.index_select(0, rows), colours.expand({-1, 8, 3})};
}

Tensor subLattice(int64_t m) {
  const int64_t side = int64_t(std::ceil(std::cbrt(double(m)) - 1e-9)), cells = side * side * side;
  const Tensor cell = torch::arange(m) * cells / m;
  const auto at = [&](int64_t stride) {
    return (torch::floor_divide(cell.to(torch::kInt64), stride)
                .remainder(side)
                .to(torch::kFloat32) +
            .5f) /
           float(side);
  };
  return torch::stack({at(side * side), at(side), at(1)}, 1);
}

GaussianTensors EncoderNet::gaussians(const DecoderTokens& voxels, const Tensor& coords, float h) {
  const int64_t n = coords.size(0), m = config.gaussians_per_voxel;
  Tensor x = voxels.features;
  x = gaussian_out->forward(gaussian_norm->forward(x + gaussian_mlp->forward(x))).view({n, m, 14});
  const Tensor lattice = subLattice(m), high = (lattice > .5f).to(torch::kInt64);
  const Tensor octant = high.select(1, 0) * 4 + high.select(1, 1) * 2 + high.select(1, 2);
  const Tensor colour = x.slice(2, 11, 14) + voxels.colours.index_select(1, octant);
  const Tensor corner = coords.to(torch::kFloat32).unsqueeze(1);
  // Biases at the start: sigma of half a sub-cell, opacity .73, unit rotation, grey. Offsets reach
  // .75 voxel.
  const float sigma0 = .5f / float(std::cbrt(double(m))), raw0 = std::log(std::expm1(sigma0));
  GaussianTensors g;
  g.mean =
      ((corner + lattice.unsqueeze(0) + .75f * torch::tanh(x.slice(2, 0, 3))) * h).view({n * m, 3});
  g.log_scale =
      torch::log(torch::softplus(x.slice(2, 3, 6) + raw0).clamp(.02, 1.5) * h).view({n * m, 3});
  g.rotation = (x.slice(2, 6, 10) + torch::tensor({1.f, 0.f, 0.f, 0.f})).view({n * m, 4});
  g.opacity_logit = (x.slice(2, 10, 11) + 1).view({n * m});
  // Rasterisers cut colours off at 0, where no gradient passes: a channel that fell below stayed
  // dark for good.
  const Tensor srgb = srgbFromOpponent(colour) + .5f;
  g.sh = ((srgb + (srgb.clamp_min(1e-3) - srgb).detach() - .5f) / kSh0).view({n * m, 1, 3});
  return g;
}

Tensor injectFalsePositives(const Tensor& occupied, const std::vector<Coord>& coords, float ratio,
                            torch::Generator& random) {
  const Tensor truth = occupied.contiguous();
  const int64_t n = truth.size(0), wanted = int64_t(std::lround(ratio * truth.sum().item<float>()));
  std::vector<Coord> true_children, false_children;
  std::vector<int64_t> false_index;
  const bool* t = truth.data_ptr<bool>();
  for (int64_t i = 0; i < n * 8; ++i) {
    const Coord child = childCoord(coords[size_t(i / 8)], int(i % 8));
    if (t[i]) {
      true_children.push_back(child);
    } else {
      false_children.push_back(child);
      false_index.push_back(i);
    }
  }
  if (wanted == 0 || false_children.empty()) return truth;
  const std::vector<int32_t> distance = breadthFirstLevels(false_children, true_children);
  std::vector<int64_t> near;
  for (size_t k = 0; k < false_index.size(); ++k)
    if (distance[k] == 1) near.push_back(false_index[k]);
  Tensor mask = truth.clone();
  Tensor flat = mask.view({-1});
  auto addRandom = [&](const std::vector<int64_t>& pool, int64_t count) {
    const Tensor candidates = torch::tensor(pool);
    const Tensor open =
        candidates.index_select(0, (~flat.index_select(0, candidates)).nonzero().flatten());
    const Tensor order = torch::randperm(open.size(0), random);
    flat.index_fill_(0, open.index_select(0, order.slice(0, 0, count)), true);
  };
  if (!near.empty()) addRandom(near, wanted / 2);
  const int64_t added = flat.sum().item<int64_t>() - int64_t(true_children.size());
  addRandom(false_index, wanted - added);
  return mask;
}

Split splitOf(const Tensor& mask) {
  const Tensor where = mask.nonzero();
  return {where.select(1, 0).contiguous(), where.select(1, 1).contiguous()};
}

}  // namespace vdbc
