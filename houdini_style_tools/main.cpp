// vdb_complete: verbs, options and exit codes.
#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "encoder/views/read_views.h"
#include "houdini_style_tools/blas.h"
#include "houdini_style_tools/checkpoint.h"
#include "houdini_style_tools/complete.h"
#include "houdini_style_tools/console.h"
#include "houdini_style_tools/options.h"
#include "houdini_style_tools/render.h"
#include "splat/rays.h"
#include "vdb/latent_vdb.h"
#include "vdb/mask_vdb.h"
#include "vdb/process.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

using nlohmann::ordered_json;

struct Render {
  RenderSettings settings;
  std::string frames;
  std::vector<int> size;
  std::vector<double> up;
};
struct Rethreshold {
  std::string from, output;
  double tau = 0;
};
struct Decode {
  std::string latents, output, weights;
  double child_tau = SceneSettings().child_threshold;
  bool antialias = false;
};
struct Check {
  std::string views, frames, volume;
  double scale = 0;
};
ReadViewsSettings reading(const std::string& frames, double scale) {
  ReadViewsSettings settings;
  settings.frames = frameList(frames), settings.metres_per_unit = scale;
  return settings;
}

Eigen::Vector3d sceneUp(const Complete& o) {
  return o.up.empty() ? conventionalUp(o.views) : upOf(o.up);
}

// Where the size of pointmaps is from; for other views {}.
ordered_json scaleJson(const Complete& o) {
  if (fs::path(o.views).extension() != ".npz") return ordered_json::object();
  const PointmapScale s = pointmapScale(o.views, o.scale);
  return {{"metres_per_unit", s.metres_per_unit}, {"scale_from", s.source}};
}

// One object on stdout, or `text` and the pointmaps' scale.
void printSummary(bool json, ordered_json summary, const std::string& text,
                  const ordered_json& scale = ordered_json::object()) {
  summary.update(scale);
  if (json)
    std::printf("%s\n", summary.dump().c_str());
  else if (scale.empty())
    std::printf("%s\n", text.c_str());
  else
    std::printf("%s\n%g metres per unit of the pointmaps (%s)\n", text.c_str(),
                scale["metres_per_unit"].get<double>(),
                scale["scale_from"].get<std::string>().c_str());
}

// What completing and encoding start from.
struct SceneInput {
  std::vector<View> views;
  Eigen::Vector3d up;
  SceneSettings settings;
};

SceneInput readScene(const Complete& o, const Common& common, const ReadViewsSettings& chosen) {
  std::vector<View> views = readViews(o.views, chosen);
  const Eigen::Vector3d up = sceneUp(o);
  return {std::move(views), up, sceneSettings(o, common, up)};
}

