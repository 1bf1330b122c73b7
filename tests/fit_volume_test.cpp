// Laws of the volume that is fitted to views: gravity and walls are found, the box holds what was
// seen, the transform's inverse is exact.
#include "vdb/fit_volume.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <random>

#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

/// A box seen from inside; `room_from_world` takes world points to the room's axes.
struct Room {
  Eigen::AlignedBox3d box;
  Eigen::Isometry3d room_from_world;
};

struct Capture {
  std::vector<Camera> cameras;
  std::vector<std::vector<float>> depths;

  std::vector<DepthView> views() const {
    std::vector<DepthView> out;
    for (size_t i = 0; i < cameras.size(); ++i) out.push_back({cameras[i], depths[i].data()});
    return out;
  }
};

Camera roomCamera(const Room& room, const Vector3d& eye_room, const Vector3d& target_room) {
  const Vector3d z = (target_room - eye_room).normalized();
  const Vector3d x = z.cross(Vector3d::UnitZ()).normalized();
  Eigen::Isometry3d room_from_camera = Eigen::Isometry3d::Identity();
  room_from_camera.linear() << x, z.cross(x), z;
  room_from_camera.translation() = eye_room;
  Camera camera{160, 120, 90, 90, 80, 60, room.room_from_world.inverse() * room_from_camera};
  return camera;
}

/// Planar depth of the walls: the ray leaves the box at the nearest of its far faces.
std::vector<float> renderDepth(const Room& room, const Camera& camera) {
  std::vector<float> depth;
  const Eigen::Isometry3d room_from_camera = room.room_from_world * camera.world_from_camera;
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const Vector3d ray =
          room_from_camera.linear() *
          Vector3d((x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1);
      double z = 1e9;
      for (int axis = 0; axis < 3; ++axis) {
        const double face = ray[axis] > 0 ? room.box.max()[axis] : room.box.min()[axis];
        if (ray[axis] != 0)
          z = std::min(z, (face - room_from_camera.translation()[axis]) / ray[axis]);
      }
      depth.push_back(float(z));
    }
  return depth;
}

Capture captureRoom(const Room& room) {
  Capture capture;
  const Vector3d centre = room.box.center();
  for (const Vector3d& offset : {Vector3d(1, 0.3, -0.2), Vector3d(-0.6, 1, -0.1),
                                 Vector3d(-1, -0.5, 0.1), Vector3d(0.2, -1, 0)}) {
    capture.cameras.push_back(roomCamera(room, centre - 0.5 * offset, centre + offset));
    capture.depths.push_back(renderDepth(room, capture.cameras.back()));
  }
  return capture;
}

Room roomWith(const Matrix3d& world_from_room, const Vector3d& shift) {
  Room room{{Vector3d(-2, -1.5, 0), Vector3d(3, 2, 2.6)}, Eigen::Isometry3d::Identity()};
  room.room_from_world.linear() = world_from_room.transpose();
  room.room_from_world.translation() = -world_from_room.transpose() * shift;
  return room;
}

std::vector<Vector3d> pointsOf(const Capture& capture) {
  std::vector<Vector3d> points;
  for (size_t i = 0; i < capture.cameras.size(); ++i) {
    const Camera& c = capture.cameras[i];
    for (int y = 0; y < c.height; y += 3)
      for (int x = 0; x < c.width; x += 3)
        points.push_back(
            c.unproject(x + 0.5, y + 0.5, double(capture.depths[i][size_t(y * c.width + x)])));
  }
  return points;
}

double degrees(double radians) { return radians * 180 / M_PI; }

TEST(FitVolume, FindsGravityAndTheYawOfTheWalls) {
  for (const Vector3d& up : {Vector3d(0, 0, 1), Vector3d(0, 1, 0), Vector3d(-1, 0, 0),
                             Vector3d(0.2, -0.9, 0.3).normalized()})
    for (double yaw_deg : {-40.0, -12.5, 0.0, 3.3, 44.0}) {
      Matrix3d upright;
      upright.col(2) = up;
      upright.col(0) = up.cross(Vector3d(0.3, 0.5, -0.7)).normalized();
      upright.col(1) = up.cross(upright.col(0));
      const Matrix3d world_from_room =
          upright * Eigen::AngleAxisd(yaw_deg * M_PI / 180, Vector3d::UnitZ()).toRotationMatrix();
      const Room room = roomWith(world_from_room, {5, -7, 3});
      const Capture capture = captureRoom(room);
      VolumeSettings settings;
      settings.up = up;
      const VoxelFrame frame = fitVolume(capture.views(), settings, {});
      const Matrix3d grid = frame.world_from_grid.linear();
      EXPECT_LT((grid.transpose() * grid - Matrix3d::Identity()).norm(), 1e-12);
      EXPECT_NEAR(grid.determinant(), 1, 1e-12);
      EXPECT_LT((grid.col(2) - up).norm(), 1e-12);
      // Each grid axis is a room axis, up to quarter turns.
      const Matrix3d between = world_from_room.transpose() * grid;
      const double error = std::remainder(degrees(std::atan2(between(1, 0), between(0, 0))), 90);
      EXPECT_LT(std::abs(error), 0.2) << "yaw " << yaw_deg << " up " << up.transpose();
    }
}

