// Laws of views made of volumes: depth is where the ray meets the surface, colour is the surface's,
// cameras stand in free space, and unsuitable files throw.
#include <gtest/gtest.h>
#include <openvdb/io/File.h>
#include <openvdb/math/Maps.h>
#include <openvdb/openvdb.h>
#include <openvdb/tools/LevelSetSphere.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <set>
#include <tuple>

#include "encoder/views/read_views.h"
#include "splat/rays.h"
#include "splat/view.h"
#include "tests/vdb_files.h"
#include "vdb/fit_volume.h"
#include "vdb/grid_instances.h"
#include "vdb/scene_vdb.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;

constexpr double kVoxelM = 0.06;
constexpr double kClearanceM = 0.3;
constexpr double kCornerVoxels = 0.5;  // trilinear values round the corner where three walls meet

/// A room with walls half a metre thick: `inner` is free, and so is what lies outside of `outer`.
const Eigen::AlignedBox3d kInner(Vector3d(0.31, -1.02, 0.013), Vector3d(4.84, 2.37, 2.61));
const Eigen::AlignedBox3d kOuter(kInner.min() - Vector3d::Constant(.5),
                                 kInner.max() + Vector3d::Constant(.5));

Eigen::Isometry3d turned() {
  Eigen::Isometry3d world_from_room = Eigen::Isometry3d::Identity();
  world_from_room.linear() =
      Eigen::AngleAxisd(0.7, Vector3d(.2, -.5, 1).normalized()).toRotationMatrix();
  world_from_room.translation() = Vector3d(-3.1, 12.7, .4);
  return world_from_room;
}

/// Signed distance to a box, negative inside.
double boxDistance(const Eigen::AlignedBox3d& box, const Vector3d& p) {
  const Vector3d q = (p - box.center()).cwiseAbs() - box.sizes() / 2;
  return q.cwiseMax(0).norm() + std::min(q.maxCoeff(), 0.);
}
double roomHeight(const Vector3d& p) {
  return std::max(-boxDistance(kInner, p), boxDistance(kOuter, p));
}

/// A cell-centred transform of cubic voxels.
openvdb::math::Transform::Ptr transformOf(const Eigen::Isometry3d& world_from_room) {
  openvdb::Mat4d m = openvdb::Mat4d::identity();
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) m[row][col] = kVoxelM * world_from_room.linear()(col, row);
    m[3][row] = world_from_room.translation()[row];
  }
  return std::make_shared<openvdb::math::Transform>(std::make_shared<openvdb::math::AffineMap>(m));
}

/// Calls set(ijk, place in the room's frame) for all voxels of the room.
void forVoxels(const std::function<void(const Coord&, const Vector3d&)>& set) {
  const Vector3d low = kOuter.min() / kVoxelM, high = kOuter.max() / kVoxelM;
  const CoordBBox box(Coord::floor(openvdb::Vec3d(low.x(), low.y(), low.z())).offsetBy(-5),
                      Coord::ceil(openvdb::Vec3d(high.x(), high.y(), high.z())).offsetBy(5));
  for (const Coord& ijk : box) set(ijk, kVoxelM * Vector3d(ijk.x(), ijk.y(), ijk.z()));
}

FloatGrid::Ptr levelSetRoom(const Eigen::Isometry3d& world_from_room) {
  const auto band = float(3 * kVoxelM);
  auto grid = FloatGrid::create(band);
  auto accessor = grid->getAccessor();
  forVoxels([&](const Coord& ijk, const Vector3d& p) {
    const auto height = float(roomHeight(p));
    if (std::abs(height) < band)
      accessor.setValueOn(ijk, height);
    else if (height < 0)
      accessor.setValueOff(ijk, -band);
  });
  grid->setGridClass(openvdb::GRID_LEVEL_SET);
  grid->setName("walls");
  grid->setTransform(transformOf(world_from_room));
  return grid;
}

/// Half of its maximum, 3, where the surface is.
FloatGrid::Ptr fogRoom(const Eigen::Isometry3d& world_from_room) {
  auto grid = FloatGrid::create();
  auto accessor = grid->getAccessor();
  forVoxels([&](const Coord& ijk, const Vector3d& p) {
    const double density = 3 * std::clamp(.5 - roomHeight(p) / (4 * kVoxelM), 0., 1.);
    if (density > 0) accessor.setValueOn(ijk, float(density));
  });
  grid->setName("density");
  grid->setTransform(transformOf(world_from_room));
  return grid;
}

