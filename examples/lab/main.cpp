// vdb_lab: training, and studies of what was trained.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "encoder/encoder_train.h"
#include "examples/lab/reconstruct.h"
#include "examples/lab/scenes.h"
#include "examples/lab/tables.h"
#include "houdini_style_tools/console.h"
#include "houdini_style_tools/options.h"
#include "mar/completer_train.h"
#include "vdb/file_io.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

using nlohmann::ordered_json;

struct Evaluate {
  std::string scenes, frames, weights, lpips, features, pictures;
  int views = 2;
  std::vector<double> taus;
  int context_tokens = 0, chunk_tokens = 0;
  bool random_order = false, reconstruct = false;
  double optimise_seconds = OptimiseSettings().seconds;
};
struct Train {
  std::string output, work, cache, preset = "small", encoder, from;
  std::vector<std::string> changes;
  int64_t steps = 0, scenes = 0, batch = 1;
  double rate = 0;
  bool resume = false, mixed_precision = false;
};

// FOLDER/N.png of scene N, which can be created; "" where no pictures are wanted.
std::string pictureOf(const Evaluate& o, int64_t scene) {
  if (o.pictures.empty()) return "";
  const std::string picture = joinText(o.pictures, "/", scene, ".png");
  requireCreatable(picture);
  return picture;
}

