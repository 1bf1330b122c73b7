// Furnished rooms as folders of RGB-D views with their truth, the example homes,
// contact sheets and statistics.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <map>
#include <memory>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "encoder/views/read_views.h"
#include "examples/lab/verbs_lab.h"
#include "examples/rooms/rooms.h"
#include "splat/exr.h"
#include "splat/image_files.h"
#include "vdb/error.h"
#include "vdb/file_io.h"
#include "vdb/progress.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Eigen::Vector3f;
using nlohmann::ordered_json;

constexpr int kTileSide = 128, kSheetColumns = 8;
constexpr float kTruthVoxel = .1f;  // metres

struct RoomOptions {
  std::vector<uint64_t> seeds;
  std::string output;
  int views = 8, samples = kRoomSamples;
  std::vector<int> size{224};  // width, or width and height
  bool truth = false, aovs = false;
};

void writeAovs(const RoomPicture& p, const std::string& path) {
  std::vector<float> depth = p.view.depth, material(p.material.begin(), p.material.end());
  for (float& z : depth)
    if (!(z > 0)) z = kNoDepth;
  const float *c = p.radiance.data.data(), *n = p.normal.data.data();
  writeExr(p.view.camera,
           {{"R", c, 3, true},
            {"G", c + 1, 3, true},
            {"B", c + 2, 3, true},
            {"N.X", n, 3, true},
            {"N.Y", n + 1, 3, true},
            {"N.Z", n + 2, 3, true},
            {"Z", depth.data(), 1, false},
            {"material", material.data(), 1, false}},
           path);
}

// FOLDER/{transforms.json, color, depth} and what the options add; returns the sheet's picture.
Image writeRoom(const Room& room, uint64_t seed, const RoomOptions& o, const std::string& folder) {
  const int width = o.size.front(), height = o.size.back();
  const RoomRenderer renderer(room);
  const std::vector<View> views =
      roomViews(room, renderer, o.views, width, height, o.samples, seed);
  writeViews(views, folder);
  if (o.truth) {
    writeMesh(solidMesh(room.surface), folder + "/mesh.ply");
    writeTruth(room, roomTruth(room, kTruthVoxel), folder + "/truth.vdb");
  }
  for (size_t i = 0; o.aovs && i < views.size(); ++i) {
    char name[32];
    std::snprintf(name, sizeof name, "/aovs.%04zu.exr", i);
    writeAovs(renderer.picture(views[i].camera, o.samples, seed + i), folder + name);
  }
  return views[0].colour;
}

// transforms.json is written last: a run that was stopped goes on where it was.
bool isWritten(const std::string& folder) { return fs::exists(folder + "/transforms.json"); }

// The first picture of a room that an earlier run wrote.
Image firstPicture(const std::string& folder) {
  ReadViewsSettings first;
  first.frames = {0};
  return readViews(folder, first)[0].colour;
}

void writeSheet(const std::vector<Image>& pictures, const std::string& folder) {
  const Image& first = pictures[0];
  const int tile_height =
      std::max(1, int(std::lround(double(kTileSide) * first.height / first.width)));
  std::vector<Image> tiles;
  for (const Image& picture : pictures)
    tiles.push_back(resizeImage(picture, kTileSide, tile_height));
  writePng(tileImages(tiles, kSheetColumns), folder + "/sheet.png");
}

void makeRooms(const AssetLibrary& assets, const RoomOptions& o) {
  std::vector<Image> pictures;
  for (uint64_t seed : o.seeds) {
    const std::string folder = o.output + "/" + std::to_string(seed);
    pictures.push_back(isWritten(folder) ? firstPicture(folder)
                                         : writeRoom(makeRoom(assets, seed), seed, o, folder));
  }
  writeSheet(pictures, o.output);
}

void makeHomes(const AssetLibrary& assets, const RoomOptions& o) {
  std::vector<Image> pictures;
  const int count = homeRoomCount(assets);
  for (int i = 0; i < count; ++i) {
    const std::string folder = o.output + "/" + std::to_string(i);
    pictures.push_back(isWritten(folder) ? firstPicture(folder)
                                         : writeRoom(homeRoom(assets, i), uint64_t(i), o, folder));
  }
  writeSheet(pictures, o.output);
}

// --- models
// ---------------------------------------------------------------------------------------

void addQuad(const std::array<Vector3f, 4>& p, SurfaceMesh* s) {
  const int first = int(s->mesh.vertices.size());
  s->mesh.vertices.insert(s->mesh.vertices.end(), p.begin(), p.end());
  for (int k : {1, 2}) {
    s->mesh.triangles.emplace_back(first, first + k, first + k + 1);
    s->material.push_back(0);
    s->uv.push_back({Eigen::Vector2f::Zero(), Eigen::Vector2f::Zero(), Eigen::Vector2f::Zero()});
    s->normal.push_back({Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()});
  }
}

