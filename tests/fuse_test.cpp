// Depth as a level set: against closed forms of a ball and a room, and what noise, holes and
// floaters do. That the surface is closed is asked of OpenVDB's mesher.
#include "vdb/fuse.h"

#include <gtest/gtest.h>
#include <openvdb/openvdb.h>
#include <openvdb/tools/Interpolation.h>
#include <openvdb/tools/VolumeToMesh.h>

#include <cmath>
#include <map>
#include <random>

#include "encoder/views/read_views.h"
#include "tests/expect_error.h"
#include "tests/files.h"
#include "vdb/scene_vdb.h"
#include "vdb/threads.h"
#include "vdb/token_grid.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;

struct ShapeCapture {
  std::vector<Camera> cameras;
  std::vector<std::vector<float>> depths;
  std::function<double(const Vector3d&)> distance;  // metres to the truth; positive where free

  void add(const Vector3d& eye, const Vector3d& target) {
    Camera c{160, 120, 128, 128, 80, 60, lookAt(eye, target, Vector3d::UnitZ())};
    std::vector<float> depth(160 * 120, 0.f);
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        // Sphere tracing: the distance is exact, so that the point is.
        double z = 0;
        for (int i = 0; i < 400 && z < 20; ++i) {
          const Vector3d p = c.unproject(x + .5, y + .5, z);
          const double d = distance(p);
          if (d < 1e-9) break;
          z += d / (c.unproject(x + .5, y + .5, 1) - eye).norm();
        }
        if (z < 20) depth[size_t(y) * 160 + size_t(x)] = float(z);
      }
    cameras.push_back(c);
    depths.push_back(depth);
  }
  std::vector<DepthView> views() const {
    std::vector<DepthView> v;
    for (size_t i = 0; i < cameras.size(); ++i) v.push_back({cameras[i], depths[i].data()});
    return v;
  }
};

/// A ball of .6 m about (0, 0, 0), from six sides.
ShapeCapture ball() {
  ShapeCapture c;
  c.distance = [](const Vector3d& p) { return p.norm() - .6; };
  for (const Vector3d& eye : {Vector3d(2, 0, .3), Vector3d(-2, 0, .3), Vector3d(0, 2, .3),
                              Vector3d(0, -2, .3), Vector3d(.3, 0, 2), Vector3d(.3, 0, -2)})
    c.add(eye, Vector3d::Zero());
  return c;
}

/// The inside of a box of 3 x 2.6 x 2.4 m, from two places.
ShapeCapture room() {
  ShapeCapture c;
  c.distance = [](const Vector3d& p) {
    return std::min(p.minCoeff(), (Vector3d(3, 2.6, 2.4) - p).minCoeff());
  };
  c.add({2.4, 2, 1.3}, {0, .8, .9});
  c.add({.6, 2, 1.5}, {2.5, 0, .5});
  return c;
}

VoxelFrame frameOf(int low, int high) {
  VoxelFrame f;
  f.world_from_grid = Eigen::AngleAxisd(.3, Vector3d(.2, .1, 1).normalized());
  f.bounds = CoordBBox(Coord(low), Coord(high));
  return f;
}

SeenSpace carved(const ShapeCapture& c, const VoxelFrame& f) {
  Progress silent;
  return carve(f, c.views(), {}, silent);
}

FloatGrid::Ptr fused(const ShapeCapture& c, const VoxelFrame& f, float voxel_m) {
  FuseSettings s;
  s.voxel_m = voxel_m;
  return fuseDepth(f, carved(c, f), c.views(), s);
}

struct Errors {
  double bias = 0, rms = 0;
  int count = 0;
};
/// True distances of the points where the grid's values cross 0 between two active voxels.
Errors errorsOf(const FloatGrid& grid, const ShapeCapture& c) {
  Errors e;
  const auto values = grid.getConstAccessor();
  for (auto value = grid.cbeginValueOn(); value; ++value)
    for (int axis = 0; axis < 3; ++axis) {
      const Coord here = value.getCoord();
      Coord next = here;
      ++next[axis];
      const float a = *value, b = values.getValue(next);
      if (!values.isValueOn(next) || (a < 0) == (b < 0)) continue;
      openvdb::Vec3d at = here.asVec3d();
      at[axis] += double(a) / (double(a) - double(b));
      const openvdb::Vec3d p = grid.indexToWorld(at);
      const double error = c.distance({p.x(), p.y(), p.z()});
      e.bias += error, e.rms += error * error, ++e.count;
    }
  e.bias /= e.count, e.rms = std::sqrt(e.rms / e.count);
  return e;
}

