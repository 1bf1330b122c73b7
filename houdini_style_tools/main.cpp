// vdb_complete: verbs, options and exit codes.
#include <malloc.h>
#include <tbb/task_arena.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "encoder/encoder_train.h"
#include "houdini_style_tools/blas.h"
#include "houdini_style_tools/checkpoint.h"
#include "houdini_style_tools/complete.h"
#include "houdini_style_tools/console.h"
#include "houdini_style_tools/reconstruct.h"
#include "houdini_style_tools/render.h"
#include "houdini_style_tools/scenes.h"
#include "houdini_style_tools/scores.h"
#include "vdb/latent_vdb.h"
#include "vdb/mask_vdb.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using nlohmann::ordered_json;

// Options, one struct a verb; names as on the command line.
struct Common {
  uint64_t seed = 1;
  int threads = 0;
  bool json = false;
};
struct Complete {
  std::string views, frames, output, weights, region, lock;
  int from_level = 1, samples = 1;
  bool resume = false;
  std::vector<double> up, bounds;
  double scale = 0;
  double margin = VolumeSettings().margin_m;
  double tau = CompleteSettings().tau, coarse_tau = CompleteSettings().coarse_tau;
  double hole_tau = CompleteSettings().hole_tau;
  double child_tau = SceneSettings().child_threshold;
  double temperature = 1;
  int sampling_steps = 0;
  bool generated_context = false, refine_observed = false, antialias = false;
};
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

// "0,3,5-9" -> 0 3 5 6 7 8 9.
std::vector<int> frameList(const std::string& text) {
  std::vector<int> frames;
  std::stringstream parts(text);
  for (std::string part; std::getline(parts, part, ',');) {
    int first = 0, last = 0, used = 0;
    const int found = std::sscanf(part.c_str(), "%d%n-%d%n", &first, &used, &last, &used);
    if (found == 1) last = first;
    if (found < 1 || size_t(used) != part.size() || first < 0 || last < first ||
        last - first > 100000)
      throw UsageError(
          joinText("--frames: ", text, ": expected numbers and ranges such as 0,3,5-9"));
    for (int f = first; f <= last; ++f) frames.push_back(f);
  }
  return frames;
}

std::string executableFolder() {
  std::error_code error;
  const fs::path self = fs::read_symlink("/proc/self/exe", error);
  return error ? "." : self.parent_path().string();
}

// The folder with encoder.safetensors and completer.safetensors.
std::string weightsFolder(const std::string& given) {
  if (!given.empty()) return given;
  for (const char* place : {"/../../weights/small", "/../share/vdb_complete/weights/small"}) {
    const std::string folder = executableFolder() + place;
    if (fs::exists(folder + "/encoder.safetensors")) return fs::weakly_canonical(folder).string();
  }
  throw Error(
      "--weights: no trained weights beside the program (expected weights/small; use --weights "
      "FOLDER)");
}

SceneSettings sceneSettings(const Complete& o, const Common& common, const Eigen::Vector3d& up) {
  SceneSettings s;
  s.volume.up = up;
  s.volume.margin_m = float(o.margin);
  if (!o.bounds.empty()) {
    s.volume.bounds = Eigen::AlignedBox3d(Eigen::Vector3d(o.bounds[0], o.bounds[1], o.bounds[2]),
                                          Eigen::Vector3d(o.bounds[3], o.bounds[4], o.bounds[5]));
    const Eigen::Vector3d sizes = s.volume.bounds->sizes();
    if (!sizes.allFinite() || sizes.minCoeff() <= 0)
      throw UsageError(
          "--bounds: expected a box: x0 y0 z0 x1 y1 z1 with each second corner larger");
  }
  s.completion.tau = float(o.tau), s.completion.coarse_tau = float(o.coarse_tau);
  s.completion.hole_tau = float(o.hole_tau);
  s.child_threshold = float(o.child_tau);
  s.completion.sampling_steps = o.sampling_steps, s.completion.temperature = o.temperature;
  s.completion.generated_context = o.generated_context;
  s.completion.refine_observed = o.refine_observed;
  s.completion.seed = common.seed;
  return s;
}

