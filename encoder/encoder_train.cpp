#include "encoder/encoder_train.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "encoder/network.h"
#include "encoder/trainer.h"
#include "splat/image_files.h"
#include "splat/rasterize_torch.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

constexpr int64_t kStepsPerScene = 4;  // with other views each time

struct Losses {
  Tensor image, kl, occupancy;
  Tensor total(const EncoderConfig& c) const {
    return image + c.kl_weight * kl + c.occupancy_weight * occupancy;
  }
};

// A view to render, in grid axes, and the pixels that count: those whose surface was observed.
struct Target {
  Camera camera;
  Tensor colour;  // [H, W, 3]
  Tensor mask;    // [H, W, 1]
};

Target makeTarget(const View& view, const Observation& o, int levels,
                  const CarveSettings& carving) {
  Target t;
  t.camera = view.camera;
  t.camera.world_from_camera = o.frame.world_from_grid.inverse() * view.camera.world_from_camera;
  t.colour = torch::tensor(view.colour.data).view({view.camera.height, view.camera.width, 3});
  t.mask = torch::tensor(observedPixels(view, o, levels, carving))
               .to(torch::kFloat32)
               .view({view.camera.height, view.camera.width, 1});
  return t;
}

Tensor renderTarget(const GaussianTensors& g, const Target& t) {
  return rasterizeTorch(g.mean, g.log_scale, g.rotation, g.opacity_logit, g.sh, t.camera, {})
      .slice(2, 0, 3);
}

// Truth [N, 8] of the children of `coords` (tokens of `level`), and which of them are known at all.
std::pair<Tensor, Tensor> childTruth(const std::vector<Coord>& coords, int level,
                                     const Observation& o) {
  const int64_t n = int64_t(coords.size());
  Tensor truth = torch::zeros({n, 8}, torch::kBool), known = torch::zeros({n, 8}, torch::kBool);
  bool* t = truth.data_ptr<bool>();
  bool* k = known.data_ptr<bool>();
  openvdb::tree::ValueAccessor<const TokenMask> empty(o.seen->empty);
  for (const Coord& parent : coords)
    for (int slot = 0; slot < 8; ++slot, ++t, ++k) {
      const Coord child = childCoord(parent, slot);
      *t = *k = o.tokens.row(level - 1, child) >= 0;
      if (*t) continue;
      *k = allVoxelsOn(empty, child, level - 1);
    }
  return {truth, known};
}

// Decodes with the training mask (truth and false positives) or, without a generator, with the
// network's own splits, kept where observed (as Encoder::decode does).
GaussianTensors decodeForTraining(EncoderNet& net, const Tensor& z, const EncoderInput& in,
                                  const Observation& o, torch::Generator* random,
                                  Tensor* occupancy) {
  const EncoderConfig& c = net.config;
  std::vector<Coord> coords = o.tokens.coords(c.levels);
  DecoderTokens tokens = net.decodeTokens(z, in.coords, in.order);
  for (int split = 0; split < c.levels; ++split) {
    const int level = c.levels - split;
    const auto [truth, known] = childTruth(coords, level, o);
    const Tensor logits = net.childLogits(tokens, split);
    if (occupancy && known.any().item<bool>())
      *occupancy = *occupancy +
                   torch::binary_cross_entropy_with_logits(
                       logits.masked_select(known), truth.masked_select(known).to(torch::kFloat32));
    const Tensor mask = random ? injectFalsePositives(truth, coords, c.false_positives, *random)
                               : truth | ((logits > 0) & ~known);
    const Split s = splitOf(mask);
    tokens = net.splitTokens(tokens, s, split);
    std::vector<Coord> children;
    for (int64_t i = 0; i < s.parent.size(0); ++i)
      children.push_back(childCoord(coords[size_t(s.parent.data_ptr<int64_t>()[i])],
                                    int(s.slot.data_ptr<int64_t>()[i])));
    coords = std::move(children);
  }
  return net.gaussians(tokens, coordTensor(coords), o.frame.voxel_m);
}

