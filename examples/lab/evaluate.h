#pragma once
// All methods and baselines on scenes that the networks never saw.
#include <array>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "examples/lab/perceptual.h"
#include "houdini_style_tools/complete.h"
#include "splat/rays.h"

namespace vdbc {

/// Views of a room that are not input.
constexpr int kTargetViews = 8;

/// One scene to evaluate: input views, target views and, for rooms, the truth.
struct EvaluationScene {
  std::string name;
  std::vector<View> input, targets;
  Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  std::optional<TriangleMesh> truth,
      shell;  // all solid surfaces, and those of the room itself (shellMesh)
  std::vector<Eigen::Vector3f> free_points;  // origins of leak rays; empty without truth
  std::function<bool(const Eigen::Vector3f& p_world)>
      is_within;  // the room (isWithin); empty without truth
};

/// Scenes named by SPEC: `rooms:SEED-SEED` (or rooms:SEED), or a folder with transforms.json of
/// which `views` random frames, or those of `frames`, are input and the rest targets.
struct SceneList {
  int64_t count = 0;
  std::function<EvaluationScene(int64_t)> scene;
};
/// Throws UsageError for a malformed SPEC, Error for seeds reserved for training.
SceneList sceneList(const std::string& spec, int views, const std::vector<int>& frames,
                    uint64_t seed);

/// A set of nodes against the true one; NaN is 0/0.
struct SetScores {
  double precision = 0, recall = 0, f1 = 0, iou = 0;
};
SetScores setScores(const std::set<Coord>& filled, const std::set<Coord>& truth);

/// Of a node of level 1, voxels.
Eigen::Vector3d centreOf(const Coord& node);

/// How many of `filled`, nodes of level 1 of the frame's grid, lie outside the scene's room: they
/// are not in `truth`, the nodes that its surfaces pass, and their centre is not over its floor and
/// below its ceilings. What stands behind the shell, exactly; a false node in a cupboard is not
/// outside, one in the next room of a home is.
int64_t outsideCount(const EvaluationScene& scene, const VoxelFrame& frame,
                     const std::set<Coord>& filled, const std::set<Coord>& truth);

/// What the input and target views of a scene saw, voxels.
SeenSpace seenByAll(const EvaluationScene& scene, const VoxelFrame& frame,
                    const CarveSettings& carving, Progress& progress);
/// What became of the generated tokens of `place`, by what `all` says of nodes of their level;
/// those that nobody saw do not count.
std::vector<Outcome> outcomesOf(const Place& place, const SeenSpace& all);

/// Outcomes by their probability: bin i of ten holds [i, i + 1) / 10, the last one also 1.
struct ReliabilityBin {
  int64_t count = 0, hits = 0;  // hits: occupied
  double sum_probability = 0;
};
using Reliability = std::array<ReliabilityBin, 10>;
Reliability reliabilityOf(const std::vector<Outcome>& outcomes);
/// Expected calibration error: mean over the nodes of |share of hits - mean probability| of their
/// bin (Naeini et al. 2015). NaN without nodes.
double calibrationError(const Reliability& reliability);

/// Share of rays from the free points of a scene with truth that meet none of `voxels` before they
/// have passed the true surface by two voxels.
double sceneLeak(const EvaluationScene& scene, const VoxelFrame& frame,
                 const std::vector<Coord>& voxels);

/// Adds an opaque-looking Gaussian of one colour: standard deviation sigma_m in all directions.
void addIsotropic(const Eigen::Vector3d& mean, double sigma_m, const Eigen::Vector3f& srgb,
                  Gaussians* g);

/// An opaque isotropic Gaussian at each pixel with a nonzero `observed` ([H * W] of each view), at
/// its depth, as wide as its pixel. World frame.
Gaussians pixelAligned(const std::vector<View>& views,
                       const std::vector<std::vector<uint8_t>>& observed);

/// Writes pictures as a PNG: a column a method, a row a view, all in the size of the first. Throws
/// Error.
void writeColumns(const std::vector<std::vector<Image>>& columns, const std::string& path);

/// The user's own networks; null where there is none.
struct UserNets {
  std::shared_ptr<const PerceptualNet> lpips;
  std::shared_ptr<const FeatureNet> features;
};

/// What one method reached on one scene; NaN is printed as null (0/0, or no truth).
struct MethodResult {
  std::string scene, method;
  int views = 0;
  double psnr = 0, ssim = 0, flip = 0;  // mean over target views, over black
  // The same over the mean colour of the input pictures, which emptiness and fog have too; then of
  // the pixels alone whose surface an input view saw, and of those that none did.
  double mean_psnr = 0, mean_ssim = 0, mean_flip = 0;
  double seen_psnr = 0, unseen_psnr = 0, unseen_ssim = 0, unseen_flip = 0;
  double lpips = 0;  // the same, by the user's network; NaN without one
  // Median depth against the targets' depth, where both are: mean over target views of the median
  // of the absolute difference and of the root mean square, metres.
  double depth_median_m = 0, depth_rmse_m = 0;
  double depth_share = 0;  // of the targets' depths: those with a median depth to compare
  // Between the target pictures of all scenes and what was rendered for them: in the mean only, NaN
  // elsewhere and without a network.
  double fid = std::numeric_limits<double>::quiet_NaN(),
         kid = std::numeric_limits<double>::quiet_NaN();
  std::vector<std::vector<float>> features, true_features;  // one row a target view
  // 0.2 m nodes that were unobserved, against the true surface; recall also of those that the
  // room's shell passes and of the others, which only furniture passes. outside: outsideCount() of
  // the filled ones.
  double precision = 0, recall = 0, f1 = 0, iou = 0;
  double shell_recall = 0, furniture_recall = 0, outside = 0;
  double ece = std::numeric_limits<double>::quiet_NaN();  // calibrationError(); of `completed` only
  std::optional<Reliability> reliability;  // the same; of a mean the sums over its scenes
  double leak = 0;  // share of rays from free space that pass the true surface
  // Against all views, input and targets (judge.h): generated voxels, and the targets' pixels.
  double confirmed = 0, contradicted = 0, undecided = 0;
  double voxel_precision = 0, voxel_recall = 0, voxel_f1 = 0;
  double near_precision = 0, near_recall = 0, near_f1 = 0;
  double blocked = 0, right = 0, behind = 0, open = 0;
  double seconds = 0, peak_rss_mb = 0;
  int64_t gaussians = 0;
};
/// One JSON object, without features and reliability.
std::string resultJson(const MethodResult& result);
/// One JSON object: scene, views, method and, a bin, [count, sum of probabilities, hits].
std::string reliabilityJson(const MethodResult& result);

/// Methods: observed, pixel-aligned, nearest, box, completed, oracle-occupancy (the completer's
/// latents in the nodes that the room's surfaces pass or, of a folder, that any view saw filled),
/// oracle-latents (the same, and where all views have a latent theirs), and completed-tau-T for
/// each T of `taus`. With a `picture` writes a PNG: of at most four target
/// views the truth, then a column a method but pixel-aligned, which looks like observed.
std::vector<MethodResult> evaluateScene(const EvaluationScene& scene, const Encoder& encoder,
                                        const Completer& completer, const SceneSettings& settings,
                                        const std::vector<double>& taus, const std::string& picture,
                                        Progress& progress, const UserNets& nets = {});

/// Mean over scenes of each method, scene "mean"; values that are NaN in a scene are left out
/// there.
std::vector<MethodResult> meanResults(const std::vector<MethodResult>& results);
/// Sample standard deviation over scenes of each method, scene "std"; NaN with fewer than two
/// values.
std::vector<MethodResult> deviationResults(const std::vector<MethodResult>& results);

}  // namespace vdbc