Eigen::Vector3d upOf(const std::vector<double>& given) {
  const Eigen::Vector3d up(given[0], given[1], given[2]);
  if (!up.allFinite() || up.norm() < 1e-6)
    throw UsageError("--up: expected a finite vector that is not zero");
  return up.normalized();
}

// Code that only knows the views cannot say in an Error where they are from.
template <typename Function>
auto naming(const std::string& source, const Function& function) {
  try {
    return function();
  } catch (const Error& e) {
    throw Error(joinText(source, ": ", e.what()));
  }
}

ReadViewsSettings reading(const std::string& frames, double scale) {
  ReadViewsSettings settings;
  settings.frames = frameList(frames), settings.metres_per_unit = scale;
  return settings;
}

Eigen::Vector3d upOf(const Complete& o) {
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
  const Eigen::Vector3d up = upOf(o);
  return {std::move(views), up, sceneSettings(o, common, up)};
}

bool endsWith(const std::string& text, const std::string& ending) {
  return text.size() >= ending.size() &&
         text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

// Latents that this encoder made, of a place that it could have seen.
LatentFile readLatents(const std::string& path, const Encoder& encoder,
                       const std::string& weights) {
  constexpr int64_t kMaxVoxels = int64_t(1) << 30;
  LatentFile file = readLatentVdb(path);
  require(file.encoder_hash == encoder.hash(), path, ": expected the weights ", file.encoder_hash,
          " that made it, found ", encoder.hash(), " in ", weights, " (use --weights)");
  require(file.growth.empty(), path,
          ": is a completion that was cut short (expected a finished one; --resume goes on)");
  const VoxelFrame& frame = file.latents.frame;
  const Coord size = frame.bounds.dim();
  bool whole = true;  // nodes of all levels
  for (int axis = 0; axis < 3; ++axis)
    whole = whole && frame.bounds.min()[axis] % 4 == 0 && size[axis] % 4 == 0;
  require(frame.voxel_m == encoder.config().voxel_m && whole &&
              int64_t(size.x()) * size.y() * size.z() <= kMaxVoxels,
          path, ": expected voxels of ", encoder.config().voxel_m,
          " m and a volume of whole nodes and at most ", kMaxVoxels, " voxels, found ",
          frame.voxel_m, " m and ", frame.bounds);
  return file;
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

// One completion from encoded tokens to files, checkpointed on the way.
Completion cookSample(const SceneInput& in, LatentGrid start, const ObservedSpace& space,
                      const Encoder& encoder, const Completer& completer, const std::string& stem,
                      const Complete& o, Progress& progress) {
  SceneSettings settings = in.settings;
  const std::string checkpoint = checkpointOf(stem);
  const std::string identity = completionIdentity(completer, start, settings.completion);
  if (o.resume && fs::exists(checkpoint))
    readCheckpoint(checkpoint, encoder.hash(), identity, &start, &settings.completion);
  Completion c = naming(o.views, [&] {
    return completeLatents(start, space, encoder, completer, settings, progress,
                           [&](const LatentGrid& so_far, int32_t next_level) {
                             writeCheckpoint(so_far, next_level, space, encoder.hash(), identity,
                                             checkpoint);
                           });
  });
  for (DecodedGrid* d : {&c.seen_decoded, &c.whole_decoded}) d->gaussians.antialias = o.antialias;
  writeCompletion(in.views, c, encoder.hash(), stem, in.up, progress);
  fs::remove(checkpoint);
  return c;
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
  const LatentFile encoded = [&]() -> LatentFile {
    if (from_latents) {
      LatentFile file = readLatents(o.views, encoder, weights);
      in = {{},
            file.latents.frame.world_from_grid.linear().col(2),
            sceneSettings(o, common, Eigen::Vector3d::UnitZ())};
      progress.end();
      return file;
    }
    in = readScene(o, common, chosen);
    progress.end();
    const Encoding e =
        naming(o.views, [&] { return encodeScene(in.views, encoder, in.settings, progress); });
    return {e.latents, e.observation.space, encoder.hash(), ""};
  }();
  const LatentGrid& all = encoded.latents;
  require(o.from_level == 1 ||
              std::count(all.bfs_level.begin(), all.bfs_level.end(), o.from_level - 1) > 0,
          "--from-level: ", o.views, ": expected tokens of growth level ", o.from_level - 1,
          ", found none");
  TokenMask locked;
  if (!o.lock.empty()) locked.topologyUnion(readTokenMask(o.lock, all.frame, 1));
  const LatentGrid start = keepTokens(all, [&](size_t i) {
    return all.observed[i] || all.bfs_level[i] < o.from_level || locked.isValueOn(all.ijk[i]);
  });
  in.settings.completion.first_level = o.from_level;
  in.settings.completion.region = allowedTokens(o, all.frame, locked);

  std::vector<std::vector<Coord>> samples;
  ordered_json made;
  for (int n = 1; n <= o.samples; ++n) {
    const Completion c =
        cookSample(in, start, encoded.seen, encoder, completer, sampleStem(stem, n), o, progress);
    if (n == 1)
      made = {{"views", in.views.size()},
              {"observed_tokens", c.seen.size()},
              {"generated_tokens", c.whole.size() - c.seen.size()},
              {"voxels", c.whole_decoded.voxels.size()},
              {"gaussians", c.whole_decoded.gaussians.size()}};
    samples.push_back(c.whole_decoded.voxels);
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
  const Encoding e =
      naming(o.views, [&] { return encodeScene(in.views, encoder, in.settings, progress); });
  progress.start("write");
  writeLatentVdb({e.latents, e.observation.space, encoder.hash(), ""}, o.output);
  progress.end();
  const double seconds = secondsSince(start);
  printSummary(common.json,
               {{"views", in.views.size()},
                {"tokens", e.latents.size()},
                {"seconds", seconds},
                {"output", o.output}},
               joinText(in.views.size(), " views: ", e.latents.size(), " tokens; ",
                        std::round(seconds * 10) / 10, " s\n", o.output),
               scaleJson(o));
}

void cookDecode(const Decode& o, const Common& common, Progress& progress) {
  const std::string stem = outputStem(o.output, {});
  const std::string weights = weightsFolder(o.weights) + "/encoder.safetensors";
  const auto start = std::chrono::steady_clock::now();
  progress.start("read");
  const Encoder encoder(weights);
  const LatentFile file =
      naming("decode", [&] { return readLatents(o.latents, encoder, weights); });
  progress.end();
  progress.start("decode");
  DecodedGrid decoded = naming(o.latents, [&] {
    return encoder.decode(file.latents, file.seen, float(o.child_tau), progress);
  });
  decoded.gaussians.antialias = o.antialias;
  progress.end();
  writeDecoded(decoded, file.latents, file.seen, stem, progress);
  const double seconds = secondsSince(start);
  printSummary(common.json,
               {{"tokens", file.latents.size()},
                {"voxels", decoded.voxels.size()},
                {"gaussians", decoded.gaussians.size()},
                {"seconds", seconds},
                {"output", stem}},
               joinText(file.latents.size(), " tokens: ", decoded.voxels.size(), " voxels, ",
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

// CLI::Range lets NaN pass.
struct Between : CLI::Range {
  Between(double low, double high) : Range(low, high) {
    func_ = [low, high](std::string& text) {
      double value = 0;
      if (CLI::detail::lexical_cast(text, value) && value >= low && value <= high)
        return std::string();
      return joinText("expected ", low, " to ", high, ", found ", text);
    };
  }
};

void addCommon(CLI::App* app, Common* c) {
  app->add_option("--seed", c->seed, "fixes every random choice")->capture_default_str();
  app->add_option("--threads", c->threads, "worker threads, 0 = all cores")
      ->envname("VDB_COMPLETE_THREADS")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  app->add_flag("--json", c->json,
                "results (stdout) and progress (stderr) as JSON, one object a line");
}

void addScale(CLI::App* app, double* scale) {
  app->add_option("--scale", *scale, "metres per unit of an .npz [from its camera baseline]")
      ->check(Between(1e-6, 1e6));
}

void addMargin(CLI::App* app, Complete* o) {
  app->add_option("--margin", o->margin, "room around what was seen [m]")
      ->check(Between(0, 100))
      ->capture_default_str();
}

void addChildTau(CLI::App* app, double* child_tau) {
  app->add_option("--child-tau", *child_tau,
                  "a voxel of a kept token is kept above this probability")
      ->check(Between(0, 1))
      ->capture_default_str();
}

void addAntialias(CLI::App* app, bool* antialias) {
  app->add_flag("--antialias", *antialias,
                "splats are for an opacity-compensated low pass; the files say so");
}

void addWeights(CLI::App* app, std::string* weights) {
  app->add_option("--weights", *weights,
                  "folder with encoder.safetensors and completer.safetensors");
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

void addCompletion(CLI::App* app, Complete* o) {
  addMargin(app, o);
  app->add_option("--tau", o->tau, "a token is kept above this probability")
      ->check(Between(0, 1))
      ->capture_default_str();
  app->add_option("--coarse-tau", o->coarse_tau, "the same for the coarse gate")
      ->check(Between(0, 1))
      ->capture_default_str();
  app->add_option(
         "--hole-tau", o->hole_tau,
         "above this probability dropped tokens are taken back where they close a hole, 1 = none")
      ->check(Between(0, 1))
      ->capture_default_str();
  addChildTau(app, &o->child_tau);
  app->add_option("--sampling-steps", o->sampling_steps, "diffusion steps, 0 = the linear mean")
      ->check(CLI::Range(0, 1000))
      ->capture_default_str();
  app->add_option("--temperature", o->temperature, "of the diffusion head")
      ->check(Between(0, 10))
      ->capture_default_str();
  app->add_flag("--generated-context", o->generated_context,
                "generated tokens are context of later levels, as in the paper");
  app->add_flag("--refine-observed", o->refine_observed,
                "let the completer rewrite observed latents");
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

int run(int argc, char** argv) {
  CLI::App app{
      "Completes a place seen in a few RGB-D views as OpenVDB grids and 3-D Gaussians.\n"
      "Without a verb: vdb_complete VIEWS -o X.vdb writes X.vdb, X.points.vdb, X.ply, X.latent.vdb "
      "and X.png.",
      "vdb_complete"};
  app.set_version_flag("--version", VDBC_VERSION);
  Common common;
  Complete complete, encode, eval_options;
  Decode decode;
  Rethreshold rethreshold;
  Render render;
  Check check;
  Evaluate evaluate;
  Train train;
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
  for (CLI::App* verb : {info, verb_encode, verb_decode, verb_rethreshold, verb_render, verb_check,
                         verb_eval, train_encoder, train_mar})
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
    } else if (verb_eval->parsed()) {
      (evaluate.reconstruct ? cookReconstruct : cookEvaluate)(evaluate, eval_options, common,
                                                              console);
    } else if (train_encoder->parsed()) {
      cookTrainEncoder(train, common, console);
    } else if (train_mar->parsed()) {
      cookTrainMar(train, common, console);
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

int main(int argc, char** argv) {
  vdbc::setUpProcess();
  // Tensors of some megabytes come and go: keep their pages instead of asking the kernel each time.
  mallopt(M_MMAP_THRESHOLD, 1 << 30);
  mallopt(M_TRIM_THRESHOLD, 1 << 30);
  try {
    const int code = vdbc::run(argc, argv);
    vdbc::require(std::fflush(stdout) == 0, "standard output: cannot write the results");
    return code;
  } catch (const vdbc::Cancelled&) {
    std::fprintf(stderr, "vdb_complete: interrupted\n");
    return 130;
  } catch (const vdbc::UsageError& e) {
    std::fprintf(stderr, "vdb_complete: %s\n", e.what());
    return 2;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "vdb_complete: %s\n", vdbc::firstLine(e).c_str());
    return 1;
  }
}