/// Edges of the zero crossing's mesh that are not between two faces.
int64_t openEdges(const FloatGrid& grid) {
  std::vector<openvdb::Vec3s> points;
  std::vector<openvdb::Vec4I> quads;
  openvdb::tools::volumeToMesh(grid, points, quads, 0.0);
  std::map<std::pair<unsigned, unsigned>, int> edges;
  for (const openvdb::Vec4I& q : quads)
    for (int k = 0; k < 4; ++k) {
      const unsigned a = q[k], b = q[(k + 1) % 4];
      ++edges[{std::min(a, b), std::max(a, b)}];
    }
  EXPECT_GT(quads.size(), 100u);
  int64_t open = 0;
  for (const auto& edge : edges) open += edge.second % 2;
  return open;
}

TEST(Fuse, ABallIsExactToATenthOfAVoxel) {
  const ShapeCapture c = ball();
  const Errors e = errorsOf(*fused(c, frameOf(-16, 15), .025f), c);
  ASSERT_GT(e.count, 3000);
  EXPECT_LT(e.rms, .0025);
  EXPECT_LT(std::abs(e.bias), .001);
}

TEST(Fuse, ARoomIsExactToATenthOfAVoxel) {
  const ShapeCapture c = room();
  const Errors e = errorsOf(*fused(c, frameOf(-16, 47), .025f), c);
  ASSERT_GT(e.count, 3000);
  EXPECT_LT(e.rms, .0025);
  EXPECT_LT(std::abs(e.bias), .001);
}

TEST(Fuse, NoiseDoesNotShiftTheSurface) {
  ShapeCapture c = room();
  std::mt19937 random(5);
  std::normal_distribution<float> noise;
  for (auto& depth : c.depths)
    for (float& z : depth) z += .0015f * z * z * noise(random);  // as of a Kinect
  const Errors e = errorsOf(*fused(c, frameOf(-16, 47), .025f), c);
  EXPECT_LT(std::abs(e.bias), .003);
  EXPECT_LT(e.rms, .012);
}

TEST(Fuse, FreeSpaceWinsOverWhatOneViewSawInTheAir) {
  ShapeCapture c = room();
  c.add({2.2, 2.2, 1.2}, {0, .6, .9}), c.add({2.5, 1.7, 1.4}, {0, 1, .9});
  // A speck of 20 x 20 pixels at 1 m, in the first view alone.
  for (int y = 50; y < 70; ++y)
    for (int x = 70; x < 90; ++x) c.depths[0][size_t(y) * 160 + size_t(x)] = 1;
  const VoxelFrame f = frameOf(-16, 47);
  const FloatGrid::Ptr grid = fused(c, f, .05f);
  const FloatGrid::Ptr surface = closedSurface(f, filledNodes(carved(c, f)), *grid);
  for (auto value = surface->cbeginValueOn(); value; ++value) {
    const openvdb::Vec3d p = surface->indexToWorld(value.getCoord());
    if (c.distance({p.x(), p.y(), p.z()}) > .3) {
      EXPECT_GT(*value, 0.f) << value.getCoord();
    }
  }
}

TEST(Fuse, TheSurfaceIsClosedAndStandsWhereItWasMeasured) {
  const ShapeCapture c = room();
  const VoxelFrame f = frameOf(-16, 47);
  std::vector<Coord> solid = filledNodes(carved(c, f));
  // A block that was made up, beside the room and away from it.
  for (auto ijk = CoordBBox(Coord(-8, -8, 2), Coord(-4, -2, 9)).begin(); ijk; ++ijk)
    solid.push_back(*ijk);
  const FloatGrid::Ptr surface = closedSurface(f, solid, *fused(c, f, .025f));
  EXPECT_EQ(surface->getGridClass(), openvdb::GRID_LEVEL_SET);
  EXPECT_EQ(openEdges(*surface), 0);
  // At the measured points themselves.
  openvdb::tools::GridSampler<FloatGrid, openvdb::tools::BoxSampler> sample(*surface);
  double bias = 0, square = 0;
  int n = 0;
  for (size_t v = 0; v < c.cameras.size(); ++v)
    for (size_t i = 0; i < c.depths[v].size(); i += 11) {
      const Vector3d p = c.cameras[v].unproject(double(i % 160) + .5, double(i / 160) + .5,
                                                double(c.depths[v][i]));
      const double d = double(sample.wsSample({p.x(), p.y(), p.z()}));
      bias += d, square += d * d, ++n;
    }
  EXPECT_LT(std::abs(bias / n), .003);
  EXPECT_LT(std::sqrt(square / n), .006);
  // The made-up block is in it.
  const Vector3d inside = f.toWorld({-6, -5, 5});
  EXPECT_LT(sample.wsSample({inside.x(), inside.y(), inside.z()}), 0);
}