void cookEvaluate(const Evaluate& o, const Complete& options, const Common& common,
                  Progress& progress) {
  const SceneList scenes = sceneList(o.scenes, o.views, frameList(o.frames), common.seed);
  UserNets nets;
  if (!o.lpips.empty()) nets.lpips = std::make_shared<const PerceptualNet>(o.lpips);
  if (!o.features.empty()) nets.features = std::make_shared<const FeatureNet>(o.features);
  const std::string weights = weightsFolder(o.weights);
  const Encoder encoder(weights + "/encoder.safetensors");
  const Completer completer(weights + "/completer.safetensors");
  SceneSettings settings = sceneSettings(options, common, Eigen::Vector3d::UnitZ());
  settings.completion.random_order = o.random_order;
  settings.completion.context_tokens = o.context_tokens,
  settings.completion.chunk_tokens = o.chunk_tokens;
  std::vector<MethodResult> all;
  auto show = [&](const MethodResult& r) {
    if (common.json) {
      std::printf("%s\n", resultJson(r).c_str());
      if (r.reliability) std::printf("%s\n", reliabilityJson(r).c_str());
    } else {
      char perceived[96] = "", calibrated[24] = "";
      int used = 0;
      if (nets.lpips) used = std::snprintf(perceived, sizeof perceived, "lpips %.3f  ", r.lpips);
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
  };
  for (int64_t i = 0; i < scenes.count; ++i) {
    const EvaluationScene scene = scenes.scene(i);
    const std::string picture = pictureOf(o, i);
    for (const MethodResult& r : naming(scene.name, [&] {
           return evaluateScene(scene, encoder, completer, settings, o.taus, picture, progress,
                                nets);
         })) {
      show(r);
      all.push_back(r);
    }
  }
  for (const MethodResult& r : meanResults(all)) show(r);
  if (scenes.count < 2) return;
  for (const MethodResult& r : deviationResults(all)) show(r);
}

// RANK of WORLD_SIZE processes that meet at MASTER_ADDR:MASTER_PORT, the variables that torchrun
// sets.
TrainProcesses processes() {
  TrainProcesses p;
  auto number = [](const char* name, int high, auto* value) {
    const char* text = std::getenv(name);
    if (!text) return;
    int used = 0, found = 0;
    if (std::sscanf(text, "%d%n", &found, &used) != 1 || text[used] != '\0' || found < 0 ||
        found > high)
      throw UsageError(joinText(name, ": expected a number from 0 to ", high, ", found ", text));
    *value = std::decay_t<decltype(*value)>(found);
  };
  number("WORLD_SIZE", 4096, &p.size), number("RANK", 4095, &p.rank),
      number("MASTER_PORT", 65535, &p.port);
  if (const char* address = std::getenv("MASTER_ADDR")) p.address = address;
  if (p.rank >= std::max(1, p.size))
    throw UsageError(joinText("RANK: expected less than WORLD_SIZE ", p.size, ", found ", p.rank));
  p.size = std::max(1, p.size);
  return p;
}

void cookReconstruct(const Evaluate& o, const Complete& options, const Common& common,
                     Progress& progress) {
  const SceneList scenes = sceneList(o.scenes, o.views, frameList(o.frames), common.seed);
  const Encoder encoder(weightsFolder(o.weights) + "/encoder.safetensors");
  const SceneSettings settings = sceneSettings(options, common, Eigen::Vector3d::UnitZ());
  std::vector<ReconstructionResult> all;
  auto show = [&](const ReconstructionResult& r) {
    if (common.json) {
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
  };
  for (int64_t i = 0; i < scenes.count; ++i) {
    const EvaluationScene scene = scenes.scene(i);
    const std::string picture = pictureOf(o, i);
    for (const ReconstructionResult& r : naming(scene.name, [&] {
           return evaluateReconstruction(scene, encoder, settings, o.optimise_seconds, picture,
                                         progress);
         })) {
      show(r);
      all.push_back(r);
    }
  }
  for (const ReconstructionResult& r : meanReconstructions(all)) show(r);
}

TrainSettings trainSettings(const Train& t, const Common& common) {
  if (fs::path(t.output).extension() != ".safetensors")
    throw UsageError(
        joinText("--output: ", t.output, ": expected a name that ends in .safetensors"));
  requireCreatable(t.output);
  TrainSettings s;
  s.weights_path = t.output;
  s.work_folder = t.work.empty() ? t.output + ".work" : t.work;
  s.batch = t.batch, s.processes = processes(), s.mixed_precision = t.mixed_precision;
  if (s.batch % s.processes.size != 0)
    throw UsageError(joinText("--batch: expected a multiple of WORLD_SIZE ", s.processes.size,
                              ", found ", s.batch));
  s.steps = t.steps, s.learning_rate = t.rate, s.seed = common.seed, s.resume = t.resume,
  s.from = t.from;
  s.validate_every = std::clamp<int64_t>(t.steps / 8, 1, s.validate_every);
  return s;
}

TrainListener trainListener(bool json) {
  return [json](const TrainLogRow& row) {
    nlohmann::json j = row.values;
    j["step"] = row.step;
    if (json) {
      std::printf("%s\n", j.dump().c_str());
    } else {
      std::printf("step %lld", static_cast<long long>(row.step));
      for (const auto& [name, value] : row.values) std::printf("  %s %.4g", name.c_str(), value);
      std::printf("\n");
    }
    std::fflush(stdout);
  };
}

// The preset's configuration with --set NAME=VALUE applied.
template <typename Config>
Config configOf(const Train& t) {
  ordered_json j =
      ordered_json::parse((t.preset == "paper" ? Config::paper() : Config::small()).toJson());
  for (const std::string& change : t.changes) {
    const size_t equals = change.find('=');
    const std::string name = change.substr(0, equals);
    if (equals == std::string::npos || !j.contains(name))
      throw UsageError(joinText("--set: ", change, ": expected NAME=VALUE with one of ", j.dump()));
    const ordered_json value = ordered_json::parse(change.substr(equals + 1), nullptr, false);
    if (value.type() != j[name].type() && !(value.is_number() && j[name].is_number_float()))
      throw UsageError(joinText("--set: ", change, ": expected a value like ", j[name].dump()));
    j[name] = value;
  }
  try {
    return Config::fromJson(j.dump(), "--set");
  } catch (const Error& e) {
    throw UsageError(e.what());
  }
}

std::string seedRange(uint64_t first, int64_t count) {
  return joinText("rooms:", first, "-", first + uint64_t(count) - 1);
}

void cookTrainEncoder(const Train& t, const Common& common, Progress& progress) {
  constexpr int kValidationRooms = 12;
  const EncoderConfig config = configOf<EncoderConfig>(t);
  TrainSettings s = trainSettings(t, common);
  s.metadata["trained_on"] = seedRange(kTrainingSeed, t.scenes);
  s.metadata["validated_on"] = seedRange(kValidationSeed, kValidationRooms);
  auto source = [&](uint64_t first) {
    return [&t, first](uint64_t i) { return trainingViews(first + i, t.cache); };
  };
  trainEncoder(config, source(kTrainingSeed), t.scenes, source(kValidationSeed), kValidationRooms,
               s, trainListener(common.json), progress);
}

void cookTrainMar(const Train& t, const Common& common, Progress& progress) {
  constexpr int kValidationRooms = 8;
  const Encoder encoder(t.encoder);
  if (!t.from.empty()) Completer{t.from};  // refused now, not after the rooms are encoded
  CompleterConfig config = configOf<CompleterConfig>(t);
  config.latent_dim = encoder.config().latent_dim,
  config.latent_groups = encoder.config().latent_groups;
  TrainSettings s = trainSettings(t, common);
  s.metadata["trained_on"] = seedRange(kTrainingSeed, t.scenes);
  s.metadata["validated_on"] = seedRange(kValidationSeed, kValidationRooms);
  s.metadata["encoder_hash"] = encoder.hash();
  s.validate_every = 1000;  // roll-outs take seconds each
  // Samples depend on the encoder: its hash names their folder.
  const std::string samples = s.work_folder + "/samples_" + encoder.hash();
  auto source = [&](uint64_t first, int64_t rooms) {
    return [&, first, rooms](uint64_t i) {
      return completionSample(encoder, first + i % uint64_t(rooms), int(i / uint64_t(rooms)),
                              t.cache, samples);
    };
  };
  const auto training = source(kTrainingSeed, t.scenes),
             validation = source(kValidationSeed, kValidationRooms);
  const int64_t count = t.scenes * kSamplesPerRoom;
  progress.start("encode rooms");
  for (int64_t i = 0; i < count; ++i) {
    training(uint64_t(i));
    report(progress, int(100 * i / count));
  }
  progress.end();
  trainCompleter(config, encoder.colourWay(), training, count, validation, kValidationRooms, s,
                 trainListener(common.json), progress);
}

void addEvaluate(CLI::App* verb, Evaluate* o, Complete* options) {
  constexpr int kReconstructionViews = 12;
  verb->add_option("--scenes", o->scenes, "rooms:SEED-SEED, or a folder with transforms.json")
      ->required();
  auto* views = verb->add_option("--views", o->views,
                                 joinText("input views a scene [", o->views, "; ",
                                          kReconstructionViews, " with --reconstruct]"))
                    ->check(CLI::Range(1, 1000));
  verb->add_option("--frames", o->frames, "input frames of a folder [--views random ones]");
  addWeights(verb, &o->weights);
  verb->add_option("--lpips", o->lpips, "your TorchScript network of two pictures [none]");
  verb->add_option("--features", o->features,
                   "your TorchScript network of one picture, for FID and KID [none]");
  addCompletion(verb, options);
  verb->add_option("--taus", o->taus, "also completed with each of these --tau")
      ->check(Between(0, 1));
  verb->add_option("--context-tokens", o->context_tokens,
                   "observed tokens around a chunk [as trained]")
      ->check(CLI::Range(1, 1 << 20));
  verb->add_option("--chunk-tokens", o->chunk_tokens, "targets of a chunk [as trained]")
      ->check(CLI::Range(1, 1 << 20));
  verb->add_flag("--random-order", o->random_order,
                 "growth in random instead of breadth-first order");
  auto* reconstruct =
      verb->add_flag("--reconstruct", o->reconstruct,
                     "no completion: what was observed, encoded and decoded, beside baselines");
  for (const char* of_completion :
       {"--lpips", "--features", "--tau", "--coarse-tau", "--hole-tau", "--sampling-steps",
        "--temperature", "--generated-context", "--refine-observed", "--taus", "--random-order",
        "--context-tokens", "--chunk-tokens"})
    reconstruct->excludes(verb->get_option(of_completion));
  verb->add_option("--optimise", o->optimise_seconds,
                   "seconds a scene for the baseline of optimised Gaussians, 0 leaves it out")
      ->check(Between(0, 86400))
      ->capture_default_str()
      ->needs(reconstruct);
  verb->add_option("--pictures", o->pictures,
                   "folder for N.png of scene N; columns: truth, observed, nearest, box, "
                   "completed, oracle occupancy "
                   "(--reconstruct: truth, reconstruction, baselines) [none]");
  verb->callback([=] {
    if (o->reconstruct && !views->count()) o->views = kReconstructionViews;
  });
}

void addTrain(CLI::App* verb, Train* t, int64_t steps, int64_t rooms, double rate) {
  verb->add_option("-o,--output", t->output, "weights to write (.safetensors)")->required();
  verb->add_option("--work", t->work, "folder for checkpoint, log and pictures [OUTPUT.work]");
  verb->add_option(
      "--cache", t->cache,
      "folder of rooms from make_rooms; missing ones are put there [render each time]");
  verb->add_option("--preset", t->preset, "small or paper")
      ->check(CLI::IsMember({"small", "paper"}))
      ->capture_default_str();
  verb->add_option("--set", t->changes,
                   "NAME=VALUE, changes a size of the preset (several allowed)")
      ->allow_extra_args(false);
  verb->add_option("--batch", t->batch, "samples a step")
      ->check(CLI::Range(int64_t(1), int64_t(1) << 20))
      ->capture_default_str();
  auto* s = verb->add_option("--steps", t->steps, joinText("training steps [", steps, "]"))
                ->check(CLI::Range(int64_t(1), int64_t(1) << 40));
  auto* n =
      verb->add_option("--rooms", t->scenes, joinText("furnished rooms to train on [", rooms, "]"))
          ->check(CLI::Range(int64_t(1), int64_t(kReservedSeeds)));
  auto* r = verb->add_option("--rate", t->rate, joinText("peak learning rate [", rate, "]"))
                ->check(Between(0, 1));
  verb->add_flag("--mixed-precision", t->mixed_precision,
                 "matrix products in bfloat16: faster where the CPU has it");
  verb->add_flag("--resume", t->resume, "continue from the checkpoint in the work folder");
  verb->callback([=] {
    if (!s->count()) t->steps = steps;
    if (!n->count()) t->scenes = rooms;
    if (!r->count()) t->rate = rate;
  });
}

struct Tables {
  std::vector<std::string> files, configurations;
  std::vector<std::string> scores = {
      "psnr", "ssim", "flip",    "precision", "recall", "shell_recall", "furniture_recall",
      "f1",   "iou",  "outside", "leak",      "ece",    "seconds"};
  std::string method = "completed", csv, reliability;
};

void writeText(const std::string& path, const std::string& text) {
  if (!path.empty()) writeFile("tables", path, text.data(), text.size());
}

void cookTables(const Tables& o) {
  std::vector<ResultLine> lines;
  for (const std::string& file : o.files)
    for (const ResultLine& line : readResults(file)) lines.push_back(line);
  writeText(o.csv, methodCsv(lines));
  writeText(o.reliability, reliabilityCsv(lines));
  std::printf("%s", methodTables(lines, o.scores).c_str());
}

void cookCompare(const Tables& o) {
  std::vector<NamedResults> all;
  for (const std::string& configuration : o.configurations) {
    const size_t equals = configuration.find('=');
    if (equals == std::string::npos)
      throw UsageError(joinText("compare: ", configuration, ": expected NAME=FILE"));
    all.push_back({configuration.substr(0, equals), readResults(configuration.substr(equals + 1))});
  }
  writeText(o.csv, comparisonCsv(all, o.method));
  std::printf("%s", comparisonTable(all, o.method, o.scores).c_str());
}

int run(int argc, char** argv) {
  CLI::App app{"Trains the networks of vdb_complete, and measures them.", "vdb_lab"};
  Common common;
  Complete eval_options;
  Evaluate evaluate;
  Train train;
  app.require_subcommand(1);
  CLI::App* verb_eval =
      app.add_subcommand("eval", "compares all methods on scenes that were never trained on");
  addEvaluate(verb_eval, &evaluate, &eval_options);
  CLI::App* verb_train = app.add_subcommand("train", "trains a network on furnished rooms");
  verb_train->require_subcommand(1);
  CLI::App* train_encoder = verb_train->add_subcommand("encoder", "the encoder-decoder");
  addTrain(train_encoder, &train, 4000, 1000, 1e-3);
  CLI::App* train_mar = verb_train->add_subcommand("mar", "the masked auto-regressive completer");
  addTrain(train_mar, &train, 8000, 400, 8e-4);
  train_mar->add_option("--encoder", train.encoder, "encoder weights")->required();
  train_mar->add_option("--from", train.from, "completer weights to start from [random]")
      ->excludes(train_mar->get_option("--resume"));
  Tables tables;
  CLI::App* verb_tables = app.add_subcommand("tables", "");
  verb_tables->add_option("FILES", tables.files)->required();
  verb_tables->add_option("--reliability", tables.reliability);
  CLI::App* verb_compare = app.add_subcommand("compare", "");
  verb_compare->add_option("FILES", tables.configurations)->required();
  verb_compare->add_option("--method", tables.method);
  for (CLI::App* verb : {verb_tables, verb_compare}) {
    verb->add_option("--scores", tables.scores);
    verb->add_option("--csv", tables.csv);
  }
  for (CLI::App* verb : {verb_eval, train_encoder, train_mar}) addCommon(verb, &common);

  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);  // --help
    throw UsageError(joinText(e.what(), " (vdb_lab --help)"));
  }
  Console console(common.json);
  withThreads(common.threads, [&] {
    if (verb_tables->parsed())
      cookTables(tables);
    else if (verb_compare->parsed())
      cookCompare(tables);
    else if (verb_eval->parsed())
      (evaluate.reconstruct ? cookReconstruct : cookEvaluate)(evaluate, eval_options, common,
                                                              console);
    else
      (train_encoder->parsed() ? cookTrainEncoder : cookTrainMar)(train, common, console);
  });
  return 0;
}

}  // namespace
}  // namespace vdbc

int main(int argc, char** argv) { return vdbc::runProgram("vdb_lab", vdbc::run, argc, argv); }
