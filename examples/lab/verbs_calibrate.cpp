// Gives a completer's weights the curve that makes their probabilities true.
#include <array>
#include <cstdio>
#include <memory>
#include <nlohmann/json.hpp>

#include "encoder/weights.h"
#include "examples/lab/evaluate.h"
#include "examples/lab/verbs_lab.h"
#include "houdini_style_tools/options.h"
#include "houdini_style_tools/report.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

struct CalibrateOptions {
  std::string scenes, weights, output;
  std::vector<int> views{1, 2, 4};
};

// What became of every token that completing a scene asks about.
std::vector<Outcome> allOutcomes(const EvaluationScene& scene, const Encoder& encoder,
                                 const Completer& completer, Progress& progress) {
  SceneSettings settings;
  settings.detail.seconds = 0;
  settings.completion.tau = 0, settings.completion.hole_tau = 1;  // all are kept
  const Place place = completeScene(scene.input, encoder, completer, settings, progress);
  return outcomesOf(
      place,
      poolSeen(seenByAll(scene, place.frame, settings.observing.carving, progress), place.level));
}

// The expected calibration error of outcomes under a curve.
double errorOf(const std::vector<Outcome>& outcomes, const Calibration& curve) {
  std::vector<Outcome> after = outcomes;
  for (Outcome& o : after) o.probability = calibrated(curve, logit(o.probability));
  return calibrationError(reliabilityOf(after));
}

// The weights with a curve, in half floats.
void writeCalibrated(TensorFile file, CompleterConfig config, const Calibration& curve,
                     const std::string& path) {
  config.calibration = curve;
  file.metadata["completer"] = config.toJson();
  for (auto& [name, tensor] : file.tensors)
    if (tensor.scalar_type() == torch::kFloat32) tensor = tensor.to(torch::kFloat16);
  writeTensors(file, path);
}

void cookCalibrate(const CalibrateOptions& o, const Run& run, Progress& progress) {
  requireCreatable(o.output);
  const std::string weights = weightsFolder(o.weights), from = weights + "/completer.safetensors";
  const Encoder encoder(weights + "/encoder.safetensors");
  const TensorFile file = readTensors(from);
  // What is fitted is what the rounded network says without a curve.
  const TemporaryFile rounded("calibrate", o.output);
  writeCalibrated(file, Completer(from).config(), {}, rounded.path());
  const Completer completer(rounded.path());
  // Of even and odd scenes: each half is judged by the curve of the other.
  std::array<std::vector<Outcome>, 2> halves;
  for (int views : o.views) {
    const SceneList scenes = sceneList(o.scenes, views, {}, run.seed);
    if (scenes.count < 2)
      throw UsageError(joinText("--scenes: ", o.scenes, ": expected at least two scenes"));
    for (int64_t i = 0; i < scenes.count; ++i) {
      const EvaluationScene scene = scenes.scene(i);
      const std::vector<Outcome> more =
          naming(scene.name, [&] { return allOutcomes(scene, encoder, completer, progress); });
      halves[size_t(i % 2)].insert(halves[size_t(i % 2)].end(), more.begin(), more.end());
    }
  }
  double before = 0, after = 0, count = 0;
  for (size_t half : {0, 1}) {
    const auto tokens = double(halves[half].size());
    before += tokens * errorOf(halves[half], {});
    after += tokens * errorOf(halves[half], fitCalibration(halves[1 - half]));
    count += tokens;
  }
  halves[0].insert(halves[0].end(), halves[1].begin(), halves[1].end());
  writeCalibrated(file, completer.config(), fitCalibration(halves[0]), o.output);
  printResult(
      run.json,
      {{"tokens", count},
       {"error_before", before / count},
       {"error_after", after / count},
       {"output", o.output}},
      joinText(count, " tokens: expected calibration error ", before / count, " before, ",
               after / count, " after, on scenes that the curve was not fitted to\n", o.output));
}

}  // namespace

Verb calibrateVerb() {
  const auto o = std::make_shared<CalibrateOptions>();
  return {"calibrate",
          "fits the curve that makes a completer's probabilities true, and writes its weights with "
          "it, in half floats",
          "--scenes rooms:200-215 -o out/completer.safetensors",
          {{"",
            {option("--scenes SPEC", &o->scenes, "rooms:SEED-SEED, at least two").required(),
             option("-o,--output FILE", &o->output, "weights to write (.safetensors)").required(),
             ranges("--views LIST", &o->views, "input views a scene: completed with each")
                 .otherwise("1,2,4"),
             weightsOption(&o->weights)}}},
          [o](const Run& run, Progress& progress) { cookCalibrate(*o, run, progress); }};
}

}  // namespace vdbc
