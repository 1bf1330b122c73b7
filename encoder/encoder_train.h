#pragma once
// Training of the encoder-decoder from posed RGB-D views alone (paper sec. 3; docs/method.md,
// section 3.7).
#include "encoder/encoder.h"
#include "encoder/train_settings.h"

namespace vdbc {

/// Trains from scratch (or resumes). Each step: one scene, 1-8 random condition views; the loss is
/// the squared error (mean over views, pixels and channels) of up to 4 rendered views, two of them
/// not among the condition views, over the pixels whose surface the condition views observed; plus
/// beta * KL (mean over tokens and channels), plus the BCE of the splits. Validation: `validation`
/// scenes, 4 condition views, inference's own splits: PSNR of input and of held-out views over the
/// same pixels. Throws Cancelled after saving a checkpoint when interrupted.
void trainEncoder(const EncoderConfig& config, const SceneSource& scenes, int64_t scene_count,
                  const SceneSource& validation, int validation_count,
                  const TrainSettings& settings, const TrainListener& listener, Progress& progress);

/// One training step's loss on given views, for tests: builds a network of `config` with `seed`,
/// runs forward, backward and one optimiser step, and returns the losses before and after on the
/// same views.
std::pair<double, double> encoderStepLoss(const EncoderConfig& config,
                                          const std::vector<View>& views, uint64_t seed);

}  // namespace vdbc
