#include "vdb/camera.h"

#include <gtest/gtest.h>

#include <cmath>

namespace vdbc {
namespace {

using Eigen::Vector3d;

TEST(Camera, LooksAlongADirectionLevelWithUp) {
  const Vector3d up = Vector3d(.3, -.2, 2);  // of any length
  for (const Vector3d& forward :
       {Vector3d(1, 2, -.5), Vector3d(-1, 0, 0), Vector3d(.3, -.2, 1.9)}) {
    const Eigen::Matrix3d r = lookAlong(forward.normalized(), up);
    EXPECT_TRUE((r.transpose() * r).isIdentity(1e-12));
    EXPECT_NEAR(r.determinant(), 1, 1e-12);
    EXPECT_TRUE(r.col(2).isApprox(forward.normalized()));
    EXPECT_NEAR(r.col(0).dot(up), 0, 1e-12);
    EXPECT_LT(r.col(1).dot(up), 0);  // y is down
  }
}

TEST(Camera, LooksStraightUpAndDown) {
  const Vector3d up(0, 0, 1);
  for (double sign : {-1., 1.}) {
    const Eigen::Matrix3d r = lookAlong(sign * up, up);
    EXPECT_TRUE((r.transpose() * r).isIdentity(1e-12));
    EXPECT_NEAR(r.determinant(), 1, 1e-12);
    EXPECT_TRUE(r.col(2).isApprox(sign * up));
  }
}

TEST(Camera, LooksAtItsTarget) {
  const Vector3d eye(3, -1, 1.5), target(.5, 2, .25), up(0, 0, 1);
  const Camera camera{640, 480, 500, 510, 320, 240, lookAt(eye, target, up)};
  EXPECT_TRUE(camera.world_from_camera.translation().isApprox(eye));
  const Vector3d seen = camera.project(target), above = camera.project(target + .1 * up);
  EXPECT_TRUE(seen.isApprox(Vector3d(320, 240, (target - eye).norm())));
  EXPECT_NEAR(above.x(), 320, 1e-9);
  EXPECT_LT(above.y(), 240);
}

TEST(Camera, FindsThePixelOfAPointOrNone) {
  const Camera camera{4, 3, 2, 2, 2, 1.5, Eigen::Isometry3d::Identity()};
  for (int i = 0; i < 12; ++i)
    for (const double z : {.5, 20.})
      EXPECT_EQ(camera.pixelAt(camera.project(camera.unproject(i % 4 + .3, i / 4 + .9, z))), i);
  EXPECT_EQ(camera.pixelAt({0, 0, 1}), 0);
  const double nan = std::nan("");
  for (const Vector3d& none :
       {Vector3d(4, 1, 1), Vector3d(1, 3, 1), Vector3d(-.1, 1, 1), Vector3d(1, -.1, 1),
        Vector3d(1, 1, 0), Vector3d(1, 1, -1), Vector3d(nan, 1, 1), Vector3d(1, 1, nan)})
    EXPECT_EQ(camera.pixelAt(none), -1) << none.transpose();
}

}  // namespace
}  // namespace vdbc
