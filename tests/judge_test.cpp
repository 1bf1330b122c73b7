// How completion is judged by other views: by hand on a few voxels and pixels, and that nothing,
// fog and veils lose.
#include "examples/lab/judge.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "tests/simple_room.h"
#include "vdb/carve.h"
#include "vdb/fit_volume.h"

namespace vdbc {
namespace {

SeenSpace spaceOf(const std::vector<Coord>& filled, const std::vector<Coord>& empty) {
  SeenSpace s;
  s.box = CoordBBox(Coord(-100), Coord(100));
  for (const Coord& c : filled) s.filled.setValueOn(c);
  for (const Coord& c : empty) s.empty.setValueOn(c);
  return s;
}

TEST(Judge, VoxelsByHand) {
  // The input saw voxel 0; all views besides that 10 and 20 are filled, 11, 13 and 30 empty.
  const SeenSpace input = spaceOf({Coord(0)}, {}), all = spaceOf({Coord(0), Coord(10), Coord(20)},
                                                                 {Coord(11), Coord(13), Coord(30)});
  // 0 was seen and counts for nothing, 10 is right, 11 is beside it, 13 and 30 are wrong, 50 is
  // beyond what any view knows; twice the same is once.
  const VoxelVerdict v = judgeVoxels(
      input, all, {Coord(0), Coord(10), Coord(10), Coord(11), Coord(13), Coord(30), Coord(50)});
  EXPECT_EQ(v.confirmed, 1);
  EXPECT_EQ(v.contradicted, 3);
  EXPECT_EQ(v.undecided, 1);
  EXPECT_DOUBLE_EQ(v.exact.precision, 1. / 4);
  EXPECT_DOUBLE_EQ(v.exact.recall, 1. / 2);
  EXPECT_DOUBLE_EQ(v.exact.f1, 1. / 3);
  EXPECT_DOUBLE_EQ(v.near.precision, 2. / 4);
  EXPECT_DOUBLE_EQ(v.near.recall, 1. / 2);
  const VoxelVerdict none = judgeVoxels(input, all, {});
  EXPECT_TRUE(std::isnan(none.exact.precision));
  EXPECT_EQ(none.near.recall, 0);
  EXPECT_EQ(none.near.f1, 0);
}

TEST(Judge, PixelsByHand) {
  const float none = 0, nan = std::nanf("");
  //  true depth:          2    2    2    2    2     8    none
  const std::vector<float> truth = {2, 2, 2, 2, 2, 8, none, nan};
  const std::vector<float> depth = {2.05f, 1.6f, 2.4f, none, 1.8f, 8.3f, 1, 1};
  const PixelVerdict v = judgePixels(depth, truth);
  EXPECT_DOUBLE_EQ(v.right, 2. / 6);  // 5 cm at 2 m, 30 cm at 8 m
  EXPECT_DOUBLE_EQ(v.blocked, 1. / 6);
  EXPECT_DOUBLE_EQ(v.behind, 1. / 6);
  EXPECT_DOUBLE_EQ(v.open, 1. / 6);
  EXPECT_TRUE(std::isnan(judgePixels({1}, {0}).right));
}

std::vector<DepthView> depthsOf(const std::vector<View>& views, size_t count) {
  std::vector<DepthView> depths;
  for (size_t i = 0; i < count; ++i) depths.push_back(views[i].depthView());
  return depths;
}

/// A room from two views, and from ten.
struct SeenRoom {
  Progress silent;
  std::vector<View> views = simpleRoomViews(10, 80, 60, 5);
  VoxelFrame frame = fitVolume(depthsOf(views, 2), {}, {});
  SeenSpace input = carve(frame, depthsOf(views, 2), {}, silent);
  SeenSpace all = carve(frame, depthsOf(views, 10), {}, silent);

  double scoreOf(const std::vector<Coord>& filled) const {
    return judgeVoxels(input, all, filled).near.f1;
  }
  std::vector<Coord> unseen() const { return unobservedNodes(input, input.box); }
};

// The score that chooses defaults is the F1 within one voxel.
TEST(Judge, EmptinessFogAndVeilsLose) {
  const SeenRoom room;
  std::mt19937 random(1);
  // A completion as networks make them: a third of what is there is missing, a quarter of what it
  // has stands two voxels off.
  std::vector<Coord> completion;
  for (const Coord& c : filledNodes(room.all)) {
    if (random() % 3 == 0) continue;
    completion.push_back(random() % 4 ? c : c.offsetBy(2, 0, 0));
  }
  const double honest = room.scoreOf(completion);
  EXPECT_GT(honest, .7);
  EXPECT_EQ(room.scoreOf({}), 0);
  EXPECT_LT(room.scoreOf(room.unseen()), honest - .2);  // fog
  // A veil hangs half a metre before every camera that was not input.
  std::vector<Coord> veil;
  for (const Coord& c : room.unseen()) {
    const Eigen::Vector3d p =
        room.frame.toWorld(Eigen::Vector3d(c.x() + .5, c.y() + .5, c.z() + .5));
    for (size_t i = 2; i < room.views.size(); ++i) {
      const Eigen::Vector3d uvz = room.views[i].camera.project(p);
      if (uvz.z() > .4 && uvz.z() < .6 && uvz.x() > 0 && uvz.x() < 80 && uvz.y() > 0 &&
          uvz.y() < 60)
        veil.push_back(c);
    }
  }
  ASSERT_GT(veil.size(), 50u);
  EXPECT_LT(room.scoreOf(veil), honest - .4);
  // With it the completion is worse than without.
  veil.insert(veil.end(), completion.begin(), completion.end());
  EXPECT_LT(room.scoreOf(veil), honest - .01);
}

}  // namespace
}  // namespace vdbc