Observation observeForTraining(const std::vector<View>& views, const EncoderConfig& c) {
  ObserveSettings settings;
  settings.patches_across = c.patches_across, settings.level = c.levels;
  settings.volume.voxel_m = c.voxel_m, settings.volume.margin_m = .4f;
  Progress silent;
  return observe(views, settings, silent);
}

Losses sceneLosses(EncoderNet& net, const std::vector<View>& condition,
                   const std::vector<View>& targets, torch::Generator& random) {
  const EncoderConfig& c = net.config;
  const Observation o = observeForTraining(condition, c);
  const EncoderInput in = encoderInput(condition, o, c);
  const auto posterior = net.encode(in);
  const Tensor noise = torch::randn(posterior.mean.sizes(), random);
  const Tensor z = net.normalise(posterior.mean + (posterior.log_variance / 2).exp() * noise);
  Losses l;
  l.kl =
      .5f *
      (posterior.mean.square() + posterior.log_variance.exp() - 1 - posterior.log_variance).mean();
  l.occupancy = torch::zeros({});
  const GaussianTensors g = decodeForTraining(net, z, in, o, &random, &l.occupancy);
  Tensor error = torch::zeros({}), pixels = torch::zeros({});
  for (const View& view : targets) {
    const Target t = makeTarget(view, o, c.levels, CarveSettings());
    error = error + ((renderTarget(g, t) - t.colour).square() * t.mask).sum();
    pixels = pixels + 3 * t.mask.sum();
  }
  l.image = error / pixels.clamp_min(1);
  return l;
}

// Fisher-Yates with our own generator, so that the choice is the same on any machine.
std::vector<size_t> shuffledIndices(size_t n, torch::Generator& random) {
  const Tensor order = torch::randperm(int64_t(n), random);
  return {order.data_ptr<int64_t>(), order.data_ptr<int64_t>() + n};
}

int64_t randomInt(int64_t n, torch::Generator& random) {
  return torch::randint(n, {1}, random).item<int64_t>();
}

// Condition views and one to hold out are the least that a step can use.
std::vector<View> viewsOf(const SceneSource& scenes, uint64_t index, size_t least) {
  std::vector<View> views = scenes(index);
  require(views.size() >= least, "train: scene ", index, ": expected at least ", least,
          " views, found ", views.size());
  return views;
}

struct Validation {
  double input_psnr = 0, novel_psnr = 0;
};

// PSNR over the counted pixels, mean over scenes; a picture of the first scenes.
Validation validate(EncoderNet& net, const std::vector<std::vector<View>>& scenes,
                    const std::string& picture_path) {
  torch::NoGradGuard no_grad;
  double psnr[2] = {0, 0};
  int64_t counted[2] = {0, 0};
  std::vector<Tensor> rows;
  for (const auto& views : scenes) {
    const std::vector<View> condition(views.begin(), views.begin() + 4);
    const Observation o = observeForTraining(condition, net.config);
    const EncoderInput in = encoderInput(condition, o, net.config);
    const Tensor z = net.normalise(net.encode(in).mean);
    const GaussianTensors g = decodeForTraining(net, z, in, o, nullptr, nullptr);
    std::vector<Tensor> row;
    for (size_t i = 2; i < 6 && i < views.size(); ++i) {  // two inputs, two held out
      const Target t = makeTarget(views[i], o, net.config.levels, CarveSettings());
      const Tensor image = renderTarget(g, t).clamp(0, 1);
      const double pixels = t.mask.sum().item<double>();
      if (pixels < 500) continue;
      const double mse = ((image - t.colour).square() * t.mask).sum().item<double>() / (3 * pixels);
      psnr[i >= 4] += -10 * std::log10(std::max(mse, 1e-10));
      ++counted[i >= 4];
      row.push_back(t.colour), row.push_back(image);
    }
    if (rows.size() < 3 && row.size() == 8) rows.push_back(torch::cat(row, 1));
  }
  if (!rows.empty()) {
    const Tensor sheet = torch::cat(rows, 0).contiguous();
    Image image(int(sheet.size(1)), int(sheet.size(0)), 3);
    std::copy_n(sheet.data_ptr<float>(), sheet.numel(), image.data.begin());
    writePng(image, picture_path);
  }
  return {psnr[0] / double(std::max<int64_t>(1, counted[0])),
          psnr[1] / double(std::max<int64_t>(1, counted[1]))};
}

