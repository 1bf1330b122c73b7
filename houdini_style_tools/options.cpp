#include "houdini_style_tools/options.h"

#include <filesystem>
#include <nlohmann/json.hpp>

namespace vdbc {

namespace fs = std::filesystem;
using nlohmann::ordered_json;

Option viewsOption(std::string* views) {
  return option(
      "VIEWS", views,
      "folder with transforms.json, a transforms.json, EXR file(s) with Z or P, pointmaps "
      "(.npz), a level set or fog volume (.vdb)");
}
Option framesOption(std::vector<int>* frames) {
  return ranges("--frames LIST", frames, "which of the views, 0,3,5-9 say").otherwise("all");
}
Option scaleOption(double* metres_per_unit) {
  return option("--scale METRES", metres_per_unit, "metres per unit of an .npz")
      .between(1e-6, 1e6)
      .otherwise("from its cameras' baseline");
}
Option weightsOption(std::string* folder) {
  return option("--weights FOLDER", folder,
                "the networks, encoder.safetensors and completer.safetensors")
      .otherwise("those beside the program");
}
Option marginOption(SceneSettings* settings) {
  return option("--margin METRES", &settings->observing.volume.margin_m,
                "room around what was seen")
      .between(0, 100);
}
Option childTauOption(float* child_threshold) {
  return option("--child-tau P", child_threshold,
                "a voxel of a kept token is kept above this probability")
      .between(0, 1);
}
Option antialiasOption(bool* antialias) {
  return flag("--antialias", antialias,
              "splats are for an opacity-compensated low pass; the files say so");
}
std::vector<Option> volumeOptions(SceneOptions* o) {
  return {option("--bounds X0 Y0 Z0 X1 Y1 Z1", &o->bounds, "two corners of the box to complete")
              .otherwise("what was seen, and the margin"),
          option("--up X Y Z", &o->up, "what points up in the world").otherwise("the format's"),
          scaleOption(&o->metres_per_unit)};
}

std::vector<Option> detailOptions(DetailSettings* s) {
  return {option("--detail SECONDS", &s->seconds,
                 "to spend on making what views saw as sharp as their pixels, counted by a fixed "
                 "cost model; 0: as coarse as the rest")
              .between(0, 3600),
          option("--detail-voxel METRES", &s->voxel_m,
                 "of the level set; 0: as fine as the views measured, .01 to .05")
              .between(0, 1),
          option("--splats N", &s->splats, "at most for what views saw; 0: as its content asks")
              .between(0, 100000000)};
}

Option tauOption(CompleteSettings* settings) {
  return option("--tau P", &settings->tau,
                "a token is kept above this probability, unless it only thickens a surface: lower "
                "fills more, with more mistakes")
      .between(0, 1);
}
Option fromLevelOption(CompleteSettings* settings) {
  return option("--from-level K", &settings->first_level,
                "with X.latent.vdb: growth levels below stay, the rest is made anew")
      .between(1, 1 << 20);
}
std::vector<Option> growthOptions(CompleteSettings* s) {
  return {
      option("--coarse-tau P", &s->coarse_tau, "like --tau, for the coarse gate").between(0, 1),
      option("--hole-tau P", &s->hole_tau,
             "above this probability dropped tokens are taken back where they close a small hole; "
             "1: none")
          .between(0, 1),
      option("--sampling-steps N", &s->sampling_steps, "diffusion steps; 0: the linear mean")
          .between(0, 1000),
      option("--temperature T", &s->temperature, "of the diffusion head").between(0, 10),
      flag("--generated-context", &s->generated_context,
           "generated tokens are context of later levels, as in the paper"),
      flag("--refine-observed", &s->refine_observed, "let the completer rewrite observed latents")};
}
std::vector<Option> identityOptions(CompleteSettings* settings) {
  std::vector<Option> options = growthOptions(settings);
  for (Option o : {tauOption(settings), fromLevelOption(settings), seedOption(&settings->seed)})
    options.push_back(std::move(o));
  return options;
}

std::string weightsFolder(const std::string& given) {
  if (!given.empty()) return given;
  std::error_code error;
  const fs::path self = fs::read_symlink("/proc/self/exe", error);
  const std::string beside = error ? "." : self.parent_path().string();
  for (const char* place : {"/../../weights/indoor", "/../share/vdb_complete/weights/indoor"}) {
    const std::string folder = beside + place;
    if (fs::exists(folder + "/encoder.safetensors")) return fs::weakly_canonical(folder).string();
  }
  throw Error(
      "--weights: no trained weights beside the program (expected weights/indoor; use --weights "
      "FOLDER)");
}

Eigen::Vector3d upOf(const std::vector<double>& given) {
  const Eigen::Vector3d up(given[0], given[1], given[2]);
  if (!up.allFinite() || up.norm() < 1e-6)
    throw UsageError("--up: expected a finite vector that is not zero");
  return up.normalized();
}

SceneSettings settingsOf(const SceneOptions& o, const Eigen::Vector3d& up) {
  SceneSettings s = o.settings;
  s.observing.volume.up = up;
  if (o.bounds.empty()) return s;
  const Eigen::Map<const Eigen::Vector3d> low(&o.bounds[0]), high(&o.bounds[3]);
  s.observing.volume.bounds = Eigen::AlignedBox3d(low, high);
  const Eigen::Vector3d sizes = s.observing.volume.bounds->sizes();
  if (!sizes.allFinite() || sizes.minCoeff() <= 0)
    throw UsageError("--bounds: expected a box: x0 y0 z0 x1 y1 z1 with each second corner larger");
  return s;
}

SceneInput readScene(const SceneOptions& o) {
  ReadViewsSettings reading;
  reading.frames = o.frames, reading.metres_per_unit = o.metres_per_unit;
  std::vector<View> views = readViews(o.views, reading);
  return {std::move(views), settingsOf(o, o.up.empty() ? conventionalUp(o.views) : upOf(o.up))};
}

ordered_json scaleJson(const SceneOptions& o) {
  if (fs::path(o.views).extension() != ".npz") return ordered_json::object();
  const PointmapScale s = pointmapScale(o.views, o.metres_per_unit);
  return {{"metres_per_unit", s.metres_per_unit}, {"scale_from", s.source}};
}

std::string scaleLine(const SceneOptions& o) {
  const ordered_json j = scaleJson(o);
  if (j.empty()) return "";
  return joinText("\n", j["metres_per_unit"].get<double>(), " metres per unit of the pointmaps (",
                  j["scale_from"].get<std::string>(), ")");
}

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

bool endsWith(const std::string& text, const std::string& ending) {
  return text.size() >= ending.size() &&
         text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

void requireOtherName(const std::string& from, const std::string& ending, const std::string& stem) {
  std::error_code none;
  if (endsWith(from, ending) &&
      fs::weakly_canonical(from, none) == fs::weakly_canonical(stem + ending, none))
    throw UsageError(
        joinText("--output: ", stem, ".vdb: expected another name than that of ", from));
}

}  // namespace vdbc
