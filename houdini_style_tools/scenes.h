#pragma once
// Where training and evaluation scenes come from: procedural rooms by seed, or a folder of real views.
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "encoder/encoder.h"
#include "encoder/train_settings.h"
#include "mar/completer_train.h"

namespace vdbc {

/// Seeds of procedural rooms by what they are for; ranges never overlap. Everything else is free for
/// tests, and `eval` refuses seeds that the weights were trained or validated on.
constexpr uint64_t kEncoderTrainingSeed = 1000000, kCompleterTrainingSeed = 2000000,
                   kValidationSeed = 900000, kReservedSeeds = 100000;
/// Throws Error if the room of `seed` was, or may have been, used in training or validation.
void requireHeldOut(uint64_t seed);

constexpr int kRoomSide = 224;     // pixels
constexpr int kRoomViews = 10;     // dense views of a training room
constexpr int kRoomSamples = 2;    // render samples a pixel

/// Rendered views of the room of `seed`.
std::vector<View> roomViews(uint64_t seed, int count);

/// Volume of a scene to complete: what the main job uses, so that training sees the same.
VoxelFrame completionFrame(const std::vector<View>& views, const EncoderConfig& config,
                           const Eigen::Vector3d& up);

/// Sample `index` of the completer's training: a room, 1-8 random condition views (2 most often) and
/// all its views as target, encoded; kept in `cache_folder`.
CompletionSample completionSample(const Encoder& encoder, uint64_t seed, const std::string& cache_folder);

}  // namespace vdbc
