// Cameras in rooms: free space, heights, coverage.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <set>

#include "tests/simple_room.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Eigen::Vector3f;

RayTarget solidOf(const Room& room) { return RayTarget::fromMesh(solidMesh(room.surface)); }

TEST(Cameras, StandInFreeSpaceAtHumanHeightAndSeeSomething) {
  for (uint64_t seed = 0; seed < 6; ++seed) {
    const Room room = simpleRoom(seed);
    const RayTarget solid = solidOf(room);
    std::mt19937_64 random(seed);
    for (const Camera& c : randomCameras(room, solid, 6, 40, 30, random)) {
      const Eigen::Matrix3d r = c.world_from_camera.linear();
      EXPECT_LT((r * r.transpose() - Eigen::Matrix3d::Identity()).norm(), 1e-9);
      EXPECT_GT(r.determinant(), 0);
      const Vector3d eye = c.world_from_camera.translation();
      EXPECT_TRUE(eye.z() >= 1.1 && eye.z() <= 1.9);
      const Vector3f q = room.world_from_room.inverse() * eye.cast<float>();
      EXPECT_TRUE(q.minCoeff() >= .29f && (q - kSimpleRoomSize).head<2>().maxCoeff() <= -.29f);
      for (const auto& box : room.solids) EXPECT_GE(box.exteriorDistance(q), .29f);
      EXPECT_LT(std::abs(std::asin(r(2, 2))), .4);  // looks roughly level,
      EXPECT_LT(r(2, 1), -.85);                     // upright (y is down),
      EXPECT_NEAR(2 * std::atan(c.height / 2. / c.fy), 70 * M_PI / 180, 1e-9);
    }
  }
}

TEST(Cameras, SameSeedSameCameras) {
  const Room room = simpleRoom(2);
  const RayTarget solid = solidOf(room);
  std::mt19937_64 a(9), b(9);
  const auto first = randomCameras(room, solid, 5, 40, 30, a),
             second = randomCameras(room, solid, 5, 40, 30, b);
  for (size_t i = 0; i < 5; ++i)
    EXPECT_EQ(first[i].world_from_camera.matrix(), second[i].world_from_camera.matrix());
}

TEST(Cameras, NoPlaceIsAnError) {
  Room room = simpleRoom(2);
  const RayTarget solid = solidOf(room);
  room.solids.emplace_back(Vector3f(0, 0, 0), Vector3f(5, 5, 3));
  std::mt19937_64 random(1);
  EXPECT_THROW(randomCameras(room, solid, 1, 40, 30, random), Error);
  EXPECT_THROW(freePoints(room, 1, 1), Error);
}

TEST(Cameras, FreePointsAreInTheAirEvenOfAnLShapedRoomUnderASlope) {
  Room room = simpleRoom(1);
  room.floor = {{0, 0}, {4.2f, 0}, {4.2f, 1.5f}, {2, 1.5f}, {2, 3.4f}, {0, 3.4f}};
  room.ceilings = {{0, 0, 2.6f}, {.5f, 0, 1.2f}};  // low at x = 0
  const std::vector<Vector3f> points = freePoints(room, 300, 3);
  ASSERT_EQ(points.size(), 300u);
  EXPECT_EQ(points, freePoints(room, 300, 3));
  EXPECT_NE(points, freePoints(room, 300, 4));
  for (const Vector3f& p : points) {
    const Vector3f q = room.world_from_room.inverse() * p;
    EXPECT_TRUE(q.minCoeff() > 0 && q.x() < 4.2f && q.y() < 3.4f);
    EXPECT_FALSE(q.x() > 2 && q.y() > 1.5f) << q.transpose();
    EXPECT_LT(q.z(), std::min(2.6f, .5f * q.x() + 1.2f));
    for (const auto& box : room.solids) EXPECT_FALSE(box.contains(q));
  }
}

size_t covered(const RayTarget& solid, const std::vector<Camera>& cameras) {
  std::set<Coord> cells;
  for (const Camera& c : cameras)
    for (const Coord& cell : coveredCells(solid, c)) cells.insert(cell);
  return cells.size();
}

TEST(Cameras, TheChosenSubsetCoversMoreThanARandomOne) {
  double chosen = 0, random_choice = 0;
  for (uint64_t seed = 0; seed < 5; ++seed) {
    const Room room = simpleRoom(seed);
    const RayTarget solid = solidOf(room);
    std::mt19937_64 random(seed);
    const std::vector<Camera> all = randomCameras(room, solid, 24, 64, 64, random);
    const std::vector<Camera> first(all.begin(), all.begin() + 6);
    const std::vector<Camera> best = coveringCameras(solid, all, 6);
    EXPECT_EQ(best.size(), 6u);
    EXPECT_GE(covered(solid, best), covered(solid, first)) << seed;
    chosen += double(covered(solid, best)), random_choice += double(covered(solid, first));
  }
  EXPECT_GT(chosen, 1.08 * random_choice);
}

TEST(Cameras, GreedyChoiceIsTheBruteForceOne) {
  const Room room = simpleRoom(8);
  const RayTarget solid = solidOf(room);
  std::mt19937_64 random(8);
  const std::vector<Camera> all = randomCameras(room, solid, 10, 64, 64, random);
  const std::vector<Camera> chosen = coveringCameras(solid, all, 3);
  std::vector<Camera> so_far;
  for (const Camera& next : chosen) {
    const auto with = [&](const Camera& c) {
      std::vector<Camera> more = so_far;
      more.push_back(c);
      return covered(solid, more);
    };
    for (const Camera& other : all) EXPECT_GE(with(next), with(other));
    so_far.push_back(next);
  }
  EXPECT_THROW(coveringCameras(solid, all, 11), Error);
}

}  // namespace
}  // namespace vdbc
