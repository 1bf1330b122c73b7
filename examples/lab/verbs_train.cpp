// Training of the networks on furnished rooms.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <memory>
#include <nlohmann/json.hpp>

#include "encoder/encoder_train.h"
#include "examples/lab/packed_room.h"
#include "examples/lab/scenes.h"
#include "examples/lab/verbs_lab.h"
#include "houdini_style_tools/complete.h"

namespace vdbc {
namespace {

using nlohmann::ordered_json;

// With packed rooms, which are read faster than a step is worked out: scenes and fine samples.
constexpr int64_t kPackedBatch = 4, kPackedFineDraws = 6;

struct TrainOptions {
  TrainSettings settings;
  std::string cache, preset = "small", encoder, packed;
  std::vector<std::string> changes;  // NAME=VALUE
  int64_t rooms = 0;
};

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

std::string seedRange(uint64_t first, int64_t count) {
  return joinText("rooms:", first, "-", first + uint64_t(count) - 1);
}

TrainSettings settingsOf(const TrainOptions& o, const Run& run, int validation_rooms) {
  TrainSettings s = o.settings;
  if (std::filesystem::path(s.weights_path).extension() != ".safetensors")
    throw UsageError(
        joinText("--output: ", s.weights_path, ": expected a name that ends in .safetensors"));
  requireCreatable(s.weights_path);
  if (s.work_folder.empty()) s.work_folder = s.weights_path + ".work";
  s.processes = processes(), s.seed = run.seed;
  if (s.batch % s.processes.size != 0)
    throw UsageError(joinText("--batch: expected a multiple of WORLD_SIZE ", s.processes.size,
                              ", found ", s.batch));
  s.validate_every = std::clamp<int64_t>(s.steps / 8, 1, s.validate_every);
  s.metadata["trained_on"] = seedRange(kTrainingSeed, o.rooms);
  s.metadata["validated_on"] = seedRange(kValidationSeed, validation_rooms);
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
Config configOf(const TrainOptions& o) {
  ordered_json j =
      ordered_json::parse((o.preset == "paper" ? Config::paper() : Config::small()).toJson());
  for (const std::string& change : o.changes) {
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

void cookTrainEncoder(const TrainOptions& o, const Run& run, Progress& progress) {
  constexpr int kValidationRooms = 12;
  const EncoderConfig config = configOf<EncoderConfig>(o);
  const TrainSettings s = settingsOf(o, run, kValidationRooms);
  auto source = [&](uint64_t first) {
    return [&o, first](uint64_t i) { return trainingViews(first + i, o.cache); };
  };
  trainEncoder(config, source(kTrainingSeed), o.rooms, source(kValidationSeed), kValidationRooms, s,
               trainListener(run.json), progress);
}

// What the completer is trained on.
struct TrainingSamples {
  SampleSource source;
  int64_t count = 0;
  std::string rooms;  // rooms:SEED-SEED
};

TrainingSamples samplesOfPackedRooms(const std::string& folder, const Encoder& encoder) {
  const PackedSamples packed = packedSamples(folder, encoder.hash());
  const uint64_t first = packed.seeds.front(), last = packed.seeds.back();
  require(first >= kTrainingSeed && last < kTrainingSeed + kReservedSeeds, folder,
          ": expected rooms for training, ", kTrainingSeed, "-", kTrainingSeed + kReservedSeeds - 1,
          ", found ", first, "-", last);
  return {packed.source, packed.count, joinText("rooms:", first, "-", last)};
}

// Samples of rooms by seed, kept in `folder`.
SampleSource roomSamples(const Encoder& encoder, uint64_t first, int64_t rooms,
                         const std::string& cache, const std::string& folder) {
  return [&encoder, first, rooms, cache, folder](uint64_t i) {
    return completionSample(encoder, first + i % uint64_t(rooms), int(i / uint64_t(rooms)), cache,
                            folder);
  };
}

// Encoded now, so that training does not wait for it.
TrainingSamples samplesOfRooms(const Encoder& encoder, int64_t rooms, const std::string& cache,
                               const std::string& folder, Progress& progress) {
  const TrainingSamples s{roomSamples(encoder, kTrainingSeed, rooms, cache, folder),
                          rooms * kSamplesPerRoom, seedRange(kTrainingSeed, rooms)};
  progress.start("encode rooms");
  for (int64_t i = 0; i < s.count; ++i) {
    s.source(uint64_t(i));
    report(progress, int(100 * i / s.count));
  }
  progress.end();
  return s;
}

void cookTrainMar(TrainOptions o, const Run& run, Progress& progress) {
  constexpr int kValidationRooms = 8;
  const bool packed = !o.packed.empty();
  if (packed && !run.isGiven("--batch")) o.settings.batch = kPackedBatch;
  if (packed && !run.isGiven("--fine")) o.settings.fine_draws = kPackedFineDraws;
  const Encoder encoder(o.encoder);
  // Refused now, not after the rooms are encoded.
  if (!o.settings.from.empty()) Completer{o.settings.from};
  CompleterConfig config = configOf<CompleterConfig>(o);
  config.latent_dim = encoder.config().latent_dim,
  config.latent_groups = encoder.config().latent_groups;
  TrainSettings s = settingsOf(o, run, kValidationRooms);
  s.metadata["encoder_hash"] = encoder.hash();
  s.validate_every = 1000;  // roll-outs take seconds each
  // Samples depend on the encoder: its hash names their folder.
  const std::string folder = s.work_folder + "/samples_" + encoder.hash();
  const TrainingSamples training =
      packed ? samplesOfPackedRooms(o.packed, encoder)
             : samplesOfRooms(encoder, o.rooms, o.cache, folder, progress);
  s.metadata["trained_on"] = training.rooms;
  trainCompleter(config, encoder.colourWay(), training.source, training.count,
                 roomSamples(encoder, kValidationSeed, kValidationRooms, o.cache, folder),
                 kValidationRooms, s, trainListener(run.json), progress);
}

std::vector<Option> trainOptions(TrainOptions* o, const std::string& batch) {
  TrainSettings* s = &o->settings;
  return {
      option("-o,--output FILE", &s->weights_path, "weights to write (.safetensors)").required(),
      option("--steps N", &s->steps, "training steps").between(1, double(int64_t(1) << 40)),
      option("--rooms N", &o->rooms, "furnished rooms to train on")
          .between(1, double(kReservedSeeds)),
      option("--rate R", &s->learning_rate, "peak learning rate").between(0, 1),
      option("--batch N", &s->batch, "samples a step").between(1, 1 << 20).otherwise(batch),
      option("--preset NAME", &o->preset, "small or paper").oneOf({"small", "paper"}),
      option("--set NAME=VALUE", &o->changes, "changes a size of the preset; may come again"),
      option("--work FOLDER", &s->work_folder, "for checkpoint, log and pictures")
          .otherwise("OUTPUT.work"),
      option("--cache FOLDER", &o->cache, "of rooms from make_rooms; missing ones are put there")
          .otherwise("rendered each time"),
      flag("--mixed-precision", &s->mixed_precision,
           "matrix products in bfloat16: faster where the CPU has it"),
      flag("--resume", &s->resume, "continue from the checkpoint in the work folder")};
}

}  // namespace

Verb trainEncoderVerb() {
  const auto o = std::make_shared<TrainOptions>();
  o->settings.steps = 4000, o->settings.learning_rate = 1e-3, o->rooms = 1000;
  return {"train encoder",
          "trains the encoder-decoder on furnished rooms",
          "-o out/encoder.safetensors --cache out/rooms",
          {{"", trainOptions(o.get(), "1")}},
          [o](const Run& run, Progress& progress) { cookTrainEncoder(*o, run, progress); }};
}

Verb trainMarVerb() {
  const auto o = std::make_shared<TrainOptions>();
  o->settings.steps = 8000, o->settings.learning_rate = 8e-4, o->rooms = 400;
  std::vector<Option> options =
      trainOptions(o.get(), joinText("1; ", kPackedBatch, " with --packed"));
  options.push_back(option("--fine N", &o->settings.fine_draws,
                           "fine samples of each, behind its one coarse sample")
                        .between(1, 1 << 20)
                        .otherwise(joinText("1; ", kPackedFineDraws, " with --packed")));
  options.push_back(option("--packed FOLDER", &o->packed, "of rooms from pack, all of them")
                        .otherwise("rooms are rendered and encoded")
                        .excludes({"--rooms"}));
  options.push_back(option("--encoder FILE", &o->encoder, "encoder weights").required());
  options.push_back(option("--from FILE", &o->settings.from, "completer weights to start from")
                        .otherwise("random ones")
                        .excludes({"--resume"}));
  return {"train mar",
          "trains the masked auto-regressive completer on the encoder's latents of furnished rooms",
          "--encoder out/encoder.safetensors -o out/completer.safetensors --cache out/rooms",
          {{"", options}},
          [o](const Run& run, Progress& progress) { cookTrainMar(*o, run, progress); }};
}

}  // namespace vdbc
