#pragma once
// Where training scenes come from: furnished rooms by seed, rendered or from a cache on disk.
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "encoder/encoder.h"
#include "encoder/train_settings.h"
#include "examples/rooms/rooms.h"
#include "mar/completer_train.h"

namespace vdbc {

/// Seeds of rooms by what they are for. Everything else is free for tests, and `eval` refuses seeds
/// that the weights were trained or validated on. Training seeds have training models, validation
/// seeds held-out ones.
constexpr uint64_t kTrainingSeed = kFirstTrainingSeed, kValidationSeed = 900000,
                   kReservedSeeds = 100000;
/// Throws Error if the room of `seed` was, or may have been, used in training or validation.
void requireHeldOut(uint64_t seed);

constexpr int kRoomSide = 224;  // pixels
constexpr int kRoomViews = 12;  // dense views of a training room

/// The catalogues of this machine, opened once. Throws Error where they are not installed.
const AssetLibrary& roomAssets();

/// kRoomViews views of the room of `seed` from cache_folder/SEED (what make_rooms writes); rendered
/// and put there where they are missing. No folder: rendered.
std::vector<View> trainingViews(uint64_t seed, const std::string& cache_folder);

/// How many samples of the completer's training a room gives.
constexpr int kSamplesPerRoom = 2;

/// Sample of the completer's training: a room, 1-6 random condition views (2 most often), others
/// for each `choice` below kSamplesPerRoom, and all its views as target, encoded; kept in
/// `sample_folder`.
CompletionSample completionSample(const Encoder& encoder, uint64_t seed, int choice,
                                  const std::string& cache_folder,
                                  const std::string& sample_folder);

}  // namespace vdbc
