// The main job, and a finished place with another tau.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <memory>
#include <nlohmann/json.hpp>

#include "houdini_style_tools/checkpoint.h"
#include "houdini_style_tools/options.h"
#include "houdini_style_tools/report.h"
#include "houdini_style_tools/verbs.h"
#include "splat/ply.h"
#include "vdb/mask_vdb.h"
#include "vdb/process.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using nlohmann::ordered_json;

constexpr const char* kOccupancyEnding = ".occupancy.vdb";

struct CompleteOptions {
  SceneOptions in;
  std::string region, lock;  // masks
  int samples = 1;
  bool resume = false;

  bool fromLatents() const { return endsWith(in.views, kLatentEnding); }
};

// The n-th of several completions: X.vdb, X.2.vdb, X.3.vdb.
std::string sampleStem(const std::string& stem, int n) {
  return n == 1 ? stem : joinText(stem, ".", n);
}

std::string checkpointOf(const std::string& stem) { return stem + ".checkpoint" + kLatentEnding; }

// What the options cannot say of each other.
void requireSense(const CompleteOptions& o, const Run& run) {
  const CompleteSettings& s = o.in.settings.completion;
  for (const char* of_views : {"--frames", "--up", "--bounds", "--margin", "--scale"})
    if (o.fromLatents() && run.isGiven(of_views))
      throw UsageError(joinText(of_views, ": expected views, found latents: ", o.in.views));
  if (run.isGiven("--from-level") && !o.fromLatents())
    throw UsageError("--from-level: expected X.latent.vdb of a completion instead of views");
  if (o.samples > 1 && !(s.sampling_steps > 0 && s.temperature > 0 && s.generated_context))
    throw UsageError(
        "--samples: expected --sampling-steps and --generated-context (and a temperature): without "
        "them all completions have the same occupancy");
}

// The output's stem, once all names can be written and what is to be resumed is there.
std::string completionStem(const CompleteOptions& o) {
  std::vector<std::string> more = {kLatentEnding};
  if (!o.fromLatents()) more.push_back(kPictureEnding);
  const std::string stem = outputStem(o.in.output, more);
  for (int n = 2; n <= o.samples; ++n) outputStem(sampleStem(stem, n) + ".vdb", more);
  if (o.samples > 1) requireCreatable(stem + kOccupancyEnding);
  requireOtherName(o.in.views, kLatentEnding, stem);
  bool begun = !o.resume;
  for (int n = 1; n <= o.samples; ++n)
    begun = begun || fs::exists(checkpointOf(sampleStem(stem, n)));
  require(begun, "--resume: ", checkpointOf(stem),
          ": no such file (expected a run that was cut short)");
  return stem;
}

// Tokens that may be generated: those of --region, less those of --lock; null: all.
std::shared_ptr<const TokenMask> allowedTokens(const CompleteOptions& o, const VoxelFrame& frame,
                                               const TokenMask& locked) {
  if (o.region.empty() && o.lock.empty()) return nullptr;
  auto allowed = std::make_shared<TokenMask>();
  if (o.region.empty())
    allowed->sparseFill(nodesIn(frame.bounds, 1), true, true);
  else
    allowed->topologyUnion(readTokenMask(o.region, frame, 1));
  allowed->topologyDifference(locked);
  return allowed;
}

// X of X.latent.vdb.
std::string stemOf(const std::string& latents) {
  return latents.substr(0, latents.size() - std::strlen(kLatentEnding));
}

// The place to start from, and the views that it was seen in: none where it is from a file.
struct Start {
  SceneInput in;
  Place place;
};

Start readStart(const CompleteOptions& o, const Encoder& encoder, const std::string& weights,
                Progress& progress) {
  if (o.fromLatents()) {
    Place place = readLatents(o.in.views, encoder, weights);
    const std::string stem = stemOf(o.in.views);
    const bool is_there = fs::exists(stem + kPointsEnding) && fs::exists(stem + ".vdb");
    if (!place.cameras.empty() && is_there && o.in.settings.detail.seconds > 0)
      place.detail = readDetail(stem, place.frame);
    const Eigen::Vector3d up = place.frame.world_from_grid.linear().col(2);
    progress.end();
    return {{{}, settingsOf(o.in, up)}, std::move(place)};
  }
  SceneInput in = readScene(o.in);
  progress.end();
  Place place =
      naming(o.in.views, [&] { return encodeScene(in.views, encoder, in.settings, progress); });
  return {std::move(in), std::move(place)};
}

