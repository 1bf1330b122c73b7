// Laws of the views that training shows (docs/method.md, section 5.1).
#include "examples/lab/condition_views.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "tests/simple_room.h"
#include "vdb/fit_volume.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;

const std::vector<View>& farViews() {
  static const std::vector<View> views = simpleRoomViews(8, 64, 48, 3);
  return views;
}

TEST(Cropped, SeesWhatTheViewSees) {
  const View& view = farViews()[0];
  std::mt19937_64 random(1);
  for (const double zoom : {1., 1.3, 2.}) {
    const View crop = cropped(view, zoom, random);
    ASSERT_EQ(crop.depth.size(), view.depth.size());
    EXPECT_NEAR(crop.camera.fx / view.camera.fx, zoom, .05 * zoom);
    for (int j = 0; j < 48; j += 5)
      for (int i = 0; i < 64; i += 5) {
        const size_t pixel = size_t(j * 64 + i);
        const Vector3d p = crop.camera.unproject(i + .5, j + .5, double(crop.depth[pixel]));
        const Vector3d at = view.camera.project(p);
        const int column = int(std::floor(at.x())), row = int(std::floor(at.y()));
        ASSERT_TRUE(column >= 0 && column < 64 && row >= 0 && row < 48);
        EXPECT_EQ(crop.depth[pixel], view.depth[size_t(row * 64 + column)]);
        // Colour is a mean of the pixels around.
        float low = 1, high = 0;
        for (int y = std::max(row - 1, 0); y <= std::min(row + 1, 47); ++y)
          for (int x = std::max(column - 1, 0); x <= std::min(column + 1, 63); ++x) {
            const float c = view.colour.data[size_t(3 * (y * 64 + x))];
            low = std::min(low, c), high = std::max(high, c);
          }
        EXPECT_GE(crop.colour.data[3 * pixel], low - 1e-6f);
        EXPECT_LE(crop.colour.data[3 * pixel], high + 1e-6f);
      }
  }
}

TEST(SensorFaults, AreThoseOfADepthCamera) {
  std::mt19937_64 random(2);
  int64_t lost = 0, kept = 0;
  for (int trial = 0; trial < 20; ++trial) {
    const View& clean = farViews()[size_t(trial) % 8];
    View view = clean;
    addSensorFaults(&view, random);
    for (size_t p = 0; p < view.depth.size(); ++p) {
      if (view.depth[p] == 0) {
        ++lost;
        continue;
      }
      ++kept;
      const double z = double(clean.depth[p]);
      EXPECT_GE(z, .3);
      EXPECT_LE(z, 7);
      EXPECT_LT(std::abs(double(view.depth[p]) - z),
                6 * 1.5 * (.0012 + .0019 * (z - .4) * (z - .4)));
    }
    for (const float c : view.colour.data) EXPECT_TRUE(c >= 0 && c <= 1);
    const Eigen::Isometry3d moved =
        clean.camera.world_from_camera.inverse() * view.camera.world_from_camera;
    EXPECT_LT(moved.translation().norm(), .05);
    EXPECT_LT(Eigen::AngleAxisd(moved.linear()).angle(), .03);
    EXPECT_GT(moved.translation().norm(), 0);
  }
  EXPECT_GT(lost, kept / 50);
  EXPECT_GT(kept, lost);
}

TEST(HandHeldViews, AreNeighbours) {
  const Room room = simpleRoom(3);
  const RoomRenderer renderer(room);
  std::mt19937_64 random(3), again(3);
  const std::vector<View> views = handHeldViews(room, renderer, 32, 1, 5, random),
                          same = handHeldViews(room, renderer, 32, 1, 5, again);
  ASSERT_EQ(views.size(), size_t(kHandViews));
  for (size_t i = 0; i < views.size(); ++i) {
    EXPECT_EQ(views[i].colour.data, same[i].colour.data);
    const Eigen::Isometry3d moved =
        views[0].camera.world_from_camera.inverse() * views[i].camera.world_from_camera;
    EXPECT_LE(moved.translation().norm(), .6);
    EXPECT_LE(Eigen::AngleAxisd(moved.linear()).angle(), 1.1);
  }
}

TEST(ConditionViews, AreOfSevenKinds) {
  const std::vector<View>& far = farViews();
  const std::vector<View> hand(far.begin(), far.begin() + kHandViews);
  const auto isClean = [&](const View& view) {
    return std::any_of(far.begin(), far.end(),
                       [&](const View& other) { return other.depth == view.depth; });
  };
  std::mt19937_64 random(4), again(4);
  for (int kind = 0; kind < 7; ++kind) {
    const std::vector<View> views = conditionViews(kind, far, hand, random);
    const size_t least[] = {2, 2, 1, 3, 3, 3, 1}, most[] = {2, 2, 1, 6, 3, 3, 3};
    EXPECT_GE(views.size(), least[kind]) << kind;
    EXPECT_LE(views.size(), most[kind]) << kind;
    if (kind != 2) {  // now and then cropped
      for (const View& view : views) EXPECT_EQ(isClean(view), kind < 4) << kind;
    }
    const std::vector<View> same = conditionViews(kind, far, hand, again);
    ASSERT_EQ(same.size(), views.size());
    for (size_t i = 0; i < views.size(); ++i) EXPECT_EQ(same[i].depth, views[i].depth);
  }
}

TEST(BoundsOf, AreWhatACompletionOfTheseViewsWouldTake) {
  const std::vector<View>& far = farViews();
  std::vector<DepthView> depth;
  for (const View& view : far) depth.push_back(view.depthView());
  const VoxelFrame frame = fitVolume(depth, VolumeSettings(), CarveSettings());
  // Of all views: the frame's own, to a coarse node.
  const CoordBBox all = boundsOf(far, frame);
  for (int axis = 0; axis < 3; ++axis) {
    EXPECT_LE(std::abs(all.min()[axis] - frame.bounds.min()[axis]), 4);
    EXPECT_LE(std::abs(all.max()[axis] - frame.bounds.max()[axis]), 4);
  }
  for (const View& view : far) {
    const CoordBBox box = boundsOf({view}, frame);
    const Vector3d eye = frame.toIndex(view.camera.world_from_camera.translation());
    for (int axis = 0; axis < 3; ++axis) {
      EXPECT_EQ(box.min()[axis] % 4, 0);
      EXPECT_EQ((box.max()[axis] + 1) % 4, 0);
      EXPECT_GE(box.min()[axis], frame.bounds.min()[axis]);
      EXPECT_LE(box.max()[axis], frame.bounds.max()[axis]);
      EXPECT_GE(eye[axis], box.min()[axis]);
      EXPECT_LE(eye[axis], box.max()[axis] + 1);
    }
  }
  View blind = far[0];
  blind.depth.assign(blind.depth.size(), 0.f);
  EXPECT_TRUE(boundsOf({blind}, frame).empty());
}

}  // namespace
}  // namespace vdbc