/// The face of the inner box nearest to p: 2 axis + side.
int faceOf(const Vector3d& p) {
  int face = 0;
  double best = std::numeric_limits<double>::max();
  for (int i = 0; i < 6; ++i) {
    const double d = std::abs(p[i / 2] - (i % 2 ? kInner.max() : kInner.min())[i / 2]);
    if (d < best) best = d, face = i;
  }
  return face;
}
openvdb::Vec3f faceColour(int face) {
  return {.1f + .1f * float(face), .8f - .1f * float(face), face % 2 ? .9f : .05f};
}

/// Scene-linear colours in the walls, of no transform but the room's own.
Vec3SGrid::Ptr roomColours(const Eigen::Isometry3d& world_from_room) {
  auto grid = Vec3SGrid::create();
  auto accessor = grid->getAccessor();
  forVoxels([&](const Coord& ijk, const Vector3d& p) {
    const double d = boxDistance(kInner, p);
    if (d > 0 && d < 2 * kVoxelM) accessor.setValueOn(ijk, faceColour(faceOf(p)));
  });
  grid->setName("Cd");
  grid->setTransform(transformOf(world_from_room));
  return grid;
}

class VolumeViews : public ::testing::Test {
 protected:
  static void SetUpTestSuite() { openvdb::initialize(); }

  std::string write(const openvdb::GridPtrVec& grids, const openvdb::MetaMap& metadata = {}) const {
    const std::string path = folder_ / "room.vdb";
    std::filesystem::remove(path);
    openvdb::io::File(path).write(grids, metadata);
    return path;
  }
  void expectThrows(const std::string& path, const std::string& part) const {
    try {
      readViews(path);
      ADD_FAILURE() << "no Error with " << part;
    } catch (const Error& error) {
      const std::string message = error.what();
      EXPECT_NE(message.find(path), std::string::npos) << message;
      EXPECT_NE(message.find(part), std::string::npos) << message;
      EXPECT_EQ(message.find('\n'), std::string::npos) << message;
    }
  }

  TemporaryFolder folder_;
};

/// Where a view's pixel lies, in the room's frame.
Vector3d pointOf(const View& view, int x, int y, const Eigen::Isometry3d& world_from_room) {
  const double z = double(view.depth[size_t(y) * size_t(view.camera.width) + size_t(x)]);
  return world_from_room.inverse() * view.camera.unproject(x + .5, y + .5, z);
}

/// Planar depth at which the ray of a pixel leaves the room.
double depthOfWalls(const View& view, int x, int y, const Eigen::Isometry3d& world_from_room) {
  const Vector3d origin = world_from_room.inverse() * view.camera.world_from_camera.translation();
  const Vector3d ray =
      world_from_room.inverse() * view.camera.unproject(x + .5, y + .5, 1) - origin;
  double z = std::numeric_limits<double>::max();
  for (int axis = 0; axis < 3; ++axis)
    z = std::min(z,
                 ((ray[axis] > 0 ? kInner.max() : kInner.min())[axis] - origin[axis]) / ray[axis]);
  return z;
}

/// Cameras are inside, clear of the walls; every pixel has the depth of the walls.
void expectRoom(const std::vector<View>& views, const Eigen::Isometry3d& world_from_room) {
  ASSERT_EQ(views.size(), 12u);
  std::vector<double> errors;
  for (const View& view : views) {
    const Vector3d place = world_from_room.inverse() * view.camera.world_from_camera.translation();
    EXPECT_LE(boxDistance(kInner, place), -kClearanceM) << view.name;
    for (int y = 0; y < view.camera.height; ++y)
      for (int x = 0; x < view.camera.width; ++x) {
        const Vector3d p = pointOf(view, x, y, world_from_room);
        ASSERT_LT(std::abs(boxDistance(kInner, p)), kCornerVoxels * kVoxelM)
            << view.name << " " << x << " " << y;
        const double z = double(view.depth[size_t(y) * size_t(view.camera.width) + size_t(x)]);
        errors.push_back(std::abs(z - depthOfWalls(view, x, y, world_from_room)));
      }
  }
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 1e-5);
  EXPECT_LT(errors[errors.size() * 95 / 100], .1 * kVoxelM);
  EXPECT_LT(errors[errors.size() * 99 / 100], .3 * kVoxelM);
}

// --- closed forms ---

TEST_F(VolumeViews, LevelSetDepthIsTheWalls) {
  const Eigen::Isometry3d identity = Eigen::Isometry3d::Identity();
  const std::string path = write({levelSetRoom(identity)});
  const std::vector<View> views = readViews(path);
  expectRoom(views, identity);
  EXPECT_EQ(conventionalUp(path), Vector3d::UnitZ());
  for (float value : views[0].colour.data) EXPECT_EQ(value, .5f);  // no Cd
}

