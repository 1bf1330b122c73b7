// Between views and latents, latents and grids.
#include <cmath>
#include <filesystem>
#include <memory>
#include <nlohmann/json.hpp>

#include "houdini_style_tools/options.h"
#include "houdini_style_tools/report.h"
#include "houdini_style_tools/verbs.h"

namespace vdbc {
namespace {

using nlohmann::ordered_json;

void cookEncode(const SceneOptions& o, const Run& run, Progress& progress) {
  if (!endsWith(o.output, kLatentEnding) ||
      std::filesystem::path(o.output).filename() == kLatentEnding)
    throw UsageError(
        joinText("--output: ", o.output, ": expected a name that ends in ", kLatentEnding));
  requireCreatable(o.output);
  const std::string weights = weightsFolder(o.weights);
  const auto start = std::chrono::steady_clock::now();
  progress.start("read");
  SceneInput in = readScene(o);
  in.settings.detail.seconds = 0;  // latents alone
  const Encoder encoder(weights + "/encoder.safetensors");
  progress.end();
  const Place place =
      naming(o.views, [&] { return encodeScene(in.views, encoder, in.settings, progress); });
  progress.start("write");
  writeLatentVdb(place, o.output);
  progress.end();
  const double seconds = secondsSince(start);
  ordered_json made = {{"views", in.views.size()},
                       {"tokens", place.size()},
                       {"seconds", seconds},
                       {"output", o.output}};
  made.update(scaleJson(o));
  printResult(run.json, made,
              joinText(in.views.size(), " views: ", place.size(), " tokens; ",
                       std::round(seconds * 10) / 10, " s\n", o.output, scaleLine(o)));
}

struct DecodeOptions {
  std::string latents, output, weights;
  float child_tau = SceneSettings().child_threshold;
  bool antialias = false;
};

void cookDecode(const DecodeOptions& o, const Run& run, Progress& progress) {
  const std::string stem = outputStem(o.output, {});
  const std::string weights = weightsFolder(o.weights) + "/encoder.safetensors";
  const auto start = std::chrono::steady_clock::now();
  progress.start("read");
  const Encoder encoder(weights);
  const Place place = readLatents(o.latents, encoder, weights);
  progress.end();
  progress.start("decode");
  DecodedGrid decoded =
      naming(o.latents, [&] { return encoder.decode(place, o.child_tau, progress); });
  decoded.gaussians.antialias = o.antialias;
  progress.end();
  const Scene scene = sceneOf(decoded, place);
  writeScene(scene, stem, progress);
  const double seconds = secondsSince(start);
  const char* coarse =
      "\nWhat views saw is as coarse as the latents have it; X.points.vdb of the completion has "
      "its "
      "detail.";
  printResult(run.json,
              {{"tokens", place.size()},
               {"voxels", decoded.voxels.size()},
               {"gaussians", decoded.gaussians.size()},
               {"seconds", seconds},
               {"output", stem}},
              joinText(place.size(), " tokens: ", decoded.voxels.size(), " voxels, ",
                       decoded.gaussians.size(), " Gaussians; ", std::round(seconds * 10) / 10,
                       " s\n", stem, ".vdb  ", stem, ".points.vdb  ", stem, ".ply",
                       place.cameras.empty() ? "" : coarse));
}

}  // namespace

Verb encodeVerb() {
  const auto o = std::make_shared<SceneOptions>();
  return {"encode",
          "views as latents in a file, for decode and for the main job",
          "examples/two_views -o room.latent.vdb",
          {{"",
            {viewsOption(&o->views),
             option("-o,--output X.latent.vdb", &o->output, "to write").required(),
             framesOption(&o->frames), marginOption(&o->settings), weightsOption(&o->weights)}},
           {"Where", volumeOptions(o.get())}},
          [o](const Run& run, Progress& progress) { cookEncode(*o, run, progress); }};
}

Verb decodeVerb() {
  const auto o = std::make_shared<DecodeOptions>();
  return {
      "decode",
      "latents as grids and Gaussians",
      "room.latent.vdb -o again.vdb",
      {{"",
        {option("LATENTS", &o->latents, "X.latent.vdb"),
         option("-o,--output Y.vdb", &o->output, "to write, with Y.points.vdb and Y.ply beside it")
             .required(),
         weightsOption(&o->weights), childTauOption(&o->child_tau),
         antialiasOption(&o->antialias)}}},
      [o](const Run& run, Progress& progress) { cookDecode(*o, run, progress); }};
}

}  // namespace vdbc
