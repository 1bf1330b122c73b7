// A place in survey coordinates, hundreds of kilometres from the world's origin, is completed as it
// would be beside it: the same voxels, and Gaussians in its own place.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>

#include "houdini_style_tools/complete.h"
#include "splat/ply.h"
#include "splat/points_vdb.h"
#include "tests/files.h"
#include "tests/simple_room.h"

namespace vdbc {
namespace {

struct Made {
  SceneVoxels voxels;
  Gaussians points;
};

Made completed(const Eigen::Vector3d& shift, const std::string& stem) {
  const Encoder encoder(kWeights + "/encoder.safetensors");
  const Completer completer(kWeights + "/completer.safetensors");
  std::vector<View> views = simpleRoomViews(2, 96, 72, 7);
  for (View& v : views) v.camera.world_from_camera.pretranslate(shift);
  Progress silent;
  SceneSettings settings;
  settings.completion.tau = .5f;  // no token's probability is within rounding of it
  writePlace(completeScene(views, encoder, completer, settings, silent), views, encoder, settings,
             stem, silent);
  return {readSceneVdb(stem + ".vdb"), readPointsVdb(stem + ".points.vdb")};
}

Eigen::Vector3d placeOf(const Gaussians& g, size_t row) {
  return g.origin + g.mean[row].cast<double>();
}

/// How many of `far` have no partner of their own in `near`, moved by `shift`, within
/// `tolerance_m`. (Files keep points by voxels, in which neighbours may change places.)
int64_t unmatched(const Gaussians& near, const Gaussians& far, const Eigen::Vector3d& shift,
                  double tolerance_m) {
  const auto cellOf = [&](const Eigen::Vector3d& p) {
    const Eigen::Vector3d c = (p / .02).array().floor();
    return Coord(int(c.x()), int(c.y()), int(c.z()));
  };
  std::map<Coord, std::vector<Eigen::Vector3d>> cells;
  for (size_t i = 0; i < near.mean.size(); ++i) {
    const Eigen::Vector3d p = placeOf(near, i);
    cells[cellOf(p)].push_back(p);
  }
  int64_t alone = 0;
  for (size_t i = 0; i < far.mean.size(); ++i) {
    const Eigen::Vector3d p = placeOf(far, i) - shift;
    bool found = false;
    for (const Coord& c : CoordBBox(cellOf(p).offsetBy(-1), cellOf(p).offsetBy(1))) {
      const auto cell = cells.find(c);
      if (found || cell == cells.end()) continue;
      auto& there = cell->second;
      const auto partner = std::find_if(
          there.begin(), there.end(), [&](const auto& q) { return (p - q).norm() < tolerance_m; });
      if (partner == there.end()) continue;
      there.erase(partner), found = true;
    }
    alone += !found;
  }
  return alone;
}

TEST(Survey, APlaceFarFromTheOriginIsTheSamePlace) {
  if (!std::filesystem::exists(kWeights + "/encoder.safetensors"))
    GTEST_SKIP() << "no trained weights in " << kWeights;
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
  // What stands before the discs is cut until it does not: a rounding may ask for one cut more.
  EXPECT_LE(unmatched(near.points, far.points, shift, .001), near.points.size() / 2000);
  EXPECT_LT(plyStep(near.points), 1e-5);
  EXPECT_GT(plyStep(far.points), .1);  // 4,650 km in single precision: half a metre
}

}  // namespace
}  // namespace vdbc