TEST_F(VolumeViews, WorldIsTheFiles) {
  expectRoom(readViews(write({levelSetRoom(turned())})), turned());
}

TEST_F(VolumeViews, FogSurfaceIsHalfOfItsMaximum) {
  expectRoom(readViews(write({fogRoom(turned())})), turned());
}

TEST_F(VolumeViews, LevelSetComesBeforeFog) {
  auto fog = FloatGrid::create();
  fog->fill(CoordBBox(Coord(0), Coord(7)), 1.f);
  fog->setName("density");
  expectRoom(readViews(write({fog, levelSetRoom(turned())})), turned());
}

TEST_F(VolumeViews, CamerasSeeMostOfTheSurface) {
  std::set<std::tuple<int, int, int>> seen, all;
  const auto patch = [](const Vector3d& p) {
    const Eigen::Vector3i i = (p / .25).array().floor().cast<int>();
    return std::tuple(i.x(), i.y(), i.z());
  };
  const Eigen::Isometry3d identity = Eigen::Isometry3d::Identity();
  for (const View& view : readViews(write({levelSetRoom(identity)})))
    for (int y = 0; y < view.camera.height; ++y)
      for (int x = 0; x < view.camera.width; ++x) {
        const Vector3d wall =
            view.camera.unproject(x + .5, y + .5, depthOfWalls(view, x, y, identity));
        seen.insert(patch(wall));
      }
  forVoxels([&](const Coord&, const Vector3d& p) {
    const double d = boxDistance(kInner, p);
    if (d > 0 && d <= kVoxelM / 2) all.insert(patch(p));
  });
  size_t found = 0;
  for (const auto& p : all) found += seen.count(p);
  EXPECT_GT(double(found), .97 * double(all.size()));
}

TEST_F(VolumeViews, ColourIsTheSurfaces) {
  int64_t checked = 0;
  for (const View& view : readViews(write({levelSetRoom(turned()), roomColours(turned())})))
    for (int y = 0; y < view.camera.height; ++y)
      for (int x = 0; x < view.camera.width; ++x) {
        const Vector3d p = pointOf(view, x, y, turned());
        Eigen::Array3d margin = (p - kInner.min()).cwiseMin(kInner.max() - p).array();
        std::sort(margin.data(), margin.data() + 3);
        if (margin[1] < .2) continue;  // near an edge
        const openvdb::Vec3f expected = faceColour(faceOf(p));
        ++checked;
        for (int c = 0; c < 3; ++c)
          ASSERT_NEAR(view.colour.at(x, y, c), srgbFromLinear(expected[c]), 1e-6);
      }
  EXPECT_GT(checked, 100000);
}

TEST_F(VolumeViews, CutFacesAreNoSurface) {
  const auto grid = levelSetRoom(turned());
  const double cut = kInner.center().x();
  const float band = grid->background();
  for (auto value = grid->beginValueAll(); value; ++value)
    if (value.isVoxelValue() && kVoxelM * value.getCoord().x() > cut) {
      value.setValue(band);
      value.setValueOff();
    }
  int64_t hits = 0, beyond = 0;
  for (const View& view : readViews(write({grid}))) {
    EXPECT_LT((turned().inverse() * view.camera.world_from_camera.translation()).x(), cut);
    for (int y = 0; y < view.camera.height; ++y)
      for (int x = 0; x < view.camera.width; ++x) {
        const double expected = depthOfWalls(view, x, y, turned());
        const Vector3d wall = turned().inverse() * view.camera.unproject(x + .5, y + .5, expected);
        const float z = view.depth[size_t(y) * size_t(view.camera.width) + size_t(x)];
        if (wall.x() > cut + 2 * kVoxelM) {
          ++beyond;
          ASSERT_EQ(z, 0) << view.name << " " << x << " " << y;
        } else if (wall.x() < cut - 2 * kVoxelM) {
          ++hits;
          ASSERT_LT(std::abs(boxDistance(kInner, pointOf(view, x, y, turned()))),
                    kCornerVoxels * kVoxelM);
        }
      }
  }
  EXPECT_GT(hits, 100000);
  EXPECT_GT(beyond, 10000);
}

// --- our own files ---