// A model scaled to a unit box, in a corner of white walls under one lamp, seen from its front
// right.
Image modelPicture(const AssetLibrary& assets, size_t model, int side) {
  Room room;
  room.name = assets.models()[model].id;
  room.surface.materials.push_back({});
  room.surface.materials[0].colour_a.setConstant(.7f);
  addQuad({Vector3f(-2, -2, 0), Vector3f(2, -2, 0), Vector3f(2, 2, 0), Vector3f(-2, 2, 0)},
          &room.surface);
  addQuad({Vector3f(-2, -1, 0), Vector3f(-2, -1, 3), Vector3f(2, -1, 3), Vector3f(2, -1, 0)},
          &room.surface);
  addQuad({Vector3f(-1, -2, 0), Vector3f(-1, 2, 0), Vector3f(-1, 2, 3), Vector3f(-1, -2, 3)},
          &room.surface);
  const float scale = 1 / assets.models()[model].size_m.maxCoeff();
  room.surface.append(*assets.mesh(model), Eigen::Affine3f(Eigen::Scaling(scale)));
  room.floor = {{-2, -2}, {2, -2}, {2, 2}, {-2, 2}};
  room.ceilings = {{0, 0, 3}};
  RoomLight lamp;
  lamp.centre = Vector3f(1.4f, 1.8f, 2.6f), lamp.radius_m = .35f, lamp.radiance.setConstant(20);
  room.lights.push_back(lamp);
  Camera camera;
  camera.width = camera.height = side;
  camera.fx = camera.fy = 1.7 * side;
  camera.cx = camera.cy = side / 2.;
  camera.world_from_camera = lookAt({1.5, 2.2, 1.5}, {0, 0, .42}, Eigen::Vector3d::UnitZ());
  return RoomRenderer(room).render(camera, 16, 1).colour;
}

void makeModelSheet(const AssetLibrary& assets, const RoomOptions& o) {
  constexpr int kSide = 96, kColumns = 30;
  std::vector<Image> pictures;
  for (size_t i = 0; i < assets.models().size(); ++i) {
    const ModelInfo& m = assets.models()[i];
    if (m.role != "none" && m.fault.empty()) pictures.push_back(modelPicture(assets, i, kSide));
  }
  require(!pictures.empty(), "make_rooms models: expected usable models, found none");
  writePng(tileImages(pictures, kColumns), o.output);
  std::printf("%zu models\n", pictures.size());
}

// --- statistics
// -----------------------------------------------------------------------------------

double floorArea(const Room& room) {
  double twice = 0;
  for (size_t i = 0, j = room.floor.size() - 1; i < room.floor.size(); j = i++)
    twice += double(room.floor[j].x()) * room.floor[i].y() -
             double(room.floor[i].x()) * room.floor[j].y();
  return twice / 2;
}

// Share of the room's own voxels (F or E in truth) that the first `count` views leave F, E and U.
ordered_json seenShares(const RoomTruth& truth, const std::vector<View>& views, int count) {
  std::vector<DepthView> depth;
  for (int i = 0; i < count; ++i) depth.push_back(views[size_t(i)].depthView());
  Progress silent;
  const SeenSpace seen = carve(truth.frame, depth, CarveSettings(), silent);
  std::array<int64_t, 3> counts = {0, 0, 0};
  for (auto c = truth.frame.bounds.begin(); c; ++c)
    if (truth.space.filled.isValueOn(*c) || truth.space.empty.isValueOn(*c))
      ++counts[seen.filled.isValueOn(*c) ? 0 : seen.empty.isValueOn(*c) ? 1 : 2];
  const double all = double(counts[0] + counts[1] + counts[2]);
  return {{"F", double(counts[0]) / all},
          {"E", double(counts[1]) / all},
          {"U", double(counts[2]) / all}};
}

struct Totals {
  std::map<std::string, int> kinds;
  std::set<std::string> models;
  std::map<std::string, std::vector<double>> values;
};

