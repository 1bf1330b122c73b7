// A place in survey coordinates, hundreds of kilometres from the world's origin, is completed as it
// would be beside it: the same voxels, and Gaussians in its own place.
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>

#include "houdini_style_tools/complete.h"
#include "splat/ply.h"
#include "splat/points_vdb.h"
#include "tests/files.h"
#include "tests/simple_room.h"

namespace vdbc {
namespace {

constexpr const char* kWeights = VDBC_SOURCE_DIR "/weights/small";

struct Made {
  SceneVoxels voxels;
  Gaussians points;
};

Made completed(const Eigen::Vector3d& shift, const std::string& stem) {
  const Encoder encoder(std::string(kWeights) + "/encoder.safetensors");
  const Completer completer(std::string(kWeights) + "/completer.safetensors");
  std::vector<View> views = simpleRoomViews(2, 96, 72, 7);
  for (View& v : views) v.camera.world_from_camera.pretranslate(shift);
  Progress silent;
  const SceneSettings settings;
  writePlace(completeScene(views, encoder, completer, settings, silent), views, encoder, settings,
             stem, silent);
  return {readSceneVdb(stem + ".vdb"), readPointsVdb(stem + ".points.vdb")};
}

TEST(Survey, APlaceFarFromTheOriginIsTheSamePlace) {
  if (!std::filesystem::exists(kWeights)) GTEST_SKIP() << "no trained weights in " << kWeights;
  const TemporaryFolder folder;
  const Eigen::Vector3d shift(500000.25, 4649776.5, 123.75);
  const Made near = completed(Eigen::Vector3d::Zero(), folder / "near"),
             far = completed(shift, folder / "far");
  ASSERT_GT(near.voxels.size(), 1000);
  EXPECT_EQ(far.voxels.ijk, near.voxels.ijk);
  EXPECT_EQ(far.voxels.observed, near.voxels.observed);
  const Eigen::Vector3d moved = far.voxels.frame.world_from_grid.translation() -
                                near.voxels.frame.world_from_grid.translation();
  EXPECT_LT((moved - shift).norm(), 1e-6);
  ASSERT_EQ(far.points.size(), near.points.size());
  double worst = 0;
  for (size_t i = 0; i < near.points.mean.size(); ++i) {
    const Eigen::Vector3d a = near.points.origin + near.points.mean[i].cast<double>(),
                          b = far.points.origin + far.points.mean[i].cast<double>();
    worst = std::max(worst, (b - a - shift).norm());
  }
  EXPECT_LT(worst, .001);
  EXPECT_LT(plyStep(near.points), 1e-5);
  EXPECT_GT(plyStep(far.points), .1);  // 4,650 km in single precision: half a metre
}

}  // namespace
}  // namespace vdbc
