// Rooms packed for the completer's training.
#include <chrono>
#include <cmath>
#include <filesystem>
#include <limits>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>

#include "examples/lab/condition_views.h"
#include "examples/lab/evaluate.h"
#include "examples/lab/packed_room.h"
#include "examples/lab/scenes.h"
#include "examples/lab/verbs_lab.h"
#include "houdini_style_tools/options.h"
#include "houdini_style_tools/report.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using nlohmann::ordered_json;

struct PackOptions {
  std::vector<uint64_t> seeds;
  std::string output, weights;
};

// Fewer paths than a picture for people needs: latents are stored far more coarsely.
constexpr int kPackedSamples = 4;
// A condition of fewer tokens shows nothing to go on from.
constexpr int64_t kFewestTokens = 8;

PackedPlace packViews(const std::vector<View>& views, const VoxelFrame& frame,
                      const Encoder& encoder) {
  Progress silent;
  ObserveSettings settings = encoder.observing();
  settings.frame = frame;
  return packPlace(views, encoder.encode(views, observe(views, settings, silent), silent));
}

// Nothing where the views see too little of the room.
std::optional<PackedCondition> packCondition(int kind, const std::vector<View>& views,
                                             VoxelFrame frame, const Encoder& encoder) {
  frame.bounds = boundsOf(views, frame);
  if (frame.bounds.empty()) return {};
  PackedCondition condition{kind, packViews(views, frame, encoder)};
  if (int64_t(condition.place.tokens.ijk.size()) < kFewestTokens) return {};
  return condition;
}

std::vector<SurfaceNode> surfacesOf(const Room& room, const VoxelFrame& frame) {
  std::vector<SurfaceNode> surfaces;
  const CoordBBox box = nodesIn(frame.bounds, 1);
  for (const Coord& node : surfaceNodes(solidMesh(room.surface), frame, 1)) {
    if (!box.isInside(node)) continue;
    const Eigen::Vector3f p = frame.toWorld(centreOf(node)).cast<float>();
    surfaces.push_back({node, isWithin(room, room.world_from_room.inverse() * p)});
  }
  return surfaces;
}

struct Packed {
  PackedRoom room;
  std::vector<SurfaceNode> surfaces;
};

// The target is what far and hand-held views see together; every condition has a box of its own in
// the same frame.
Packed packRoom(uint64_t seed, const Encoder& encoder, Progress& progress) {
  std::mt19937_64 random(seed * 7919 + 13);
  const Room room = makeRoom(roomAssets(), seed);
  const RoomRenderer renderer(room);
  const std::vector<View> far =
      roomViews(room, renderer, kRoomViews, kRoomSide, kRoomSide, kPackedSamples, seed);
  const std::vector<View> hand =
      handHeldViews(room, renderer, kRoomSide, kPackedSamples, seed + uint64_t(kRoomViews), random);
  std::vector<DepthView> depth;
  for (const View& view : far) depth.push_back(view.depthView());
  const ObserveSettings settings = encoder.observing();
  const VoxelFrame frame = fitVolume(depth, settings.volume, settings.carving);
  std::vector<View> all = far;
  all.insert(all.end(), hand.begin(), hand.end());
  Packed packed;
  packed.room.seed = int32_t(seed), packed.room.voxel_m = frame.voxel_m;
  packed.room.target = packViews(all, frame, encoder);
  packed.surfaces = surfacesOf(room, frame);
  for (int kind = 0; kind < kConditionKinds; ++kind) {
    report(progress, -1);
    if (auto condition =
            packCondition(kind, conditionViews(kind, far, hand, random), frame, encoder))
      packed.room.conditions.push_back(std::move(*condition));
  }
  require(!packed.room.conditions.empty(), room.name, ": expected views to pack, found none");
  return packed;
}

// "room 1000000  bytes 149252  conditions 7  seconds 9.4"
std::string textOf(const ordered_json& result) {
  std::string text;
  for (const auto& [name, value] : result.items())
    text += (text.empty() ? "" : "  ") + name + " " +
            (value.is_string() ? value.get<std::string>() : value.dump());
  return text;
}

// Nothing, and `result` says why, where the room has no place to stand in: no reason to stop.
std::optional<Packed> tryPackRoom(uint64_t seed, const Encoder& encoder, Progress& progress,
                                  ordered_json* result) {
  try {
    return packRoom(seed, encoder, progress);
  } catch (const Error& e) {
    (*result)["error"] = e.what();
    return {};
  }
}

void cookPack(const PackOptions& o, const Run& run, Progress& progress) {
  constexpr uint64_t kMaxSeed = std::numeric_limits<int32_t>::max();  // as files hold them
  for (const uint64_t seed : o.seeds)
    if (seed > kMaxSeed)
      throw UsageError(joinText("--seeds: expected at most ", kMaxSeed, ", found ", seed));
  const Encoder encoder(weightsFolder(o.weights) + "/encoder.safetensors");
  roomAssets();  // refused now where they are missing, not room by room
  startPackedFolder(o.output, encoder.hash());
  progress.start("pack rooms");
  for (size_t i = 0; i < o.seeds.size(); ++i) {
    report(progress, int(100 * i / o.seeds.size()));
    const uint64_t seed = o.seeds[i];
    const std::string path = packedPath(o.output, seed);
    if (fs::exists(path)) continue;
    const auto start = std::chrono::steady_clock::now();
    ordered_json result{{"room", seed}};
    if (const auto packed = tryPackRoom(seed, encoder, progress, &result)) {
      // The room comes last: where it is, all of it is.
      writeSurfaces(packed->surfaces, surfacesPath(o.output, seed));
      result["bytes"] = writePackedRoom(packed->room, path);
      result["conditions"] = packed->room.conditions.size();
    }
    result["seconds"] = std::round(10 * secondsSince(start)) / 10;
    printResult(run.json, result, textOf(result));
  }
  progress.end();
}

}  // namespace

Verb packVerb() {
  const auto o = std::make_shared<PackOptions>();
  return {"pack",
          "furnished rooms as packed samples of the completer's training, one file a room",
          "--seeds 1000000-1000399 -o out/packed",
          {{"",
            {ranges("--seeds LIST", &o->seeds,
                    joinText("which rooms, 3,10-19 say; from ", kFirstTrainingSeed,
                             " on with training models"))
                 .required(),
             option("-o,--output FOLDER", &o->output,
                    "for SEED.xz; rooms that are there are left alone")
                 .required(),
             weightsOption(&o->weights)}}},
          [o](const Run& run, Progress& progress) { cookPack(*o, run, progress); }};
}

}  // namespace vdbc