/// The plane z = 0 from above, as far as x = 1.2 m at both sides.
ShapeCapture plane() {
  ShapeCapture c;
  c.distance = [](const Vector3d& p) { return std::abs(p.z()); };
  c.add({0, 0, 2}, {0, .001, 0});
  return c;
}

/// Voxels that the plane goes through, within 1.7 m.
std::vector<Coord> voxelsOfPlane(const VoxelFrame& f) {
  std::vector<Coord> solid;
  const Vector3d up = f.world_from_grid.linear().row(2);
  for (const Coord& ijk : f.bounds) {
    const Vector3d centre = f.toWorld(Vector3d(ijk.x() + .5, ijk.y() + .5, ijk.z() + .5));
    if (centre.norm() < 1.7 && std::abs(centre.z()) < .05 * up.cwiseAbs().sum())
      solid.push_back(ijk);
  }
  return solid;
}

/// Where the level set first crosses 0 on the way down; not a number: nowhere near.
double heightOf(const FloatGrid& surface, double x, double y) {
  openvdb::tools::GridSampler<FloatGrid, openvdb::tools::BoxSampler> sample(surface);
  constexpr double kStep = .002;
  for (double z = .15; z > -.15; z -= kStep) {
    const double above = double(sample.wsSample({x, y, z})),
                 below = double(sample.wsSample({x, y, z - kStep}));
    if (above >= 0 && below < 0) return z - kStep * above / (above - below);
  }
  return NAN;
}

// The voxels' boundary lies up to a voxel before the plane. It is reached in a slope, not a step.
TEST(Fuse, AMeasuredPlaneGoesOnBeyondItsBorder) {
  const ShapeCapture c = plane();
  const VoxelFrame f = frameOf(-18, 17);
  const FloatGrid::Ptr surface = closedSurface(f, voxelsOfPlane(f), *fused(c, f, .025f));
  double farthest = 0;
  for (double side : {-1., 1.})
    for (double y = -.6; y < .61; y += .1) {
      double before = 0;
      for (double x = 1; x < 1.5; x += .01) {
        const double height = heightOf(*surface, side * x, y);
        ASSERT_FALSE(std::isnan(height)) << x << " " << y;
        if (x < 1.33) {  // 8 cm beyond the last ray
          EXPECT_LT(std::abs(height), .1 / 3) << x << " " << y;
        }
        EXPECT_LT(std::abs(height - before), .02) << x << " " << y;
        before = height, farthest = std::max(farthest, height);
      }
    }
  EXPECT_GT(farthest, .05);  // there is something to be reached
}

TEST(Fuse, WhatViewsSawFreeIsNeverFilled) {
  ShapeCapture c = room();
  // A board stands in the air: its border, its shadow on the wall, and what goes on behind it.
  const auto walls = c.distance;
  c.distance = [walls](const Vector3d& p) {
    const Vector3d off = (p - Vector3d(1.2, 1, 1)).cwiseAbs() - Vector3d(.02, .3, .4);
    return std::min(walls(p), off.cwiseMax(0).norm() + std::min(0., off.maxCoeff()));
  };
  ShapeCapture seen;
  seen.distance = c.distance;
  seen.add({2.4, 2, 1.3}, {0, .8, .9}), seen.add({.6, 2, 1.5}, {2.5, 0, .5});
  const VoxelFrame f = frameOf(-16, 47);
  const FloatGrid::Ptr measured = fused(seen, f, .025f);
  const FloatGrid::Ptr surface = closedSurface(f, filledNodes(carved(seen, f)), *measured);
  EXPECT_EQ(openEdges(*surface), 0);
  const auto values = surface->getConstAccessor();
  int64_t free = 0;
  for (auto value = measured->cbeginValueOn(); value; ++value)
    if (*value > 0) {
      ++free;
      ASSERT_GE(values.getValue(value.getCoord()), 0) << value.getCoord();
    }
  EXPECT_GT(free, 10000);
}

