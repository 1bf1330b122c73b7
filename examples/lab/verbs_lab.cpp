// How good it is: all methods on scenes that were never trained on.
#include "examples/lab/verbs_lab.h"

#include <cmath>
#include <cstdio>
#include <memory>

#include "examples/lab/reconstruct.h"
#include "houdini_style_tools/options.h"

namespace vdbc {
namespace {

constexpr int kViews = 2, kReconstructionViews = 12;

struct EvalOptions {
  std::string scenes, weights, lpips, features, pictures;
  std::vector<int> frames;
  int views = kViews;
  std::vector<double> taus;
  bool reconstruct = false;
  double optimise_seconds = OptimiseSettings().seconds;
  SceneSettings settings;
};

// FOLDER/N.png of scene N, which can be created; "" where no pictures are wanted.
std::string pictureOf(const EvalOptions& o, int64_t scene) {
  if (o.pictures.empty()) return "";
  const std::string picture = joinText(o.pictures, "/", scene, ".png");
  requireCreatable(picture);
  return picture;
}

SceneSettings settingsOf(const EvalOptions& o, const Run& run) {
  SceneSettings s = o.settings;
  s.completion.seed = run.seed;
  return s;
}

// results(scene, picture) of every scene, shown as they come.
template <typename Result, typename Evaluate, typename Show>
std::vector<Result> evaluateAll(const EvalOptions& o, const SceneList& scenes,
                                const Evaluate& evaluate, const Show& show) {
  std::vector<Result> all;
  for (int64_t i = 0; i < scenes.count; ++i) {
    const EvaluationScene scene = scenes.scene(i);
    const std::string picture = pictureOf(o, i);
    for (const Result& r : naming(scene.name, [&] { return evaluate(scene, picture); })) {
      show(r);
      all.push_back(r);
    }
  }
  return all;
}

void print(const MethodResult& r, bool json) {
  if (json) {
    std::printf("%s\n", resultJson(r).c_str());
    if (r.reliability) std::printf("%s\n", reliabilityJson(r).c_str());
  } else {
    char perceived[96] = "", calibrated[24] = "";
    int used = 0;
    if (!std::isnan(r.lpips))
      used = std::snprintf(perceived, sizeof perceived, "lpips %.3f  ", r.lpips);
    if (!std::isnan(r.fid))
      std::snprintf(perceived + used, sizeof perceived - size_t(used), "fid %.2f  kid %.4f  ",
                    r.fid, r.kid);
    if (!std::isnan(r.ece)) std::snprintf(calibrated, sizeof calibrated, "ece %.3f  ", r.ece);
    std::printf(
        "%-14s %-17s psnr %6.2f  ssim %.3f  flip %.3f  %sdepth %.3f m  precision %.3f  recall "
        "%.3f (shell %.3f, furniture %.3f)  f1 %.3f  iou %.3f  outside %.0f  %sleak %.3f  %6.2f "
        "s  %5.0f MB  %lld\n",
        r.scene.c_str(), r.method.c_str(), r.psnr, r.ssim, r.flip, perceived, r.depth_median_m,
        r.precision, r.recall, r.shell_recall, r.furniture_recall, r.f1, r.iou, r.outside,
        calibrated, r.leak, r.seconds, r.peak_rss_mb, static_cast<long long>(r.gaussians));
  }
  std::fflush(stdout);
}

void print(const ReconstructionResult& r, bool json) {
  if (json) {
    std::printf("%s\n", reconstructionJson(r).c_str());
  } else {
    std::printf(
        "%-14s %-14s input: psnr %6.2f  ssim %.3f  flip %.3f  others: psnr %6.2f  ssim %.3f  "
        "flip %.3f  voxels: precision %.3f  recall %.3f  f1 %.3f  leak %.3f  %6.2f + %.2f s  "
        "%5.0f MB  %lld\n",
        r.scene.c_str(), r.method.c_str(), r.input_psnr, r.input_ssim, r.input_flip, r.other_psnr,
        r.other_ssim, r.other_flip, r.voxel_precision, r.voxel_recall, r.voxel_f1, r.leak,
        r.encode_seconds, r.decode_seconds, r.peak_rss_mb, static_cast<long long>(r.gaussians));
  }
  std::fflush(stdout);
}

void cookEvaluate(const EvalOptions& o, const Run& run, Progress& progress) {
  const SceneList scenes = sceneList(o.scenes, o.views, o.frames, run.seed);
  UserNets nets;
  if (!o.lpips.empty()) nets.lpips = std::make_shared<const PerceptualNet>(o.lpips);
  if (!o.features.empty()) nets.features = std::make_shared<const FeatureNet>(o.features);
  const std::string weights = weightsFolder(o.weights);
  const Encoder encoder(weights + "/encoder.safetensors");
  const Completer completer(weights + "/completer.safetensors");
  const SceneSettings settings = settingsOf(o, run);
  const auto show = [&](const MethodResult& r) { print(r, run.json); };
  const std::vector<MethodResult> all = evaluateAll<MethodResult>(
      o, scenes,
      [&](const EvaluationScene& scene, const std::string& picture) {
        return evaluateScene(scene, encoder, completer, settings, o.taus, picture, progress, nets);
      },
      show);
  for (const MethodResult& r : meanResults(all)) show(r);
  if (scenes.count < 2) return;
  for (const MethodResult& r : deviationResults(all)) show(r);
}

void cookReconstruct(const EvalOptions& o, const Run& run, Progress& progress) {
  const int views = run.isGiven("--views") ? o.views : kReconstructionViews;
  const SceneList scenes = sceneList(o.scenes, views, o.frames, run.seed);
  const Encoder encoder(weightsFolder(o.weights) + "/encoder.safetensors");
  const SceneSettings settings = settingsOf(o, run);
  const auto show = [&](const ReconstructionResult& r) { print(r, run.json); };
  const std::vector<ReconstructionResult> all = evaluateAll<ReconstructionResult>(
      o, scenes,
      [&](const EvaluationScene& scene, const std::string& picture) {
        return evaluateReconstruction(scene, encoder, settings, o.optimise_seconds, picture,
                                      progress);
      },
      show);
  for (const ReconstructionResult& r : meanReconstructions(all)) show(r);
}

}  // namespace

Verb evalVerb() {
  const auto o = std::make_shared<EvalOptions>();
  CompleteSettings* s = &o->settings.completion;
  OptionGroup completion{"The completion", growthOptions(s)};
  for (const Option& another :
       {tauOption(s),
        option("--taus P...", &o->taus, "also completed with each of these --tau").between(0, 1),
        option("--context-tokens N", &s->context_tokens, "observed tokens around a chunk")
            .between(1, 1 << 20)
            .otherwise("as trained"),
        option("--chunk-tokens N", &s->chunk_tokens, "targets of a chunk")
            .between(1, 1 << 20)
            .otherwise("as trained"),
        flag("--random-order", &s->random_order, "growth in random instead of breadth-first order"),
        option("--lpips FILE", &o->lpips, "your TorchScript network of two pictures"),
        option("--features FILE", &o->features,
               "your TorchScript network of one picture, for FID and KID")})
    completion.options.push_back(another);
  for (Option& of_completion : completion.options) of_completion.excludes({"--reconstruct"});
  return {"eval",
          "compares all methods on scenes that were never trained on",
          "--scenes rooms:1-8 --views 2",
          {{"",
            {option("--scenes SPEC", &o->scenes,
                    "rooms:SEED-SEED, homes:N-N, or a folder with transforms.json")
                 .required(),
             option("--views N", &o->views, "input views a scene")
                 .between(1, 1000)
                 .otherwise(joinText(kViews, "; ", kReconstructionViews, " with --reconstruct")),
             ranges("--frames LIST", &o->frames, "input frames of a folder")
                 .otherwise("--views random ones"),
             weightsOption(&o->weights), marginOption(&o->settings),
             childTauOption(&o->settings.child_threshold),
             option("--pictures FOLDER", &o->pictures,
                    "for N.png of scene N; columns: truth, observed, nearest, box, completed, "
                    "oracle occupancy, oracle latents (--reconstruct: truth, reconstruction, "
                    "baselines)")}},
           {"What was seen", detailOptions(&o->settings.detail)},
           completion,
           {"The encoder-decoder alone",
            {flag("--reconstruct", &o->reconstruct,
                  "no completion: what was observed, encoded and decoded, beside baselines"),
             option("--optimise SECONDS", &o->optimise_seconds,
                    "a scene for the baseline of optimised Gaussians; 0 leaves it out")
                 .between(0, 86400)
                 .needs({"--reconstruct"})}}},
          [o](const Run& run, Progress& progress) {
            (o->reconstruct ? cookReconstruct : cookEvaluate)(*o, run, progress);
          }};
}

Program vdbLab() {
  Program lab{"vdb_lab",
              "Furnished rooms, training and studies of vdb_complete.",
              {trainEncoderVerb(), trainMarVerb(), packVerb(), calibrateVerb(), evalVerb(),
               tablesVerb(), compareVerb()}};
  for (Verb& v : makeRoomsVerbs()) lab.verbs.push_back(std::move(v));
  return lab;
}

}  // namespace vdbc