TEST(FitVolume, DoesNotTurnWithoutWallsOrWhenToldNotTo) {
  const Matrix3d turned = Eigen::AngleAxisd(0.4, Vector3d::UnitZ()).toRotationMatrix();
  const Capture room = captureRoom(roomWith(turned, {0, 0, 0}));
  VolumeSettings settings;
  settings.align_walls = false;
  EXPECT_TRUE(fitVolume(room.views(), settings, {}).world_from_grid.linear().isIdentity());

  // A sphere from inside: every direction is as good as another.
  Capture sphere;
  for (double angle : {0.0, 1.6, 3.1, 4.7}) {
    sphere.cameras.push_back(roomCamera(roomWith(Matrix3d::Identity(), {0, 0, 0}), {0, 0, 0},
                                        {std::cos(angle), std::sin(angle), 0}));
    const Camera& c = sphere.cameras.back();
    std::vector<float> depth;
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x)
        depth.push_back(
            float(3 / Vector3d((x + 0.5 - c.cx) / c.fx, (y + 0.5 - c.cy) / c.fy, 1).norm()));
    sphere.depths.push_back(depth);
  }
  EXPECT_TRUE(fitVolume(sphere.views(), {}, {}).world_from_grid.linear().isIdentity());
}

TEST(FitVolume, HoldsCamerasAndPointsTightlyInWholeCoarseNodes) {
  const Matrix3d turned = Eigen::AngleAxisd(0.3, Vector3d::UnitZ()).toRotationMatrix();
  const Room room = roomWith(turned, {100, -50, 10});
  const Capture capture = captureRoom(room);
  for (float voxel_m : {0.1f, 0.03f}) {
    VolumeSettings settings;
    settings.voxel_m = voxel_m;
    const VoxelFrame frame = fitVolume(capture.views(), settings, {});
    const auto inside = [&](const Vector3d& p) {
      return frame.bounds.isInside(Coord::floor(
          openvdb::Vec3d(frame.toIndex(p).x(), frame.toIndex(p).y(), frame.toIndex(p).z())));
    };
    for (const Vector3d& p : pointsOf(capture)) ASSERT_TRUE(inside(p)) << p.transpose();
    for (const Camera& c : capture.cameras) EXPECT_TRUE(inside(c.world_from_camera.translation()));
    const Vector3d extent = room.box.sizes() + 2 * Vector3d(settings.margin_m, settings.margin_m,
                                                            settings.vertical_margin_m);
    std::array<int, 3> dims{frame.bounds.dim().x(), frame.bounds.dim().y(), frame.bounds.dim().z()};
    if (std::abs(frame.world_from_grid.linear().col(0).dot(turned.col(0))) < 0.5)
      std::swap(dims[0], dims[1]);
    for (int axis = 0; axis < 3; ++axis) {
      EXPECT_EQ(dims[size_t(axis)] % 4, 0);
      EXPECT_EQ(frame.bounds.min()[axis] & 3, 0);
      // Not larger than the room with its margins and a coarse node at each side; the turn is found
      // to 0.2 degrees, which is 2 cm here.
      EXPECT_LE(dims[size_t(axis)] * double(voxel_m), extent[axis] + 8 * double(voxel_m) + 0.04);
    }
  }
}

TEST(FitVolume, OutliersDoNotGrowTheVolume) {
  Capture capture = captureRoom(roomWith(Matrix3d::Identity(), {0, 0, 0}));
  const VoxelFrame clean = fitVolume(capture.views(), {}, {});
  CarveSettings keep_all;
  keep_all.flying_pixel_ratio = 0;
  for (auto& depth : capture.depths)
    for (size_t i = 0; i < depth.size(); i += 401) depth[i] = 18.f;
  const VoxelFrame dirty = fitVolume(capture.views(), {}, keep_all);
  const double few_voxels = 4 * double(clean.voxel_m) + 1e-6;
  for (int axis = 0; axis < 3; ++axis) {
    EXPECT_LE(
        std::abs(clean.toWorld(Vector3d::Zero())[axis] - dirty.toWorld(Vector3d::Zero())[axis]),
        few_voxels);
    EXPECT_LE(std::abs(clean.bounds.max()[axis] - dirty.bounds.max()[axis]), 4);
  }
}