TEST_F(VolumeViews, OurFilesAreSeenFromSeenEmpty) {
  SceneVoxels v;
  v.frame.voxel_m = .1f;
  v.frame.world_from_grid = turned();
  v.frame.bounds = CoordBBox(Coord(0), Coord(47, 39, 27));
  const CoordBBox free(Coord(2), Coord(45, 37, 25)), known(Coord(2), Coord(20, 37, 25));
  std::vector<Coord> empty;
  for (const Coord& ijk : v.frame.bounds) {
    if (free.isInside(ijk)) {
      if (known.isInside(ijk)) empty.push_back(ijk);
      continue;
    }
    v.ijk.push_back(ijk);
    v.colour_linear.emplace_back(.2f, .4f, ijk.z() < 2 ? 1.f : .1f);
    v.density.push_back(1), v.observed.push_back(1), v.probability.push_back(1),
        v.bfs_level.push_back(0);
  }
  v.empty.root() = maskFromCoords(empty).root();
  const std::string path = folder_ / "ours.vdb";
  writeSceneVdb(v, path);

  EXPECT_LT((conventionalUp(path) - turned().linear().col(2)).norm(), 1e-6);
  const std::vector<View> views = readViews(path);
  ASSERT_EQ(views.size(), 12u);
  const RayTarget truth = RayTarget::fromVoxels(v.frame, v.ijk);
  const DepthAgreement agreement = depthAgreement(truth, views, .05f);
  EXPECT_LT(agreement.median_error_m, 1e-4);
  EXPECT_GT(agreement.within_share, .99);
  for (const View& view : views) {
    const Vector3d p = v.frame.toIndex(view.camera.world_from_camera.translation());
    EXPECT_TRUE(known.isInside(Coord::floor(openvdb::Vec3d(p.x(), p.y(), p.z())))) << p.transpose();
    for (size_t i = 0; i < view.depth.size(); ++i)
      EXPECT_NEAR(view.colour.data[3 * i], srgbFromLinear(.2f), 1e-6);
  }
  expectEveryTruncationThrows(path, folder_ / "cut.vdb", 4099,
                              [](const std::string& cut) { readViews(cut); });
}

TEST_F(VolumeViews, AreTheSameEachTime) {
  const std::string path = write({levelSetRoom(turned()), roomColours(turned())});
  const std::vector<View> a = readViews(path);
  const tbb::global_control one(tbb::global_control::max_allowed_parallelism, 1);
  const std::vector<View> b = readViews(path);
  ASSERT_EQ(a.size(), b.size());
  for (size_t i = 0; i < a.size(); ++i) {
    EXPECT_EQ(a[i].depth, b[i].depth);
    EXPECT_EQ(a[i].colour.data, b[i].colour.data);
    EXPECT_EQ(a[i].camera.world_from_camera.matrix(), b[i].camera.world_from_camera.matrix());
  }
}

TEST_F(VolumeViews, FramesAreChosenAmongThem) {
  const std::string path = write({levelSetRoom(turned())});
  const std::vector<View> all = readViews(path);
  ReadViewsSettings settings;
  settings.frames = {7, 2};
  const std::vector<View> two = readViews(path, settings);
  ASSERT_EQ(two.size(), 2u);
  EXPECT_EQ(two[0].camera.world_from_camera.matrix(), all[7].camera.world_from_camera.matrix());
  EXPECT_EQ(two[1].depth, all[2].depth);
  settings.cameras_only = true;
  const std::vector<View> cameras = readViews(path, settings);
  EXPECT_EQ(cameras[1].camera.world_from_camera.matrix(), all[2].camera.world_from_camera.matrix());
  EXPECT_TRUE(cameras[1].depth.empty());
  settings.frames = {12};
  EXPECT_THROW(readViews(path, settings), Error);
}

// --- what cannot be looked at ---

