#pragma once
// All methods and baselines on scenes that the networks never saw.
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "houdini_style_tools/complete.h"
#include "houdini_style_tools/perceptual.h"
#include "splat/embree_check.h"

namespace vdbc {

/// Views of a room that are not input.
constexpr int kTargetViews = 8;

/// One scene to evaluate: input views, target views and, for procedural rooms, the truth.
struct EvaluationScene {
  std::string name;
  std::vector<View> input, targets;
  Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  std::optional<TriangleMesh> truth;
  std::vector<Eigen::Vector3f> free_points;  // origins of leak rays; empty without truth
};

/// Scenes named by SPEC: `rooms:SEED-SEED` (or rooms:SEED), or a folder with transforms.json of which
/// `views` random frames, or those of `frames`, are input and the rest targets.
struct SceneList {
  int64_t count = 0;
  std::function<EvaluationScene(int64_t)> scene;
};
/// Throws UsageError for a malformed SPEC, Error for seeds reserved for training.
SceneList sceneList(const std::string& spec, int views, const std::vector<int>& frames, uint64_t seed);

/// A set of nodes against the true one; NaN is 0/0.
struct SetScores {
  double precision = 0, recall = 0, f1 = 0;
};
SetScores setScores(const std::set<Coord>& filled, const std::set<Coord>& truth);

/// Share of rays from the free points of a scene with truth that meet none of `voxels` before they have
/// passed the true surface by two voxels.
double sceneLeak(const EvaluationScene& scene, const VoxelFrame& frame, const std::vector<Coord>& voxels);

/// The user's own networks; null where there is none.
struct UserNets {
  std::shared_ptr<const PerceptualNet> lpips;
  std::shared_ptr<const FeatureNet> features;
};

/// What one method reached on one scene; NaN is printed as null (0/0, or no truth).
struct MethodResult {
  std::string scene, method;
  int views = 0;
  double psnr = 0, ssim = 0, flip = 0;  // mean over target views
  double lpips = 0;                     // the same, by the user's network; NaN without one
  // Median depth against the targets' depth, where both are: mean over target views of the median of
  // the absolute difference and of the root mean square, metres.
  double depth_median_m = 0, depth_rmse_m = 0;
  double depth_share = 0;               // of the targets' depths: those with a median depth to compare
  // Between the target pictures of all scenes and what was rendered for them: in the mean only, NaN
  // elsewhere and without a network.
  double fid = std::numeric_limits<double>::quiet_NaN(), kid = std::numeric_limits<double>::quiet_NaN();
  std::vector<std::vector<float>> features, true_features;  // one row a target view
  double precision = 0, recall = 0, f1 = 0;  // 0.2 m nodes that were unobserved, against the true surface
  double leak = 0;                  // share of rays from free space that pass the true surface
  double seconds = 0, peak_rss_mb = 0;
  int64_t gaussians = 0;
};
/// One JSON object, without the features.
std::string resultJson(const MethodResult& result);

/// Methods: observed, nearest, box, completed, oracle-occupancy (rooms only).
std::vector<MethodResult> evaluateScene(const EvaluationScene& scene, const Encoder& encoder,
                                        const Completer& completer, const SceneSettings& settings,
                                        Progress& progress, const UserNets& nets = {});

/// Mean over scenes of each method, scene "mean"; values that are NaN in a scene are left out there.
std::vector<MethodResult> meanResults(const std::vector<MethodResult>& results);

}  // namespace vdbc