void train(const EncoderConfig& config, const SceneSource& scenes, int64_t scene_count,
           const SceneSource& validation, int validation_count, const TrainSettings& settings,
           const TrainListener& listener, Progress& progress) {
  torch::manual_seed(settings.seed);
  auto net = std::make_shared<EncoderNet>(config), average = std::make_shared<EncoderNet>(config);
  Trainer trainer(net, average, "encoder", config.toJson(), settings, listener);
  std::vector<std::vector<View>> held_out;
  for (int i = 0; i < validation_count; ++i)
    held_out.push_back(viewsOf(validation, uint64_t(i), 4));

  // The scenes of a round of kStepsPerScene steps, one for each of this process's samples in a
  // step.
  auto scenesOfRound = [&, first = trainer.firstSample() -
                                   trainer.step() * settings.batch](int64_t round) {
    std::vector<std::vector<View>> all;
    for (int64_t k = first; k < first + trainer.samples(); ++k)
      all.push_back(viewsOf(scenes, uint64_t((round * settings.batch + k) % scene_count), 3));
    return all;
  };
  std::vector<std::vector<View>> current;
  progress.start("train encoder");
  while (!trainer.done()) {
    if (current.empty() || trainer.step() % kStepsPerScene == 0)
      current = scenesOfRound(trainer.step() / kStepsPerScene);
    for (int64_t k = 0; k < trainer.samples(); ++k) {
      const std::vector<View>& views = current[size_t(k)];
      // A generator per sample: a resumed run draws what an uninterrupted one would have drawn.
      torch::Generator random = at::detail::createCPUGenerator(settings.seed * 1000003 +
                                                               uint64_t(trainer.firstSample() + k));
      const std::vector<size_t> order = shuffledIndices(views.size(), random);
      const size_t n = std::min(views.size() - 2, size_t(1) << randomInt(4, random));  // 1, 2, 4, 8
      std::vector<View> condition, targets;
      for (size_t i = 0; i < n; ++i) condition.push_back(views[order[i]]);
      for (size_t i = 0; i < std::min<size_t>(n, 2); ++i) targets.push_back(views[order[i]]);
      for (size_t i = n; i < std::min(views.size(), n + 2); ++i) targets.push_back(views[order[i]]);
      const MixedPrecision mixed(settings.mixed_precision);
      const Losses l = sceneLosses(*net, condition, targets, random);
      const Tensor total = l.total(config);
      trainer.addLoss(total, {{"loss", total.item<double>()},
                              {"image", l.image.item<double>()},
                              {"kl", l.kl.item<double>()},
                              {"split", l.occupancy.item<double>()}});
    }
    trainer.update();
    if (trainer.validationDue()) {
      const Validation v = validate(*average, held_out, settings.work_folder + "/validation.png");
      trainer.log({{"input_psnr", v.input_psnr}, {"novel_psnr", v.novel_psnr}});
    }
    trainer.saveIfDue();
    trainer.stopIfInterrupted(progress);
  }
  progress.end();
}

}  // namespace

void trainEncoder(const EncoderConfig& config, const SceneSource& scenes, int64_t scene_count,
                  const SceneSource& validation, int validation_count,
                  const TrainSettings& settings, const TrainListener& listener,
                  Progress& progress) {
  withThreads(1, [&] {
    train(config, scenes, scene_count, validation, validation_count, settings, listener, progress);
  });
}

std::pair<double, double> encoderStepLoss(const EncoderConfig& config,
                                          const std::vector<View>& views, uint64_t seed) {
  torch::manual_seed(seed);
  auto net = std::make_shared<EncoderNet>(config);
  torch::optim::AdamW optimiser(net->parameters(), torch::optim::AdamWOptions(1e-4));
  double loss[2];
  for (double& value : loss) {
    torch::Generator random = at::detail::createCPUGenerator(seed);
    const Tensor total = sceneLosses(*net, views, views, random).total(config);
    value = total.item<double>();
    optimiser.zero_grad();
    total.backward();
    optimiser.step();
  }
  return {loss[0], loss[1]};
}

}  // namespace vdbc
