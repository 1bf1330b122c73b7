// Looking at what was made, and at the program itself.
#include <tbb/task_arena.h>

#include <memory>
#include <nlohmann/json.hpp>

#include "houdini_style_tools/blas.h"
#include "houdini_style_tools/options.h"
#include "houdini_style_tools/render.h"
#include "houdini_style_tools/report.h"
#include "houdini_style_tools/verbs.h"
#include "splat/rays.h"

namespace vdbc {
namespace {

using nlohmann::ordered_json;

struct RenderOptions {
  RenderSettings settings;
  std::vector<int> size;   // width and height
  std::vector<double> up;  // x y z
};

void cookRender(const RenderOptions& o, const Run& run, Progress& progress) {
  RenderSettings s = o.settings;
  if (!o.size.empty()) s.width = o.size[0], s.height = o.size[1];
  if (!o.up.empty()) s.up = upOf(o.up);
  int count = 0;
  std::string last;
  const auto written = [&](const RenderedFrame& f) {
    ++count, last = f.image;
    if (!run.json) return;
    ordered_json j{{"frame", f.number}, {"image", f.image}};
    if (!f.preview.empty()) j["preview"] = f.preview;
    if (!f.view.empty()) j["view"] = f.view;
    printResult(true, j, "");
  };
  renderFrames(s, written, progress);
  if (!run.json)
    printResult(false, {},
                joinText(count, " frame", count == 1 ? "" : "s, the last one", ": ", last));
}

struct CheckOptions {
  std::string views, volume;
  ReadViewsSettings reading;
};

void cookCheck(const CheckOptions& o, const Run& run) {
  std::vector<View> views = readViews(o.views, o.reading);
  SceneVoxels voxels = readSceneVdb(o.volume);
  // Rays are traced in single precision: near the grid's origin, not the world's.
  for (View& v : views)
    v.camera.world_from_camera =
        voxels.frame.world_from_grid.inverse() * v.camera.world_from_camera;
  voxels.frame.world_from_grid.setIdentity();
  const RayTarget target = RayTarget::fromVoxels(voxels.frame, voxels.ijk);
  const DepthAgreement a = depthAgreement(target, views, 2 * voxels.frame.voxel_m);
  std::vector<Eigen::Vector3f> origins;
  for (const View& v : views)
    origins.push_back(v.camera.world_from_camera.translation().cast<float>());
  printValues(run.json, {{"voxels", voxels.ijk.size()},
                         {"rays", a.rays},
                         {"median_depth_error_m", a.median_error_m},
                         {"within_two_voxels", a.within_share},
                         {"missed", a.miss_share},
                         {"open_directions", openShare(target, origins, 16384, run.seed)}});
}

template <typename Network>
ordered_json networkJson(const Network& network) {
  return {{"preset", network.config().preset},
          {"hash", network.hash()},
          {"trained_on", network.trainedOn()}};
}

void cookInfo(const Run& run) {
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
    j["weights"] = weights;
    j["encoder"] = networkJson(Encoder(weights + "/encoder.safetensors"));
    j["completer"] = networkJson(Completer(weights + "/completer.safetensors"));
  }
  printValues(run.json, j);
}

}  // namespace

Verb renderVerb() {
  const auto o = std::make_shared<RenderOptions>();
  RenderSettings* s = &o->settings;
  return {
      "render",
      "Gaussians as pictures: from given cameras, around them or along a flight",
      "room.ply --turntable 120 -o turn/",
      {{"",
        {option("SPLATS", &s->splats, ".ply or .points.vdb"),
         option("-o,--output OUT", &s->output,
                "folder for 0000.png, ..., or a name with #### that ends in .png or .exr")
             .required(),
         option("--cameras VIEWS", &s->cameras, "views whose cameras to take"),
         option("--turntable N", &s->turntable, "frames of a turn around the splats")
             .between(1, 100000)
             .otherwise("")
             .excludes({"--cameras", "--flythrough"}),
         option("--flythrough N", &s->flythrough, "frames of a smooth flight through the --cameras")
             .between(1, 100000)
             .otherwise("")
             .needs({"--cameras"}),
         ranges("--frames LIST", &s->frames, "numbers of the frames to render, 0,3,5-9 say")
             .otherwise("all")}},
       {"The picture",
        {option("--size WIDTH HEIGHT", &o->size, "in pixels")
             .between(1, 16384)
             .otherwise("the view's; 960 540 for a turntable")
             .excludes({"--width"}),
         option("--width PIXELS", &s->width, "in the view's proportion")
             .between(1, 16384)
             .otherwise("the view's"),
         option("--fov DEGREES", &s->fov_degrees, "field of view across")
             .between(1, 170)
             .otherwise("the view's; 60 for a turntable"),
         option("--up X Y Z", &o->up, "what points up: axis of the turntable").otherwise("0 0 1"),
         flag("--antialias", &s->antialias, true, "opacity-compensated low pass")
             .otherwise("as the file says"),
         flag("--no-antialias", &s->antialias, false, "none").excludes({"--antialias"}),
         flag("--preview", &s->preview, "a .png beside each .exr"), scaleOption(&s->scale)}}},
      [o](const Run& run, Progress& progress) { cookRender(*o, run, progress); }};
}

Verb checkVerb() {
  const auto o = std::make_shared<CheckOptions>();
  return {"check",
          "depth agreement and open directions of a result, traced by Embree",
          "examples/two_views room.vdb",
          {{"",
            {viewsOption(&o->views), option("VOLUME", &o->volume, "X.vdb"),
             framesOption(&o->reading.frames), scaleOption(&o->reading.metres_per_unit)}}},
          [o](const Run& run, Progress&) { cookCheck(*o, run); }};
}

Verb infoVerb() {
  return {"info",
          "BLAS, kernels, threads, measured GFLOP/s; weights and what they were trained on",
          "--json",
          {},
          [](const Run& run, Progress&) { cookInfo(run); }};
}

Program vdbComplete() {
  return {"vdb_complete",
          "Completes a place seen in a few RGB-D views as OpenVDB grids and 3-D Gaussians.",
          {completeVerb(), rethresholdVerb(), encodeVerb(), decodeVerb(), renderVerb(), checkVerb(),
           infoVerb()}};
}

}  // namespace vdbc