ordered_json statisticsOf(const AssetLibrary& assets, uint64_t seed, Totals* totals) {
  constexpr int kViews = 12, kSide = 224;
  const auto start = std::chrono::steady_clock::now();
  const Room room = makeRoom(assets, seed);
  const double seconds = secondsSince(start);
  const RoomRenderer renderer(room);
  const RayTarget& solid = renderer.rayTarget();
  std::mt19937_64 random(seed);
  std::vector<Camera> cameras =
      coveringCameras(solid, randomCameras(room, solid, 4 * kViews, kSide, kSide, random), kViews);
  for (size_t i = cameras.size(); i-- > 1;) std::swap(cameras[i], cameras[random() % (i + 1)]);
  std::vector<View> views;
  for (const Camera& c : cameras) views.push_back(renderer.renderDepth(c));
  const RoomTruth truth = roomTruth(room, kTruthVoxel);
  std::set<std::string> models;
  int placed = 0;
  for (const Piece& p : room.pieces)
    if (!p.model.empty()) models.insert(p.model), ++placed;
  ++totals->kinds[room.kind];
  totals->models.insert(models.begin(), models.end());
  ordered_json j{{"room", room.name},
                 {"kind", room.kind},
                 {"l_shaped", room.floor.size() > 4 ? 1. : 0.},
                 {"sloped", room.ceilings.size() > 1 ? 1. : 0.},
                 {"floor_m2", floorArea(room)},
                 {"objects", double(placed)},
                 {"models", double(models.size())},
                 {"triangles", double(room.surface.mesh.triangles.size())},
                 {"seconds", seconds}};
  for (int count : {2, kViews}) {
    const ordered_json shares = seenShares(truth, views, count);
    for (const auto& [state, share] : shares.items())
      j[state + "_" + std::to_string(count)] = share;
  }
  for (const auto& [key, value] : j.items())
    if (value.is_number()) totals->values[key].push_back(value.get<double>());
  return j;
}

// One JSON line a room, and one of all of them: mean, least and most.
void printStatistics(const AssetLibrary& assets, const RoomOptions& o) {
  Totals totals;
  for (uint64_t seed : o.seeds) {
    std::printf("%s\n", statisticsOf(assets, seed, &totals).dump().c_str());
    std::fflush(stdout);
  }
  ordered_json all{
      {"rooms", o.seeds.size()}, {"models_used", totals.models.size()}, {"kinds", totals.kinds}};
  for (auto& [key, values] : totals.values) {
    const auto [least, most] = std::minmax_element(values.begin(), values.end());
    double sum = 0;
    for (double v : values) sum += v;
    all[key] = {{"mean", sum / double(values.size())}, {"min", *least}, {"max", *most}};
  }
  std::printf("%s\n", all.dump().c_str());
}

// --- verbs
// ----------------------------------------------------------------------------------------

std::vector<Option> pictureOptions(RoomOptions* o) {
  return {option("-o,--output FOLDER", &o->output, "for SEED/transforms.json, ... and sheet.png")
              .required(),
          option("--views N", &o->views, "pictures a room").between(1, 1000),
          option("--size WIDTH [HEIGHT]", &o->size, "in pixels").between(8, 4096),
          option("--samples N", &o->samples, "paths a pixel").between(1, 65536),
          flag("--truth", &o->truth, "mesh.ply and truth.vdb of each room too"),
          flag("--aovs", &o->aovs, "aovs.####.exr too: scene-linear colour, normal, Z, material")};
}

Option seedsOption(RoomOptions* o) {
  return ranges("--seeds LIST", &o->seeds,
                joinText("which rooms, 3,10-19 say; from ", kFirstTrainingSeed,
                         " on with training models"))
      .required();
}

// A verb of make_rooms; `cook` works on the installed furniture.
Verb roomVerb(const std::string& name, std::string does, std::string example,
              const std::shared_ptr<RoomOptions>& o, std::vector<Option> options,
              void (*cook)(const AssetLibrary&, const RoomOptions&)) {
  std::vector<OptionGroup> groups;
  if (!options.empty()) groups.push_back({"", std::move(options)});
  return {"make_rooms " + name, std::move(does), std::move(example), std::move(groups),
          [o, cook](const Run&, Progress&) { cook(AssetLibrary::open(), *o); }};
}

}  // namespace

std::vector<Verb> makeRoomsVerbs() {
  const auto o = std::make_shared<RoomOptions>();
  std::vector<Option> rooms = pictureOptions(o.get());
  rooms.insert(rooms.begin(), seedsOption(o.get()));
  return {
      roomVerb("rooms", "furnished rooms as RGB-D views, path-traced",
               "--seeds 1-8 -o out/held_out", o, rooms, makeRooms),
      roomVerb("homes", "the rooms of the nine example homes, likewise", "-o out/homes", o,
               pictureOptions(o.get()), makeHomes),
      roomVerb("models", "contact sheet of all usable models", "-o out/models.png", o,
               {option("-o,--output FILE", &o->output, "PNG to write").required()}, makeModelSheet),
      roomVerb("statistics", "one JSON line a room: contents, and what views see of it",
               "--seeds 1000000-1000999", o, {seedsOption(o.get())}, printStatistics),
      roomVerb("attribution", "creators and licences of all usable models (Markdown)", "", o, {},
               [](const AssetLibrary& assets, const RoomOptions&) {
                 std::printf("%s", attribution(assets).c_str());
               }),
      roomVerb("table", "the table models.tsv anew: split, role and fault of every model", "", o,
               {}, [](const AssetLibrary& assets, const RoomOptions&) {
                 std::printf("%s", modelTable(assets).c_str());
               })};
}

}  // namespace vdbc