/// In detail voxels of 2.5 cm.
FloatGrid::Ptr measuredGrid(const VoxelFrame& f, const CoordBBox& box,
                            const std::function<float(const Coord&)>& distance) {
  VoxelFrame detail = f;
  detail.voxel_m = .025f;
  const auto grid = FloatGrid::create(kDetailBand * detail.voxel_m);
  grid->setTransform(fileTransform(detail));
  for (const Coord& c : box) grid->tree().setValueOn(c, distance(c));
  return grid;
}

TEST(Fuse, SmallPartsAreDroppedUnlessTheyWereMeasured) {
  const VoxelFrame f = frameOf(-16, 15);
  constexpr float kBand = kDetailBand * .025f;
  // One voxel alone, whose rounded shape is 5 cm wide; two together; and one in which a pole of
  // 2.5 cm was measured, free around.
  const std::vector<Coord> solid = {Coord(-8, 0, 0), Coord(0, 0, 0), Coord(1, 0, 0),
                                    Coord(8, 0, 0)};
  const FloatGrid::Ptr measured =
      measuredGrid(f, CoordBBox(Coord(24, -8, -8), Coord(43, 11, 11)), [&](const Coord& c) {
        const bool is_pole = c.x() == 33 && c.y() == 1 && c.z() >= 0 && c.z() <= 2;
        return is_pole ? -.0125f : kBand;
      });
  const FloatGrid::Ptr surface = closedSurface(f, solid, *measured);
  const auto isSolid = [&](const Coord& c) { return surface->tree().getValue(c) < 0; };
  EXPECT_FALSE(isSolid({-31, 1, 1}));
  EXPECT_TRUE(isSolid({1, 1, 1}));
  EXPECT_TRUE(isSolid({6, 1, 1}));
  EXPECT_TRUE(isSolid({33, 1, 1}));
  EXPECT_EQ(surface->metaValue<int64_t>("dropped_parts"), 1);
}

// Noise and holes of a sensor, and cameras that do not quite agree.
TEST(Fuse, TheSurfaceOfACaptureIsThatOfItsDepth) {
  const std::string folder = sharedFile("data/rgbd_redkitchen");
  if (folder.empty()) GTEST_SKIP() << "no kitchen";
  ReadViewsSettings reading;
  reading.frames = {0, 6, 12, 18};
  ShapeCapture c;
  for (const View& v : readViews(folder, reading))
    c.cameras.push_back(v.camera), c.depths.push_back(v.depth);
  VoxelFrame f;
  const Vector3d middle = c.cameras[0].unproject(320, 240, 2) / .1;
  const Coord centre(int(middle.x()), int(middle.y()), int(middle.z()));
  f.bounds = CoordBBox(centre.offsetBy(-50), centre.offsetBy(50));
  const FloatGrid::Ptr plain = fused(c, f, .025f);
  const FloatGrid::Ptr surface = closedSurface(f, filledNodes(carved(c, f)), *plain);
  EXPECT_EQ(openEdges(*surface), 0);
  openvdb::tools::GridSampler<FloatGrid, openvdb::tools::BoxSampler> of_surface(*surface),
      of_plain(*plain);
  double bias = 0, square = 0, plain_square = 0;
  int n = 0, lost = 0;
  for (const DepthView& view : c.views()) {
    const std::vector<float> depth = usableDepth(view, {});
    for (size_t i = 0; i < depth.size(); i += 7) {
      if (!(depth[i] > 0)) continue;
      const Vector3d p =
          view.camera.unproject(double(i % 640) + .5, double(i / 640) + .5, double(depth[i]));
      const openvdb::Vec3d at(p.x(), p.y(), p.z());
      const double d = double(of_surface.wsSample(at));
      bias += d, square += d * d, plain_square += std::pow(double(of_plain.wsSample(at)), 2), ++n;
      lost += std::abs(d) > .999 * double(surface->background());
    }
  }
  ASSERT_GT(n, 50000);
  EXPECT_LT(std::abs(bias / n), .003);
  EXPECT_LT(std::sqrt(square), 1.2 * std::sqrt(plain_square));
  EXPECT_LT(lost, .001 * n);
}