TEST(FitVolume, BoundsOfTheUserAreTheVolume) {
  const Matrix3d turned = Eigen::AngleAxisd(0.3, Vector3d::UnitZ()).toRotationMatrix();
  const Capture capture = captureRoom(roomWith(turned, {0, 0, 0}));
  VolumeSettings settings;
  settings.bounds = Eigen::AlignedBox3d(Vector3d(-2, -1.2, 0), Vector3d(2, 1.2, 2.8));
  VoxelFrame frame = fitVolume(capture.views(), settings, {});
  EXPECT_TRUE(frame.world_from_grid.linear().isIdentity());
  EXPECT_EQ(frame.bounds, CoordBBox(Coord(0), Coord(39, 23, 27)));
  EXPECT_LT((frame.toWorld(Vector3d::Zero()) - Vector3d(-2, -1.2, 0)).norm(), 1e-9);
  settings.up = Vector3d::UnitY();  // the same box; grid z is world y, grid y is world -z
  frame = fitVolume(capture.views(), settings, {});
  EXPECT_EQ(frame.bounds, CoordBBox(Coord(0), Coord(39, 27, 23)));
  EXPECT_LT((frame.toWorld(Vector3d::Zero()) - Vector3d(-2, -1.2, 2.8)).norm(), 1e-9);
}

TEST(FitVolume, FollowsThePlaceWhereverItLies) {
  const Matrix3d turned = Eigen::AngleAxisd(0.3, Vector3d::UnitZ()).toRotationMatrix();
  const Vector3d shift(500000.25, 4649776.5, 123.75);
  const VoxelFrame near = fitVolume(captureRoom(roomWith(turned, {1, 2, 3})).views(), {}, {}),
                   far = fitVolume(captureRoom(roomWith(turned, Vector3d(1, 2, 3) + shift)).views(),
                                   {}, {});
  EXPECT_EQ(near.bounds.min(), Coord(0));
  EXPECT_EQ(far.bounds, near.bounds);
  for (const Vector3d& corner : {Vector3d(0, 0, 0), Vector3d(60, 50, 30)})
    EXPECT_LT((far.toWorld(corner) - near.toWorld(corner) - shift).norm(), 1e-6);
}

TEST(FitVolume, WallsLieAmidVoxels) {
  const Capture capture = captureRoom(roomWith(Matrix3d::Identity(), {0.123, 4.567, 8.9}));
  const VoxelFrame frame = fitVolume(capture.views(), {}, {});
  const Vector3d corner = frame.toIndex(Vector3d(-2 + 0.123, -1.5 + 4.567, 0 + 8.9));
  for (int axis = 0; axis < 3; ++axis)
    EXPECT_NEAR(corner[axis] - std::floor(corner[axis]), .25, .1) << axis;
}

TEST(FitVolume, InverseTransformIsExact) {
  const Capture capture = captureRoom(roomWith(
      Eigen::AngleAxisd(0.7, Vector3d(1, 2, 3).normalized()).toRotationMatrix(), {100, 20, -30}));
  VolumeSettings settings;
  settings.up = Vector3d(0.3, -0.5, 0.8).normalized();
  const VoxelFrame frame = fitVolume(capture.views(), settings, {});
  std::mt19937 random(1);
  std::uniform_real_distribution<double> metres(-200, 200);
  for (int i = 0; i < 1000; ++i) {
    const Vector3d p(metres(random), metres(random), metres(random));
    EXPECT_LT((frame.toWorld(frame.toIndex(p)) - p).norm(), 1e-6);
    EXPECT_LT((frame.toIndex(frame.toWorld(p)) - p).norm(), 1e-6);
  }
}

TEST(FitVolume, BadInputThrows) {
  Capture capture = captureRoom(roomWith(Matrix3d::Identity(), {0, 0, 0}));
  VolumeSettings settings;
  EXPECT_THROW(fitVolume({}, settings, {}), Error);
  for (float voxel_m : {0.f, -1.f, NAN, 1e-4f}) {
    settings.voxel_m = voxel_m;
    EXPECT_THROW(fitVolume(capture.views(), settings, {}), Error) << voxel_m;
  }
  settings = {};
  settings.up = Vector3d::Zero();
  EXPECT_THROW(fitVolume(capture.views(), settings, {}), Error);
  settings = {};
  settings.bounds = Eigen::AlignedBox3d(Vector3d(1, 1, 1), Vector3d(0, 0, 0));
  EXPECT_THROW(fitVolume(capture.views(), settings, {}), Error);
  const Capture far = captureRoom(roomWith(Matrix3d::Identity(), {1e11, 0, 0}));
  EXPECT_THROW(fitVolume(far.views(), {}, {}), Error);
  for (auto& depth : capture.depths) std::fill(depth.begin(), depth.end(), 0.f);
  EXPECT_THROW(fitVolume(capture.views(), {}, {}), Error);
}

}  // namespace
}  // namespace vdbc