// The tokens to grow from, and where growth may go.
Place chooseTokens(const CompleteOptions& o, const Place& all, CompleteSettings* settings) {
  const int32_t from_level = settings->first_level;
  require(
      from_level == 1 || std::count(all.bfs_level.begin(), all.bfs_level.end(), from_level - 1) > 0,
      "--from-level: ", o.in.views, ": expected tokens of growth level ", from_level - 1,
      ", found none");
  TokenMask locked;
  if (!o.lock.empty()) locked.topologyUnion(readTokenMask(o.lock, all.frame, 1));
  settings->region = allowedTokens(o, all.frame, locked);
  return keepRows(all, [&](size_t i) {
    return !all.generated[i] || all.bfs_level[i] < from_level || locked.isValueOn(all.ijk[i]);
  });
}

// What a completion made.
struct Made {
  Place place;
  Scene scene;
};

// One completion from encoded tokens to files, checkpointed on the way.
Made cookSample(const SceneInput& in, Place start, const Encoder& encoder,
                const Completer& completer, const std::string& stem, const CompleteOptions& o,
                Progress& progress) {
  CompleteSettings settings = in.settings.completion;
  const std::string checkpoint = checkpointOf(stem);
  const std::string identity = completionIdentity(completer, start, settings);
  if (o.resume && fs::exists(checkpoint))
    naming("--resume", [&] { readCheckpoint(checkpoint, identity, &start, &settings); });
  return naming(o.in.views, [&] {
    Place place =
        completer.complete(start, settings, progress, [&](const Place& so_far, int32_t next_level) {
          writeCheckpoint(so_far, next_level, identity, checkpoint);
        });
    Scene scene = writePlace(place, in.views, encoder, in.settings, stem, progress);
    fs::remove(checkpoint);
    return Made{std::move(place), std::move(scene)};
  });
}

constexpr double kFinePlyStep = .001;  // metres

ordered_json summaryOf(const SceneInput& in, const Made& made) {
  const auto& generated = made.place.generated;
  const Gaussians& gaussians = made.scene.splats.gaussians;
  const auto& splats = made.scene.splats.provenance.generated;
  const auto& detail = made.place.detail;
  const auto observed = std::count(generated.begin(), generated.end(), uint8_t(0));
  return {{"views", in.views.size()},
          {"observed_tokens", observed},
          {"generated_tokens", made.place.size() - observed},
          {"voxels", made.scene.voxels.size()},
          {"gaussians", gaussians.size()},
          {"observed_gaussians", std::count(splats.begin(), splats.end(), uint8_t(0))},
          {"detail_steps", detail ? detail->steps : 0},
          {"detail_seconds", detail ? detail->seconds : 0},
          {"detail_estimated_seconds", detail ? detail->estimated_seconds : 0},
          {"detail_missing", in.views.empty() && !detail && !made.place.cameras.empty()},
          {"ply_step_m", plyStep(gaussians)}};
}

void printCompletion(const Run& run, const CompleteOptions& o, const std::string& stem,
                     ordered_json made) {
  made.update(scaleJson(o.in));
  const double seconds = made["seconds"];
  std::string text =
      joinText(made["views"], " views: ", made["observed_tokens"], " tokens observed, ",
               made["generated_tokens"], " generated; ", made["voxels"], " voxels, ",
               made["gaussians"], " Gaussians, ", made["observed_gaussians"],
               " of them of what was seen; ", std::round(seconds * 10) / 10, " s\n", stem, ".vdb  ",
               stem, ".points.vdb  ", stem, ".ply  ", stem, kLatentEnding);
  if (!o.fromLatents()) text += joinText("  ", stem, kPictureEnding);
  if (made["ply_step_m"] > kFinePlyStep)
    text += joinText("\n", stem, ".ply: its numbers have steps of ", made["ply_step_m"],
                     " m so far from the world's origin; ", stem, ".points.vdb has none");
  if (o.fromLatents() && made["detail_missing"])
    text += joinText("\n", stemOf(o.in.views), ".vdb, ", stemOf(o.in.views), kPointsEnding,
                     ": not both there: what views saw is as coarse as the latents have it");
  if (o.samples > 1)
    text +=
        joinText("\nthe same of ", o.samples - 1, " more with other seeds: ", sampleStem(stem, 2),
                 ".vdb ...; ", stem, kOccupancyEnding);
  printResult(run.json, made, text + scaleLine(o.in));
}

