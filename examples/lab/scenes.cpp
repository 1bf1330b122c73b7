#include "examples/lab/scenes.h"

#include <algorithm>
#include <filesystem>

#include "encoder/views/read_views.h"

namespace vdbc {

namespace fs = std::filesystem;

void requireHeldOut(uint64_t seed) {
  for (uint64_t first : {kTrainingSeed, kValidationSeed})
    require(seed < first || seed >= first + kReservedSeeds, "eval: rooms:", seed,
            ": this seed is reserved for training (expected one outside ", first, "-",
            first + kReservedSeeds - 1, ")");
}

const AssetLibrary& roomAssets() {
  static const AssetLibrary assets = AssetLibrary::open();
  return assets;
}

std::vector<View> trainingViews(uint64_t seed, const std::string& cache_folder) {
  const std::string folder = cache_folder + "/" + std::to_string(seed);
  if (!cache_folder.empty() && fs::exists(folder + "/transforms.json")) {
    std::vector<View> views = readViews(folder);
    require(int(views.size()) >= kRoomViews, folder, ": expected ", kRoomViews,
            " views or more, found ", views.size());
    views.resize(size_t(kRoomViews));
    return views;
  }
  const Room room = makeRoom(roomAssets(), seed);
  std::vector<View> views =
      roomViews(room, RoomRenderer(room), kRoomViews, kRoomSide, kRoomSide, kRoomSamples, seed);
  if (!cache_folder.empty()) writeViews(views, folder);
  return views;
}

CompletionSample completionSample(const Encoder& encoder, uint64_t seed, int choice,
                                  const std::string& cache_folder,
                                  const std::string& sample_folder) {
  const std::string path = joinText(sample_folder, "/", seed, ".", choice, ".sample");
  if (fs::exists(path)) return readSample(path);
  std::vector<View> views = trainingViews(seed, cache_folder);
  const auto turn = std::ptrdiff_t(views.size()) * choice / kSamplesPerRoom;
  std::rotate(views.begin(), views.begin() + turn, views.end());
  // The cameras are random already: the first n are a random choice. Two views are the hardest case
  // that is promised, so half of the samples have two.
  static constexpr size_t kCounts[] = {1, 2, 2, 2, 2, 3, 4, 6};
  const size_t n = kCounts[(seed + 3 * uint64_t(choice)) % 8];
  const std::vector<View> few(views.begin(), views.begin() + std::ptrdiff_t(n));
  Progress silent;
  ObserveSettings settings = encoder.observing();
  settings.volume.up = Eigen::Vector3d::UnitZ();
  const Observation sparse = observe(few, settings, silent);
  settings.frame = sparse.frame;
  const Observation dense = observe(views, settings, silent);
  const CompletionSample s{encoder.encode(few, sparse, silent),
                           encoder.encode(views, dense, silent),
                           poolSeen(*sparse.seen, 1),
                           poolSeen(*sparse.seen, 2),
                           poolSeen(*dense.seen, 1),
                           poolSeen(*dense.seen, 2)};
  fs::create_directories(sample_folder);
  writeSample(s, path);
  return s;
}

}  // namespace vdbc
