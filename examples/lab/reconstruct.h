#pragma once
// What the encoder-decoder makes of the views it is given, without completion, beside Gaussians
// that need no network.
#include <cstdint>
#include <string>
#include <vector>

#include "examples/lab/evaluate.h"

namespace vdbc {

/// What one method reached on one scene; NaN is printed as null (0/0, no truth, not a step of the
/// method).
struct ReconstructionResult {
  std::string scene, method;
  int views = 0;
  // Over the pixels whose surface the input views observed (observedPixels(), pictureError()): mean
  // over the input views, and over at most kTargetViews others. Views with less than 1 % such
  // pixels are left out.
  double input_psnr = 0, input_ssim = 0, input_flip = 0;
  double other_psnr = 0, other_ssim = 0, other_flip = 0;
  // The same PSNR over those pixels of the others whose point an input view measured to 5 cm: what
  // lies beside it in an observed token is left out.
  double other_seen_psnr = 0;
  // splitScores(): voxels; nodes of level 1, where the encoder's latents are on level 2.
  double voxel_precision = 0, voxel_recall = 0, voxel_f1 = 0;
  double node_precision = 0, node_recall = 0, node_f1 = 0;
  double leak = 0;            // sceneLeak() of the decoded (of voxel-mean: the observed) voxels
  double encode_seconds = 0;  // from views, carving included; of the baselines: to Gaussians
  double decode_seconds = 0;
  double peak_rss_mb = 0;  // of the process
  int64_t gaussians = 0;
};
/// One JSON object.
std::string reconstructionJson(const ReconstructionResult& result);
/// Mean over scenes of each method, scene "mean"; values that are NaN in a scene are left out
/// there.
std::vector<ReconstructionResult> meanReconstructions(
    const std::vector<ReconstructionResult>& results);

/// per_voxel (M) opaque Gaussians in each observed voxel, on the decoder's sub-lattice, sigma half
/// a voxel divided by the cube root of M, of the mean colour of the voxel's pixels. World frame.
Gaussians voxelMean(const Observation& observation, int per_voxel);

struct OptimiseSettings {
  double seconds = 30;  // of wall-clock; the last step may run over
  int64_t max_steps = int64_t(1) << 40;
  uint64_t seed = 1;  // of the choice of views
};
/// `start` after Adam on all of its parameters: each step the mean squared error of one random view
/// over its pixels with a nonzero `observed`. SH degree as in `start`.
Gaussians optimised(const Gaussians& start, const std::vector<View>& views,
                    const std::vector<std::vector<uint8_t>>& observed,
                    const OptimiseSettings& settings, Progress& progress);

/// BCE-up of one split against the true surface, over the children (nodes of `level`) of observed
/// nodes that were not seen: no observed voxel in them, and not all seen empty. `voxels`: what was
/// decoded.
SetScores splitScores(const TriangleMesh& truth, const Observation& observation,
                      const std::vector<Coord>& voxels, int level);

/// Methods: reconstructed (by the decoder), detail (seenDetail(); none where its seconds are 0),
/// voxel-mean, pixel-aligned, optimised (where optimise_seconds > 0). With
/// a `picture` writes a PNG: two input and two other views; the truth, then a column a method.
std::vector<ReconstructionResult> evaluateReconstruction(
    const EvaluationScene& scene, const Encoder& encoder, const SceneSettings& settings,
    double optimise_seconds, const std::string& picture, Progress& progress);

}  // namespace vdbc