void cookComplete(const CompleteOptions& o, const Run& run, Progress& progress) {
  requireSense(o, run);
  const std::string stem = completionStem(o);
  const std::string weights = weightsFolder(o.in.weights);
  const auto begin = std::chrono::steady_clock::now();
  progress.start("read");
  const Encoder encoder(weights + "/encoder.safetensors");
  const Completer completer(weights + "/completer.safetensors");
  auto [in, all] = readStart(o, encoder, weights, progress);
  const Place start = chooseTokens(o, all, &in.settings.completion);
  std::vector<std::vector<Coord>> samples;
  ordered_json summary;
  for (int n = 1; n <= o.samples; ++n) {
    in.settings.completion.seed = run.seed + uint64_t(n - 1);
    const Made made = cookSample(in, start, encoder, completer, sampleStem(stem, n), o, progress);
    if (n == 1) summary = summaryOf(in, made);
    samples.push_back(made.scene.voxels.ijk);
  }
  if (o.samples > 1) writeOccupancyVdb(all.frame, samples, stem + kOccupancyEnding);
  summary["seconds"] = secondsSince(begin), summary["peak_mb"] = peakMemoryMb();
  summary["output"] = stem;
  printCompletion(run, o, stem, summary);
}

struct RethresholdOptions {
  std::string from, output;
  float tau = 0;
};

void cookRethreshold(const RethresholdOptions& o, const Run& run, Progress& progress) {
  const std::string stem = outputStem(o.output, {});
  if (!endsWith(o.from, ".vdb") || endsWith(o.from, kLatentEnding))
    throw UsageError(joinText("VOLUME: ", o.from, ": expected the X.vdb of a completion"));
  requireOtherName(o.from, ".vdb", stem);
  const Rethresholded r = rethreshold(o.from.substr(0, o.from.size() - 4), o.tau, stem, progress);
  printResult(
      run.json,
      {{"voxels", r.voxels},
       {"gaussians", r.gaussians},
       {"dropped_voxels", r.dropped_voxels},
       {"output", stem}},
      joinText(r.voxels, " voxels, ", r.gaussians, " Gaussians; ", r.dropped_voxels,
               " voxels dropped\n", stem, ".vdb  ", stem, ".points.vdb  ", stem,
               ".ply\nA new run with this tau differs a little: it closes holes anew; the decoder, "
               "and the "
               "completer with --generated-context, look at neighbours that are gone here."));
}

}  // namespace

Verb completeVerb() {
  const auto o = std::make_shared<CompleteOptions>();
  SceneSettings* s = &o->in.settings;
  Option views = viewsOption(&o->in.views);
  views.help += ", or X.latent.vdb to go on from";
  return {"",
          "completes the place that the views show, or one again: another part, with other seeds",
          "examples/two_views -o room.vdb",
          {{"",
            {views,
             option("-o,--output X.vdb", &o->in.output,
                    "to write, with X.points.vdb, X.ply, X.latent.vdb and X.png beside it")
                 .required(),
             framesOption(&o->in.frames), tauOption(&s->completion), marginOption(s),
             weightsOption(&o->in.weights)}},
           {"What was seen", detailOptions(&s->detail)},
           {"Where", volumeOptions(&o->in)},
           {"A part, again, or several times",
            {option("--region MASK.vdb", &o->region, "nothing is generated outside of it")
                 .otherwise("everywhere"),
             option("--lock MASK.vdb", &o->lock,
                    "nothing is generated in it, what X.latent.vdb has there stays"),
             fromLevelOption(&s->completion),
             option("--samples N", &o->samples,
                    "completions, X.vdb, X.2.vdb, ..., with seeds that follow --seed, and "
                    "X.occupancy.vdb")
                 .between(1, 1000),
             flag("--resume", &o->resume,
                  "go on from the last growth level of a run that was cut short")}},
           {"Growth", growthOptions(&s->completion)},
           {"Decoding", {childTauOption(&s->child_threshold), antialiasOption(&s->antialias)}}},
          [o](const Run& run, Progress& progress) { cookComplete(*o, run, progress); }};
}

Verb rethresholdVerb() {
  const auto o = std::make_shared<RethresholdOptions>();
  return {
      "rethreshold",
      "raises tau of a finished place, without the networks",
      "room.vdb --tau 0.4 -o sure.vdb",
      {{"",
        {option("VOLUME", &o->from, "X.vdb, with X.points.vdb beside it"),
         option("--tau P", &o->tau, "generated voxels stay above this probability")
             .between(0, 1)
             .required(),
         option("-o,--output Y.vdb", &o->output, "to write, with Y.points.vdb and Y.ply beside it")
             .required()}}},
      [o](const Run& run, Progress& progress) { cookRethreshold(*o, run, progress); }};
}

}  // namespace vdbc