TEST_F(VolumeViews, UnsuitableFilesThrow) {
  expectThrows(folder_ / "none.vdb", "no such file");
  writeBytes(folder_ / "text.vdb", std::string(1000, 'x'));
  expectThrows(folder_ / "text.vdb", "OpenVDB");
  expectThrows(write({}), "no grids");
  expectThrows(write({BoolGrid::create()}), "found Tree_bool_5_4_3");
  const auto other = [](auto change) {
    auto grid = openvdb::tools::createLevelSetSphere<FloatGrid>(1.f, {}, float(kVoxelM));
    change(*grid);
    return grid;
  };
  expectThrows(write({other([](FloatGrid& g) { g.setGridClass(openvdb::GRID_UNKNOWN); })}),
               "Tree_float_5_4_3");
  expectThrows(write({other([](FloatGrid& g) { g.clear(); })}), "is empty");
  expectThrows(write({other([](FloatGrid& g) {
                 g.tree().root().setBackground(1, true);
                 g.fill(CoordBBox(Coord(-60), Coord(60)), 1);
               })}),
               "no surface");
  for (const double edge : {5e-5, 1e30})
    expectThrows(write({other([&](FloatGrid& g) {
                   g.setTransform(openvdb::math::Transform::createLinearTransform(edge));
                 })}),
                 "voxels of");
  expectThrows(
      write({other([](FloatGrid& g) { g.transform().preScale(openvdb::Vec3d(1, 1, 1.1)); })}),
      "cubic");
  expectThrows(
      write({other([](FloatGrid& g) { g.transform().preScale(openvdb::Vec3d(1, 1, -1)); })}),
      "mirrored");
  expectThrows(write({other([](FloatGrid& g) {
                 g.setTransform(openvdb::math::Transform::createFrustumTransform(
                     openvdb::BBoxd(openvdb::Vec3d(0), openvdb::Vec3d(100)), .5, 1, .05));
               })}),
               "linear");
  for (const float bad :
       {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()})
    expectThrows(
        write({other([&](FloatGrid& g) { g.getAccessor().setValue(Coord(16, 0, 0), bad); })}),
        "not finite");
  expectThrows(
      write({other([](FloatGrid& g) { g.tree().addTile(3, Coord(4096, 0, 0), -1, true); })}),
      "too large");
  expectThrows(write({other([](FloatGrid& g) { g.tree().setValueOn(Coord(1 << 30, 0, 0), -1); })}),
               "origin");
  expectThrows(write({openvdb::tools::createLevelSetSphere<FloatGrid>(.4f, {}, .04f)}),
               "no free place");

  auto fog = other([](FloatGrid& g) { g.setGridClass(openvdb::GRID_FOG_VOLUME); });
  fog->fill(CoordBBox(Coord(-60), Coord(60)), -1);
  expectThrows(write({fog}), "positive");

  auto colour = openvdb::Vec3DGrid::create();
  colour->setName("Cd");
  expectThrows(write({levelSetRoom(turned()), colour}), "Tree_vec3s_5_4_3");
  auto nan = Vec3SGrid::create();
  nan->setName("Cd");
  nan->setTransform(transformOf(turned()));
  nan->getAccessor().setValue(Coord(0), openvdb::Vec3f(std::numeric_limits<float>::quiet_NaN()));
  expectThrows(write({levelSetRoom(turned()), nan}), "Cd");

  ReadViewsSettings scaled;
  scaled.metres_per_unit = 2;
  EXPECT_THROW(readViews(write({levelSetRoom(turned())}), scaled), Error);
}

// --- files by others ---

/// All measured points of a sphere around the origin have the same distance from it.
void expectSphere(const std::string& path, double radius, double tolerance) {
  EXPECT_EQ(conventionalUp(path), Vector3d::UnitY());  // Houdini's
  int64_t hits = 0;
  for (const View& view : readViews(path)) {
    EXPECT_GE(view.camera.world_from_camera.translation().norm(), radius + kClearanceM - tolerance);
    for (int y = 0; y < view.camera.height; ++y)
      for (int x = 0; x < view.camera.width; ++x) {
        if (view.depth[size_t(y) * size_t(view.camera.width) + size_t(x)] == 0) continue;
        ++hits;
        ASSERT_NEAR(pointOf(view, x, y, Eigen::Isometry3d::Identity()).norm(), radius, tolerance);
      }
  }
  EXPECT_GT(hits, 10000);
}

TEST_F(VolumeViews, HoudiniSpheresAreRound) {
  const std::string level_set = sharedFile("data/vdb/sphere_levelset.vdb"),
                    fog = sharedFile("data/vdb/houdini_sphere_fog.vdb");
  if (level_set.empty() || fog.empty()) GTEST_SKIP() << "no shared volumes";
  expectSphere(level_set, 3, .02);
  expectSphere(fog, .9, .1);
}

TEST_F(VolumeViews, OtherVolumesThrow) {
  if (sharedFile("data/vdb/points.vdb").empty()) GTEST_SKIP() << "no shared volumes";
  expectThrows(sharedFile("data/vdb/points.vdb"), "ptdataidx");
  expectThrows(sharedFile("data/vdb/blender_smoke_000001_empty.vdb"), "empty");
  expectThrows(sharedFile("data/vdb/blender_smoke_000002.vdb"), "cubic");
}

TEST_F(VolumeViews, SmokeIsLookedAtFromBesideIt) {
  const std::string path = sharedFile("data/vdb/smoke.vdb");
  if (path.empty()) GTEST_SKIP() << "no shared volumes";
  EXPECT_EQ(readViews(path).size(), 12u);
}

}  // namespace
}  // namespace vdbc
