#pragma once
// Masked training of the completer on latents of the frozen encoder (paper sec. 4; docs/method.md,
// section 5).
#include <functional>
#include <string>

#include "encoder/train_settings.h"
#include "mar/completer.h"

namespace vdbc {

/// One training scene in latent space: what a few condition views see and what many views see, in
/// the same frame. Needs no 3-D ground truth.
struct CompletionSample {
  Place condition, target;                // E(sparse), E(dense); without what was seen
  SeenSpace seen_nodes, seen_coarse;      // of the condition views, levels 1 and 2
  SeenSpace target_nodes, target_coarse;  // of the dense views
};

/// Temporary name, then rename; safetensors. Throw Error.
void writeSample(const CompletionSample& sample, const std::string& path);
CompletionSample readSample(const std::string& path);

using SampleSource = std::function<CompletionSample(uint64_t index)>;

/// Trains both stages (or resumes). Each step: the mean gradient of settings.batch samples, each a
/// coarse sample and the mean of settings.fine_draws fine ones behind it. Coarse: a random share
/// (.3-1) of the unknown coarse positions is worked on, a random part of the truth may be visible.
/// Fine: three quarters of the masks show condition tokens alone and ask about one BFS level, the
/// rest are growth states or hide a random .5-1 of the truth; visible tokens get noise and false
/// positives as roll-outs have them. Errors of latents count twice: of all channels, and of what
/// `colour_way` ([K, latent_dim] by rows, Encoder::colourWay()) makes of them. Validation by
/// roll-outs: precision, recall and F1 on unobserved level-1 nodes of the condition's box against
/// the dense views' truth.
void trainCompleter(const CompleterConfig& config, const std::vector<float>& colour_way,
                    const SampleSource& samples, int64_t sample_count,
                    const SampleSource& validation, int validation_count,
                    const TrainSettings& settings, const TrainListener& listener,
                    Progress& progress);

/// For tests: builds a network with `seed`, runs one step on the sample twice; the total loss
/// before and after, and a checksum of all gradients of the first pass.
struct CompleterStep {
  double before = 0, after = 0;
  double gradient_sum = 0;                  // of absolute values
  double trunk_gradient_of_refinement = 0;  // absolute sum; docs/method.md, section 4.6: exactly 0
};
CompleterStep completerStep(const CompleterConfig& config, const CompletionSample& sample,
                            uint64_t seed);

}  // namespace vdbc