bool endsWith(const std::string& text, const std::string& ending) {
  return text.size() >= ending.size() &&
         text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

// Latents that this encoder made, of a place that it could have seen.
Place readLatents(const std::string& path, const Encoder& encoder, const std::string& weights) {
  Place place = readLatentVdb(path);
  require(place.encoder_hash == encoder.hash(), path, ": expected the weights ", place.encoder_hash,
          " that made it, found ", encoder.hash(), " in ", weights, " (use --weights)");
  require(place.growth.empty(), path,
          ": is a completion that was cut short (expected a finished one; --resume goes on)");
  const VoxelFrame& frame = place.frame;
  const Coord size = frame.bounds.dim();
  bool whole = true;  // nodes of all levels
  for (int axis = 0; axis < 3; ++axis)
    whole = whole && frame.bounds.min()[axis] % 4 == 0 && size[axis] % 4 == 0;
  require(frame.voxel_m == encoder.config().voxel_m && whole, path, ": expected voxels of ",
          encoder.config().voxel_m, " m and a volume of whole nodes, found ", frame.voxel_m,
          " m and ", frame.bounds);
  return place;
}

// Results would lie over what they were made of.
void requireOtherName(const std::string& from, const std::string& ending, const std::string& stem) {
  std::error_code none;
  if (endsWith(from, ending) &&
      fs::weakly_canonical(from, none) == fs::weakly_canonical(stem + ending, none))
    throw UsageError(
        joinText("--output: ", stem, ".vdb: expected another name than that of ", from));
}

// Tokens that may be generated: those of --region, less those of --lock; null: all.
std::shared_ptr<const TokenMask> allowedTokens(const Complete& o, const VoxelFrame& frame,
                                               const TokenMask& locked) {
  if (o.region.empty() && o.lock.empty()) return nullptr;
  auto allowed = std::make_shared<TokenMask>();
  if (o.region.empty())
    allowed->sparseFill(
        CoordBBox(tokenCoord(frame.bounds.min(), 1), tokenCoord(frame.bounds.max(), 1)), true,
        true);
  else
    allowed->topologyUnion(readTokenMask(o.region, frame, 1));
  allowed->topologyDifference(locked);
  return allowed;
}

constexpr const char* kOccupancyEnding = ".occupancy.vdb";

// The n-th of several completions: X.vdb, X.2.vdb, X.3.vdb.
std::string sampleStem(const std::string& stem, int n) {
  return n == 1 ? stem : joinText(stem, ".", n);
}

std::string checkpointOf(const std::string& stem) { return stem + ".checkpoint" + kLatentEnding; }

// What a completion made.
struct Made {
  Place place;
  DecodedGrid decoded;
};

// One completion from encoded tokens to files, checkpointed on the way.
Made cookSample(const SceneInput& in, Place start, const Encoder& encoder,
                const Completer& completer, const std::string& stem, const Complete& o,
                Progress& progress) {
  CompleteSettings settings = in.settings.completion;
  const std::string checkpoint = checkpointOf(stem);
  const std::string identity = completionIdentity(completer, start, settings);
  if (o.resume && fs::exists(checkpoint)) readCheckpoint(checkpoint, identity, &start, &settings);
  return naming(o.views, [&] {
    Made made;
    made.place =
        completer.complete(start, settings, progress, [&](const Place& so_far, int32_t next_level) {
          writeCheckpoint(so_far, next_level, identity, checkpoint);
        });
    made.decoded = writePlace(made.place, in.views, encoder, in.settings, stem, progress);
    fs::remove(checkpoint);
    return made;
  });
}

// The output's stem, once all names can be written and what is to be resumed is there.
std::string completionStem(const Complete& o, bool from_latents) {
  const std::vector<std::string> more =
      from_latents ? std::vector<std::string>{kLatentEnding}
                   : std::vector<std::string>{kLatentEnding, kPictureEnding};
  const std::string stem = outputStem(o.output, more);
  for (int n = 2; n <= o.samples; ++n) outputStem(sampleStem(stem, n) + ".vdb", more);
  if (o.samples > 1) requireCreatable(stem + kOccupancyEnding);
  requireOtherName(o.views, kLatentEnding, stem);
  bool begun = !o.resume;
  for (int n = 1; n <= o.samples; ++n)
    begun = begun || fs::exists(checkpointOf(sampleStem(stem, n)));
  require(begun, "--resume: ", checkpointOf(stem),
          ": no such file (expected a run that was cut short)");
  return stem;
}

void cookComplete(const Complete& o, const Common& common, Progress& progress) {
  const bool from_latents = endsWith(o.views, kLatentEnding);
  const ReadViewsSettings chosen = reading(o.frames, o.scale);
  const std::string stem = completionStem(o, from_latents);
  const std::string weights = weightsFolder(o.weights);
  const auto begin = std::chrono::steady_clock::now();
  progress.start("read");
  const Encoder encoder(weights + "/encoder.safetensors");
  const Completer completer(weights + "/completer.safetensors");
  SceneInput in;
  const Place all = [&] {
    if (from_latents) {
      Place place = readLatents(o.views, encoder, weights);
      in = {{},
            place.frame.world_from_grid.linear().col(2),
            sceneSettings(o, common, Eigen::Vector3d::UnitZ())};
      progress.end();
      return place;
    }
    in = readScene(o, common, chosen);
    progress.end();
    return naming(o.views, [&] { return encodeScene(in.views, encoder, in.settings, progress); });
  }();
  require(o.from_level == 1 ||
              std::count(all.bfs_level.begin(), all.bfs_level.end(), o.from_level - 1) > 0,
          "--from-level: ", o.views, ": expected tokens of growth level ", o.from_level - 1,
          ", found none");
  TokenMask locked;
  if (!o.lock.empty()) locked.topologyUnion(readTokenMask(o.lock, all.frame, 1));
  const Place start = keepRows(all, [&](size_t i) {
    return !all.generated[i] || all.bfs_level[i] < o.from_level || locked.isValueOn(all.ijk[i]);
  });
  in.settings.completion.first_level = o.from_level;
  in.settings.completion.region = allowedTokens(o, all.frame, locked);

  std::vector<std::vector<Coord>> samples;
  ordered_json made;
  for (int n = 1; n <= o.samples; ++n) {
    const Made sample = cookSample(in, start, encoder, completer, sampleStem(stem, n), o, progress);
    const auto& generated = sample.place.generated;
    const auto observed = std::count(generated.begin(), generated.end(), uint8_t(0));
    if (n == 1)
      made = {{"views", in.views.size()},
              {"observed_tokens", observed},
              {"generated_tokens", sample.place.size() - observed},
              {"voxels", sample.decoded.voxels.size()},
              {"gaussians", sample.decoded.gaussians.size()}};
    samples.push_back(sample.decoded.voxels);
    ++in.settings.completion.seed;
  }
  if (o.samples > 1) writeOccupancyVdb(all.frame, samples, stem + kOccupancyEnding);
  const double seconds = secondsSince(begin);
  made["seconds"] = seconds, made["peak_mb"] = peakMemoryMb(), made["output"] = stem;
  std::string files =
      joinText(stem, ".vdb  ", stem, ".points.vdb  ", stem, ".ply  ", stem, kLatentEnding);
  if (!from_latents) files += joinText("  ", stem, kPictureEnding);
  if (o.samples > 1)
    files +=
        joinText("\nthe same of ", o.samples - 1, " more with other seeds: ", sampleStem(stem, 2),
                 ".vdb ...; ", stem, kOccupancyEnding);
  printSummary(common.json, made,
               joinText(made["views"].dump(), " views: ", made["observed_tokens"].dump(),
                        " tokens observed, ", made["generated_tokens"].dump(), " generated; ",
                        made["voxels"].dump(), " voxels, ", made["gaussians"].dump(),
                        " Gaussians; ", std::round(seconds * 10) / 10, " s\n", files),
               scaleJson(o));
}

void cookRethreshold(const Rethreshold& o, const Common& common, Progress& progress) {
  const std::string stem = outputStem(o.output, {});
  if (!endsWith(o.from, ".vdb") || endsWith(o.from, kLatentEnding))
    throw UsageError(joinText("VOLUME: ", o.from, ": expected the X.vdb of a completion"));
  requireOtherName(o.from, ".vdb", stem);
  const Rethresholded r =
      rethreshold(o.from.substr(0, o.from.size() - 4), float(o.tau), stem, progress);
  printSummary(
      common.json,
      {{"voxels", r.voxels},
       {"gaussians", r.gaussians},
       {"dropped_voxels", r.dropped_voxels},
       {"output", stem}},
      joinText(r.voxels, " voxels, ", r.gaussians, " Gaussians; ", r.dropped_voxels,
               " voxels dropped\n", stem, ".vdb  ", stem, ".points.vdb  ", stem,
               ".ply\nA new run with this tau differs a little: the decoder, and the "
               "completer with --generated-context, look at neighbours that are gone here."));
}

void cookEncode(const Complete& o, const Common& common, Progress& progress) {
  if (!endsWith(o.output, kLatentEnding) || fs::path(o.output).filename() == kLatentEnding)
    throw UsageError(
        joinText("--output: ", o.output, ": expected a name that ends in ", kLatentEnding));
  const ReadViewsSettings chosen = reading(o.frames, o.scale);
  requireCreatable(o.output);
  const std::string weights = weightsFolder(o.weights);
  const auto start = std::chrono::steady_clock::now();
  progress.start("read");
  const SceneInput in = readScene(o, common, chosen);
  const Encoder encoder(weights + "/encoder.safetensors");
  progress.end();
  const Place place =
      naming(o.views, [&] { return encodeScene(in.views, encoder, in.settings, progress); });
  progress.start("write");
  writeLatentVdb(place, o.output);
  progress.end();
  const double seconds = secondsSince(start);
  printSummary(common.json,
               {{"views", in.views.size()},
                {"tokens", place.size()},
                {"seconds", seconds},
                {"output", o.output}},
               joinText(in.views.size(), " views: ", place.size(), " tokens; ",
                        std::round(seconds * 10) / 10, " s\n", o.output),
               scaleJson(o));
}

void cookDecode(const Decode& o, const Common& common, Progress& progress) {
  const std::string stem = outputStem(o.output, {});
  const std::string weights = weightsFolder(o.weights) + "/encoder.safetensors";
  const auto start = std::chrono::steady_clock::now();
  progress.start("read");
  const Encoder encoder(weights);
  const Place place = naming("decode", [&] { return readLatents(o.latents, encoder, weights); });
  progress.end();
  progress.start("decode");
  DecodedGrid decoded =
      naming(o.latents, [&] { return encoder.decode(place, float(o.child_tau), progress); });
  decoded.gaussians.antialias = o.antialias;
  progress.end();
  writeDecoded(decoded, place, stem, progress);
  const double seconds = secondsSince(start);
  printSummary(common.json,
               {{"tokens", place.size()},
                {"voxels", decoded.voxels.size()},
                {"gaussians", decoded.gaussians.size()},
                {"seconds", seconds},
                {"output", stem}},
               joinText(place.size(), " tokens: ", decoded.voxels.size(), " voxels, ",
                        decoded.gaussians.size(), " Gaussians; ", std::round(seconds * 10) / 10,
                        " s\n", stem, ".vdb  ", stem, ".points.vdb  ", stem, ".ply"));
}

void cookInfo(const Common& common) {
  const BlasInfo blas = blasInfo(true);
  ordered_json j{{"version", VDBC_VERSION},
                 {"blas", blas.library},
                 {"core", blas.core},
                 {"blas_threads", blas.threads},
                 {"threads", tbb::this_task_arena::max_concurrency()},
                 {"gflops", blas.gflops}};
  std::string weights;
  try {
    weights = weightsFolder("");
  } catch (const Error&) {
  }
  if (!weights.empty()) {
    const Encoder encoder(weights + "/encoder.safetensors");
    const Completer completer(weights + "/completer.safetensors");
    j["weights"] = weights;
    j["encoder"] = {{"preset", encoder.config().preset},
                    {"hash", encoder.hash()},
                    {"trained_on", encoder.trainedOn()}};
    j["completer"] = {{"preset", completer.config().preset},
                      {"hash", completer.hash()},
                      {"trained_on", completer.trainedOn()}};
  }
  if (common.json) {
    std::printf("%s\n", j.dump().c_str());
    return;
  }
  for (const auto& [key, value] : j.items())
    std::printf("%-13s %s\n", key.c_str(),
                value.is_string() ? value.get<std::string>().c_str() : value.dump().c_str());
}

void cookRender(const Render& o, const Common& common, Progress& progress) {
  RenderSettings s = o.settings;
  s.frames = frameList(o.frames);
  if (!o.size.empty()) s.width = o.size[0], s.height = o.size[1];
  if (!o.up.empty()) s.up = upOf(o.up);
  int count = 0;
  std::string last;
  renderFrames(
      s,
      [&](const RenderedFrame& f) {
        ++count, last = f.image;
        if (!common.json) return;
        ordered_json j{{"frame", f.number}, {"image", f.image}};
        if (!f.preview.empty()) j["preview"] = f.preview;
        if (!f.view.empty()) j["view"] = f.view;
        std::printf("%s\n", j.dump().c_str());
        std::fflush(stdout);
      },
      progress);
  if (!common.json)
    std::printf("%d frame%s: %s\n", count, count == 1 ? "" : "s, the last one", last.c_str());
}

void cookCheck(const Check& o, const Common& common) {
  const std::vector<View> views = readViews(o.views, reading(o.frames, o.scale));
  const SceneVoxels voxels = readSceneVdb(o.volume);
  const RayTarget target = RayTarget::fromVoxels(voxels.frame, voxels.ijk);
  const DepthAgreement a = depthAgreement(target, views, 2 * voxels.frame.voxel_m);
  std::vector<Eigen::Vector3f> origins;
  for (const View& v : views)
    origins.push_back(v.camera.world_from_camera.translation().cast<float>());
  const double open = openShare(target, origins, 16384, common.seed);
  const ordered_json j{{"voxels", voxels.ijk.size()},
                       {"rays", a.rays},
                       {"median_depth_error_m", a.median_error_m},
                       {"within_two_voxels", a.within_share},
                       {"missed", a.miss_share},
                       {"open_directions", open}};
  if (common.json) {
    std::printf("%s\n", j.dump().c_str());
  } else {
    for (const auto& [key, value] : j.items())
      std::printf("%-21s %s\n", key.c_str(), value.dump().c_str());
  }
}

void addAntialias(CLI::App* app, bool* antialias) {
  app->add_flag("--antialias", *antialias,
                "splats are for an opacity-compensated low pass; the files say so");
}

// What the main job and encode take.
void addViews(CLI::App* app, Complete* o, const char* output) {
  const bool required = app->get_parent() != nullptr;  // a verb may stand in for the main job's
  app->add_option("VIEWS", o->views,
                  "folder with transforms.json, a transforms.json, EXR file(s) with Z or P, "
                  "pointmaps (.npz), a level set or "
                  "fog volume (.vdb), or, to complete, X.latent.vdb")
      ->required(required);
  app->add_option("--frames", o->frames, "which of the views, 0,3,5-9 say [all]");
  app->add_option("-o,--output", o->output, output)->required(required);
  addWeights(app, &o->weights);
  app->add_option("--up", o->up, "x y z that points up in the world [the format's]")->expected(3);
  app->add_option("--bounds", o->bounds, "x0 y0 z0 x1 y1 z1 to complete [seen and margin]")
      ->expected(6);
  addScale(app, &o->scale);
}

// Completing a part, again, or several times.
void addContinuation(CLI::App* app, Complete* o) {
  app->add_option("--region", o->region,
                  "MASK.vdb: nothing is generated outside of it [everywhere]");
  app->add_option("--lock", o->lock,
                  "MASK.vdb: nothing is generated in it, what X.latent.vdb has there stays");
  auto* from_level =
      app->add_option("--from-level", o->from_level,
                      "with X.latent.vdb: growth levels below stay, the rest is made anew")
          ->check(CLI::Range(1, 1 << 20))
          ->capture_default_str();
  auto* samples =
      app->add_option(
             "--samples", o->samples,
             "completions, X.vdb, X.2.vdb, ..., with seeds that follow --seed, and X.occupancy.vdb")
          ->check(CLI::Range(1, 1000))
          ->capture_default_str();
  app->add_flag("--resume", o->resume,
                "go on from the last growth level of a run that was cut short");
  app->callback([=] {
    const bool latents = endsWith(o->views, kLatentEnding);
    for (const char* of_views : {"--frames", "--up", "--bounds", "--margin", "--scale"})
      if (latents && app->count(of_views))
        throw UsageError(joinText(of_views, ": expected views, found latents: ", o->views));
    if (from_level->count() && !latents)
      throw UsageError("--from-level: expected X.latent.vdb of a completion instead of views");
    if (samples->count() && o->samples > 1 &&
        !(o->sampling_steps > 0 && o->temperature > 0 && o->generated_context))
      throw UsageError(
          "--samples: expected --sampling-steps and --generated-context (and a temperature): "
          "without them all "
          "completions have the same occupancy");
  });
}

void addRender(CLI::App* verb, Render* o) {
  RenderSettings& s = o->settings;
  verb->add_option("SPLATS", s.splats, ".ply or .points.vdb")->required();
  verb->add_option("--cameras", s.cameras, "views whose cameras to take");
  addScale(verb, &s.scale);
  verb->add_option("--turntable", s.turntable, "frames of a turn around the splats")
      ->check(CLI::Range(1, 100000));
  verb->add_option("--flythrough", s.flythrough, "frames of a smooth flight through the --cameras")
      ->check(CLI::Range(1, 100000));
  verb->add_option("--frames", o->frames, "numbers of the frames to render, 0,3,5-9 say [all]");
  auto* width =
      verb->add_option("--width", s.width, "pixels, in the view's proportion [the view's]")
          ->check(CLI::Range(1, 16384));
  verb->add_option("--size", o->size,
                   "width and height in pixels [the view's; 960 540 for a turntable]")
      ->expected(2)
      ->check(CLI::Range(1, 16384))
      ->excludes(width);
  verb->add_option("--fov", s.fov_degrees,
                   "field of view across, degrees [the view's; 60 for a turntable]")
      ->check(Between(1, 170));
  verb->add_option("--up", o->up, "x y z that points up: axis of the turntable [0 0 1]")
      ->expected(3);
  verb->add_flag("--antialias,!--no-antialias", s.antialias,
                 "opacity-compensated low pass [as the file says]");
  verb->add_flag("--preview", s.preview, "a .png beside each .exr");
  verb->add_option("-o,--output", s.output,
                   "folder for 0000.png, ..., or a name with #### ending in .png or .exr")
      ->required();
}

int run(int argc, char** argv) {
  CLI::App app{
      "Completes a place seen in a few RGB-D views as OpenVDB grids and 3-D Gaussians.\n"
      "Without a verb: vdb_complete VIEWS -o X.vdb writes X.vdb, X.points.vdb, X.ply, X.latent.vdb "
      "and X.png.",
      "vdb_complete"};
  app.set_version_flag("--version", VDBC_VERSION);
  Common common;
  Complete complete, encode;
  Decode decode;
  Rethreshold rethreshold;
  Render render;
  Check check;
  app.require_subcommand(0, 1);

  addCommon(&app, &common);
  addViews(&app, &complete,
           "X.vdb to write, with X.points.vdb, X.ply, X.latent.vdb and X.png beside it");
  addAntialias(&app, &complete.antialias);
  addCompletion(&app, &complete);
  addContinuation(&app, &complete);

  CLI::App* info = app.add_subcommand("info", "BLAS, threads, speed and weights");
  CLI::App* verb_encode =
      app.add_subcommand("encode", "views as latents: a .latent.vdb for decode");
  addViews(verb_encode, &encode, "X.latent.vdb to write");
  addMargin(verb_encode, &encode);
  CLI::App* verb_decode = app.add_subcommand("decode", "latents as grids and Gaussians");
  verb_decode->add_option("LATENTS", decode.latents, "X.latent.vdb")->required();
  verb_decode
      ->add_option("-o,--output", decode.output,
                   "Y.vdb to write, with Y.points.vdb and Y.ply beside it")
      ->required();
  addWeights(verb_decode, &decode.weights);
  addChildTau(verb_decode, &decode.child_tau);
  addAntialias(verb_decode, &decode.antialias);
  CLI::App* verb_rethreshold =
      app.add_subcommand("rethreshold", "raises tau of a finished place, without the networks");
  verb_rethreshold->add_option("VOLUME", rethreshold.from, "X.vdb, with X.points.vdb beside it")
      ->required();
  verb_rethreshold
      ->add_option("--tau", rethreshold.tau, "generated voxels stay above this probability")
      ->check(Between(0, 1))
      ->required();
  verb_rethreshold
      ->add_option("-o,--output", rethreshold.output,
                   "Y.vdb to write, with Y.points.vdb and Y.ply beside it")
      ->required();
  CLI::App* verb_render = app.add_subcommand(
      "render", "Gaussians as pictures: from given cameras, around them or along a flight");
  addRender(verb_render, &render);
  CLI::App* verb_check =
      app.add_subcommand("check", "depth agreement and open directions, by Embree");
  verb_check->add_option("VIEWS", check.views, "views to compare with")->required();
  verb_check->add_option("VOLUME", check.volume, "X.vdb")->required();
  verb_check->add_option("--frames", check.frames, "which of the views [all]");
  addScale(verb_check, &check.scale);
  for (CLI::App* verb : {info, verb_encode, verb_decode, verb_rethreshold, verb_render, verb_check})
    addCommon(verb, &common);

  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    if (e.get_exit_code() == 0) return app.exit(e);  // --help, --version
    throw UsageError(joinText(e.what(), " (vdb_complete --help)"));
  }
  Console console(common.json);
  withThreads(common.threads, [&] {
    if (info->parsed()) {
      cookInfo(common);
    } else if (verb_encode->parsed()) {
      cookEncode(encode, common, console);
    } else if (verb_decode->parsed()) {
      cookDecode(decode, common, console);
    } else if (verb_rethreshold->parsed()) {
      cookRethreshold(rethreshold, common, console);
    } else if (verb_render->parsed()) {
      cookRender(render, common, console);
    } else if (verb_check->parsed()) {
      cookCheck(check, common);
    } else if (complete.views.empty() || complete.output.empty()) {
      throw UsageError("expected VIEWS and -o X.vdb, or a verb (vdb_complete --help)");
    } else {
      cookComplete(complete, common, console);
    }
  });
  return 0;
}

}  // namespace
}  // namespace vdbc

int main(int argc, char** argv) { return vdbc::runProgram("vdb_complete", vdbc::run, argc, argv); }
