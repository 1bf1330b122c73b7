#include "examples/lab/reconstruct.h"

#include <torch/optim/adam.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstring>
#include <random>

#include "encoder/network.h"
#include "examples/lab/scores.h"
#include "examples/rooms/rooms.h"
#include "splat/metrics.h"
#include "splat/rasterize.h"
#include "splat/rasterize_torch.h"
#include "vdb/process.h"
#include "vdb/progress.h"

namespace vdbc {
namespace {

using Clock = std::chrono::steady_clock;
using Mask = std::vector<uint8_t>;

constexpr double kLeastObserved = .01;  // share of a view's pixels, below which it says nothing

// Views and which of their pixels count.
struct JudgedViews {
  std::vector<View> views;
  std::vector<Mask> observed;
};

JudgedViews judged(std::vector<View> views, const Observation& o, int level,
                   const CarveSettings& carving) {
  JudgedViews j{std::move(views), {}};
  for (const View& v : j.views) j.observed.push_back(observedPixels(v, o, level, carving));
  return j;
}

constexpr double kSeenWithin = .05;  // metres

// The same views, with the pixels whose point one of `input` measured.
JudgedViews measuredPart(const JudgedViews& all, const std::vector<View>& input) {
  JudgedViews part = all;
  for (size_t v = 0; v < part.views.size(); ++v) {
    const View& view = part.views[v];
    const int w = view.camera.width;
    for (size_t i = 0; i < part.observed[v].size(); ++i) {
      if (!part.observed[v][i]) continue;
      const Eigen::Vector3d point = view.camera.unproject(
          double(int(i) % w) + .5, double(int(i) / w) + .5, double(view.depth[i]));
      part.observed[v][i] = std::any_of(input.begin(), input.end(), [&](const View& other) {
        const Eigen::Vector3d uvz = other.camera.project(point);
        const int64_t pixel = other.camera.pixelAt(uvz);
        if (pixel < 0) return false;
        const float depth = other.depth[size_t(pixel)];
        return depth > 0 && std::abs(double(depth) - uvz.z()) < kSeenWithin;
      });
    }
  }
  return part;
}

// At most kTargetViews, spread evenly.
std::vector<View> fewOf(const std::vector<View>& all) {
  const size_t n = std::min(all.size(), size_t(kTargetViews));
  std::vector<View> few;
  for (size_t i = 0; i < n; ++i) few.push_back(all[i * all.size() / n]);
  return few;
}

// Mean over the views; keeps the first pictures in `shown`.
PictureError meanError(const JudgedViews& judged, const Gaussians& gaussians, size_t show,
                       std::vector<Image>* shown) {
  RasterSettings settings;
  settings.antialias = gaussians.antialias;
  PictureError mean;
  double n = 0;
  for (size_t i = 0; i < judged.views.size(); ++i) {
    Image colour = rasterize(gaussians, judged.views[i].camera, settings).colour;
    for (float& v : colour.data) v = std::clamp(v, 0.f, 1.f);
    const PictureError e = pictureError(judged.views[i].colour, colour, judged.observed[i]);
    if (i < show) shown->push_back(std::move(colour));
    if (double(e.pixels) < kLeastObserved * double(judged.observed[i].size())) continue;
    mean.psnr += e.psnr, mean.ssim += e.ssim, mean.flip += e.flip, mean.pixels += e.pixels, ++n;
  }
  mean.psnr /= n, mean.ssim /= n, mean.flip /= n;  // NaN without views
  return mean;
}

constexpr size_t kShownViewsOfKind = 2;

template <typename T>
Tensor parameterOf(const std::vector<T>& values, at::IntArrayRef shape) {
  Tensor t = torch::empty(shape);
  std::memcpy(t.data_ptr<float>(), values.data(), t.nbytes());
  return t.requires_grad_();
}

template <typename T>
void copyBack(const Tensor& from, std::vector<T>* to) {
  std::memcpy(static_cast<void*>(to->data()), from.data_ptr<float>(), from.nbytes());
}

const std::vector<Score<ReconstructionResult>> kReconstructionScores = {
    {"input_psnr", &ReconstructionResult::input_psnr},
    {"input_ssim", &ReconstructionResult::input_ssim},
    {"input_flip", &ReconstructionResult::input_flip},
    {"other_psnr", &ReconstructionResult::other_psnr},
    {"other_ssim", &ReconstructionResult::other_ssim},
    {"other_flip", &ReconstructionResult::other_flip},
    {"other_seen_psnr", &ReconstructionResult::other_seen_psnr},
    {"voxel_precision", &ReconstructionResult::voxel_precision},
    {"voxel_recall", &ReconstructionResult::voxel_recall},
    {"voxel_f1", &ReconstructionResult::voxel_f1},
    {"node_precision", &ReconstructionResult::node_precision},
    {"node_recall", &ReconstructionResult::node_recall},
    {"node_f1", &ReconstructionResult::node_f1},
    {"leak", &ReconstructionResult::leak},
    {"encode_seconds", &ReconstructionResult::encode_seconds},
    {"decode_seconds", &ReconstructionResult::decode_seconds},
    {"peak_rss_mb", &ReconstructionResult::peak_rss_mb}};

}  // namespace

std::string reconstructionJson(const ReconstructionResult& r) {
  return scoresJson(r, kReconstructionScores);
}

std::vector<ReconstructionResult> meanReconstructions(
    const std::vector<ReconstructionResult>& results) {
  return summaries(results, kReconstructionScores, "mean", meanOf);
}

Gaussians voxelMean(const Observation& o, int per_voxel) {
  const Tensor lattice = subLattice(per_voxel).contiguous();
  const Eigen::Map<const Eigen::Matrix3Xf> place(lattice.data_ptr<float>(), 3, per_voxel);
  const double sigma_m = .5 * o.frame.voxel_m / std::cbrt(double(per_voxel));
  Gaussians g;
  for (int64_t v = 0; v < o.tokens.size(0); ++v) {
    const Coord ijk = o.tokens.coords(0)[size_t(v)];
    const float* features = &o.voxel_features[size_t(v) * kVoxelFeatures];
    const Eigen::Vector3f srgb = Eigen::Map<const Eigen::Vector3f>(features + kMeanColour);
    for (int i = 0; i < per_voxel; ++i)
      addIsotropic(
          o.frame.toWorld(Eigen::Vector3d(ijk.x(), ijk.y(), ijk.z()) + place.col(i).cast<double>()),
          sigma_m, srgb, &g);
  }
  return g;
}

Gaussians optimised(const Gaussians& start, const std::vector<View>& views,
                    const std::vector<Mask>& observed, const OptimiseSettings& s,
                    Progress& progress) {
  const auto started = Clock::now();
  const int64_t n = start.size();
  Tensor mean = parameterOf(start.mean, {n, 3}), log_scale = parameterOf(start.log_scale, {n, 3});
  Tensor rotation = parameterOf(start.rotation, {n, 4}),
         opacity = parameterOf(start.opacity_logit, {n});
  Tensor sh = parameterOf(start.sh, {n, start.shCoefficients(), 3});
  std::vector<torch::optim::OptimizerParamGroup> groups;
  auto add = [&](const Tensor& parameter, double rate) {
    groups.emplace_back(
        std::vector<Tensor>{parameter},
        std::make_unique<torch::optim::AdamOptions>(torch::optim::AdamOptions(rate).eps(1e-15)));
  };
  // In the proportions of 3-D Gaussian splatting (Kerbl et al. 2023), about four times as fast
  // (opacity: as fast): half a minute on two cores is a few hundred steps. Of factors .3, 1 and 2,
  // and of means at 1, 2 and 3 mm, these did best on validation rooms 900000 and 900001.
  add(mean, 2e-3), add(log_scale, 2e-2), add(rotation, 4e-3), add(opacity, 5e-2), add(sh, 1e-2);
  torch::optim::Adam adam(groups, torch::optim::AdamOptions());

  std::vector<Tensor> colours, masks;
  for (size_t i = 0; i < views.size(); ++i) {
    const int64_t h = views[i].camera.height, w = views[i].camera.width;
    colours.push_back(torch::tensor(views[i].colour.data).view({h, w, 3}));
    masks.push_back(torch::tensor(observed[i]).view({h, w, 1}).to(torch::kFloat32));
  }
  std::mt19937_64 random(s.seed);
  RasterSettings raster;
  raster.antialias = start.antialias;
  for (int64_t step = 0; step < s.max_steps && secondsSince(started) < s.seconds; ++step) {
    const size_t i = random() % views.size();
    const Tensor image =
        rasterizeTorch(mean, log_scale, rotation, opacity, sh, views[i].camera, raster)
            .slice(2, 0, 3);
    adam.zero_grad();
    (((image - colours[i]).square() * masks[i]).sum() / (3 * masks[i].sum()).clamp_min(1))
        .backward();
    adam.step();
    report(progress, int(100 * std::max(double(step) / double(s.max_steps),
                                        secondsSince(started) / s.seconds)));
  }
  Gaussians g = start;
  copyBack(mean, &g.mean), copyBack(log_scale, &g.log_scale), copyBack(rotation, &g.rotation);
  copyBack(opacity, &g.opacity_logit), copyBack(sh, &g.sh);
  return g;
}

SetScores splitScores(const TriangleMesh& truth, const Observation& o,
                      const std::vector<Coord>& voxels, int level) {
  openvdb::tree::ValueAccessor<const TokenMask> empty(o.seen->empty);
  const auto unseen = [&](const Coord& child) {
    if (o.tokens.row(level + 1, tokenCoord(child, 1)) < 0 || o.tokens.row(level, child) >= 0)
      return false;
    return !allVoxelsOn(empty, child, level);
  };
  std::set<Coord> surface, filled;
  for (const Coord& child : surfaceNodes(truth, o.frame, level))
    if (unseen(child)) surface.insert(child);
  for (const Coord& voxel : voxels)
    if (unseen(tokenCoord(voxel, level))) filled.insert(tokenCoord(voxel, level));
  return setScores(filled, surface);
}

std::vector<ReconstructionResult> evaluateReconstruction(
    const EvaluationScene& scene, const Encoder& encoder, const SceneSettings& settings,
    double optimise_seconds, const std::string& picture, Progress& progress) {
  SceneSettings s = settings;
  s.observing.volume.up = scene.up;
  const int level = encoder.config().levels;

  resetPeakMemory();
  progress.start("encode");
  auto start = Clock::now();
  const Observation o = observe(scene.input, encoder.observing(s.observing), progress);
  const double observe_seconds = secondsSince(start);
  const Place place = encoder.encode(scene.input, o, progress);
  const double encode_seconds = secondsSince(start);
  progress.end();
  progress.start("decode");
  start = Clock::now();
  const DecodedGrid decoded = encoder.decode(place, s.child_threshold, progress);
  const double decode_seconds = secondsSince(start);
  progress.end();

  const JudgedViews input = judged(scene.input, o, level, s.observing.carving);
  const JudgedViews others = judged(fewOf(scene.targets), o, level, s.observing.carving);
  const JudgedViews others_seen = measuredPart(others, scene.input);
  std::vector<ReconstructionResult> results;
  std::vector<std::vector<Image>> columns(1);
  for (const JudgedViews* j : {&input, &others})
    for (size_t i = 0; i < std::min(kShownViewsOfKind, j->views.size()); ++i)
      columns[0].push_back(j->views[i].colour);
  auto measure = [&](const char* method, const Gaussians& gaussians,
                     double seconds) -> ReconstructionResult& {
    ReconstructionResult r;
    r.peak_rss_mb = peakMemoryMb();  // before it is looked at
    r.scene = scene.name, r.method = method, r.views = int(scene.input.size()),
    r.gaussians = gaussians.size();
    columns.emplace_back();
    const PictureError a = meanError(input, gaussians, kShownViewsOfKind, &columns.back());
    const PictureError b = meanError(others, gaussians, kShownViewsOfKind, &columns.back());
    r.input_psnr = a.psnr, r.input_ssim = a.ssim, r.input_flip = a.flip;
    r.other_seen_psnr = meanError(others_seen, gaussians, 0, nullptr).psnr;
    r.other_psnr = b.psnr, r.other_ssim = b.ssim, r.other_flip = b.flip;
    r.voxel_precision = r.voxel_recall = r.voxel_f1 = r.node_precision = r.node_recall = r.node_f1 =
        kNan;
    r.leak = r.decode_seconds = kNan;
    r.encode_seconds = seconds;
    results.push_back(r);
    resetPeakMemory();
    start = Clock::now();
    return results.back();
  };

  ReconstructionResult& ours = measure("reconstructed", decoded.gaussians, encode_seconds);
  ours.decode_seconds = decode_seconds;
  if (scene.truth) {
    if (level > 0) {
      const SetScores split = splitScores(*scene.truth, o, decoded.voxels, 0);
      ours.voxel_precision = split.precision, ours.voxel_recall = split.recall,
      ours.voxel_f1 = split.f1;
    }
    if (level > 1) {
      const SetScores split = splitScores(*scene.truth, o, decoded.voxels, 1);
      ours.node_precision = split.precision, ours.node_recall = split.recall,
      ours.node_f1 = split.f1;
    }
    ours.leak = sceneLeak(scene, o.frame, decoded.voxels);
    start = Clock::now();
  }
  if (s.detail.seconds > 0) {
    progress.start("detail");
    const Detail detail = seenDetail(scene.input, s.detail, s.observing.carving,
                                     o.frame.world_from_grid.translation(), progress);
    progress.end();
    measure("detail", detail.discs, secondsSince(start));
  }
  const Gaussians means = voxelMean(o, encoder.config().gaussians_per_voxel);
  ReconstructionResult& voxel_mean =
      measure("voxel-mean", means, observe_seconds + secondsSince(start));
  if (scene.truth) voxel_mean.leak = sceneLeak(scene, o.frame, o.tokens.coords(0));
  start = Clock::now();
  {
    const Gaussians pixels = pixelAligned(input.views, input.observed);
    measure("pixel-aligned", pixels, observe_seconds + secondsSince(start));
  }
  if (optimise_seconds > 0) {
    progress.start("optimise");
    OptimiseSettings optimise;
    optimise.seconds = optimise_seconds, optimise.seed = s.completion.seed;
    const Gaussians best = optimised(means, input.views, input.observed, optimise, progress);
    progress.end();
    measure("optimised", best, observe_seconds + secondsSince(start));
  }
  if (!picture.empty()) writeColumns(columns, picture);
  return results;
}

}  // namespace vdbc
