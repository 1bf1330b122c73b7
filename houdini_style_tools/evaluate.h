#pragma once
// All methods and baselines on scenes that the networks never saw.
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "houdini_style_tools/complete.h"
#include "splat/embree_check.h"

namespace vdbc {

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

/// What one method reached on one scene; NaN is printed as null (0/0, or no truth).
struct MethodResult {
  std::string scene, method;
  int views = 0;
  double psnr = 0, ssim = 0;        // mean over target views
  double precision = 0, recall = 0, f1 = 0;  // 0.2 m nodes that were unobserved, against the true surface
  double leak = 0;                  // share of rays from free space that pass the true surface
  double seconds = 0, peak_rss_mb = 0;
  int64_t gaussians = 0;
};
/// One JSON object.
std::string resultJson(const MethodResult& result);

/// Methods: observed, nearest, box, completed, oracle-occupancy (rooms only).
std::vector<MethodResult> evaluateScene(const EvaluationScene& scene, const Encoder& encoder,
                                        const Completer& completer, const SceneSettings& settings,
                                        Progress& progress);

/// Mean over scenes of each method, scene "mean"; values that are NaN in a scene are left out there.
std::vector<MethodResult> meanResults(const std::vector<MethodResult>& results);

}  // namespace vdbc