TEST(Fuse, DistancesAreThoseOfAnEikonal) {
  const ShapeCapture c = ball();
  const VoxelFrame f = frameOf(-16, 15);
  const FloatGrid::Ptr surface = closedSurface(f, filledNodes(carved(c, f)), *fused(c, f, .025f));
  const auto values = surface->getConstAccessor();
  double sum = 0;
  int n = 0;
  for (auto value = surface->cbeginValueOn(); value; ++value) {
    const Coord ijk = value.getCoord();
    if (*value < .02f || *value > .04f) continue;  // outside of the ball, where it is smooth
    double square = 0;
    for (int axis = 0; axis < 3; ++axis) {
      Coord low = ijk, high = ijk;
      --low[axis], ++high[axis];
      square += std::pow(double(values.getValue(high) - values.getValue(low)) / .05, 2);
    }
    sum += std::sqrt(square), ++n;
  }
  ASSERT_GT(n, 500);
  EXPECT_NEAR(sum / n, 1, .05);
}

TEST(Fuse, TheSameValuesForAnyNumberOfThreads) {
  const ShapeCapture c = room();
  const VoxelFrame f = frameOf(-16, 47);
  const auto at = [&](int threads) {
    return withThreads(
        threads, [&] { return closedSurface(f, filledNodes(carved(c, f)), *fused(c, f, .05f)); });
  };
  const FloatGrid::Ptr one = at(1);
  for (int threads : {2, 4}) {
    const FloatGrid::Ptr other = at(threads);
    ASSERT_EQ(one->activeVoxelCount(), other->activeVoxelCount());
    const auto values = other->getConstAccessor();
    for (auto value = one->cbeginValueOn(); value; ++value)
      ASSERT_EQ(*value, values.getValue(value.getCoord())) << value.getCoord();
  }
}

TEST(Fuse, AFileHoldsWhatWasMeasuredAndIsReadBack) {
  const TemporaryFolder folder;
  const ShapeCapture c = room();
  SceneVoxels scene;
  scene.frame = frameOf(-16, 47);
  scene.ijk = filledNodes(carved(c, scene.frame));
  const size_t n = scene.ijk.size();
  scene.colour_linear.assign(n, {.5f, .5f, .5f}), scene.density.assign(n, 1);
  scene.observed.assign(n, 1), scene.probability.assign(n, 1), scene.bfs_level.assign(n, 0);
  scene.seen_distance = fused(c, scene.frame, .05f);
  const std::string path = folder / "x.vdb";
  writeSceneVdb(scene, path);
  const SceneVoxels read = readSceneVdb(path);
  ASSERT_TRUE(read.seen_distance);
  ASSERT_EQ(read.seen_distance->activeVoxelCount(), scene.seen_distance->activeVoxelCount());
  const auto values = read.seen_distance->getConstAccessor();
  for (auto value = scene.seen_distance->cbeginValueOn(); value; ++value)
    ASSERT_NEAR(*value, values.getValue(value.getCoord()), 1e-4);  // half precision
  // One that does not fit the voxels is refused.
  const auto stranger = FloatGrid::create(1.f);
  stranger->setTransform(openvdb::math::Transform::createLinearTransform(.07));
  scene.seen_distance = stranger;
  writeSceneVdb(scene, path);
  expectError([&] { readSceneVdb(path); }, {"0.07"});
  scene.seen_distance = nullptr;
  writeSceneVdb(scene, path);
  EXPECT_FALSE(readSceneVdb(path).seen_distance);
}

TEST(Fuse, VoxelsFollowThePixelsAndStrangeOnesAreRefused) {
  const ShapeCapture c = room();
  const VoxelFrame f = frameOf(-16, 47);
  const double automatic = fused(c, f, 0)->voxelSize()[0];
  EXPECT_GE(automatic, .0099);
  EXPECT_LE(automatic, .0501);
  EXPECT_NEAR(std::remainder(.1, automatic), 0, 1e-6);  // whole parts of a voxel
  EXPECT_NEAR(fused(c, f, .03f)->voxelSize()[0], .025, 1e-6);
  expectError([&] { fused(c, f, .2f); }, {"fuseDepth", "0.2"});
  expectError([&] { fused(c, f, .001f); }, {"64th"});
  ShapeCapture blind = c;
  for (auto& depth : blind.depths) std::fill(depth.begin(), depth.end(), std::nanf(""));
  expectError([&] { fuseDepth(f, carved(c, f), blind.views(), {}); }, {"usable depth"});
}

}  // namespace
}  // namespace vdbc
