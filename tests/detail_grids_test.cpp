// What a place is in detail voxels: a wall whose colour, thickness and surface are known.
#include "splat/detail_grids.h"

#include <gtest/gtest.h>

#include <cmath>

#include "splat/image.h"
#include "tests/files.h"
#include "vdb/fuse.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

constexpr float kEdge = .025f;
constexpr int kParts = 4;

/// A wall of voxels, 2 m square; what was measured is the plane z = .06 m through their middle,
/// seen from above, for x < 1 m.
SceneVoxels wall() {
  SceneVoxels v;
  v.frame.bounds = CoordBBox(Coord(-8), Coord(31));
  for (const Coord& ijk : CoordBBox(Coord(0), Coord(19, 19, 0))) {
    v.ijk.push_back(ijk);
    v.colour_linear.emplace_back(0, 1, 0), v.density.push_back(.5f);
    v.observed.push_back(ijk.x() < 10), v.probability.push_back(1);
    v.bfs_level.push_back(ijk.x() >= 10);
  }
  const auto measured = FloatGrid::create(kDetailBand * kEdge);
  for (const Coord& c : CoordBBox(Coord(0, 0, -6), Coord(39, 79, 8))) {
    const float distance = (float(c.z()) + .5f) * kEdge - .06f;
    if (distance > -kDetailBand * kEdge)
      measured->tree().setValueOn(c, std::min(distance, kDetailBand * kEdge));
  }
  VoxelFrame detail = v.frame;
  detail.voxel_m = kEdge;
  measured->setTransform(fileTransform(detail));
  v.seen_distance = measured;
  return v;
}

/// Discs on the measured plane, 4 cm apart: red for y < 1 m, blue beyond.
Gaussians discs() {
  Gaussians g;
  for (int x = 0; x < 25; ++x)
    for (int y = 0; y < 50; ++y) {
      g.mean.emplace_back(.02f + .04f * float(x), .02f + .04f * float(y), .06f);
      g.log_scale.emplace_back(std::log(.02f), std::log(.02f), std::log(.002f));
      g.rotation.emplace_back(1, 0, 0, 0);
      g.opacity_logit.push_back(5);
      const bool red = y < 25;
      for (float c : {red ? 1.f : 0.f, 0.f, red ? 0.f : 1.f}) g.sh.push_back((c - .5f) / kSh0);
    }
  return g;
}

TEST(DetailGrids, AreNoneWhereNothingWasMeasured) {
  SceneVoxels v = wall();
  v.seen_distance = nullptr;
  const DetailGrids grids = detailGrids(v, discs());
  EXPECT_FALSE(grids.surface || grids.density || grids.colour);
}

TEST(DetailGrids, ColourIsThatOfTheDiscsWhereverOneLooks) {
  const DetailGrids grids = detailGrids(wall(), discs());
  const auto colour = grids.colour->getConstAccessor();
  for (int y = 4; y < 76; ++y)
    for (int z = 0; z < 4; ++z) {
      const Coord c(20, y, z);
      ASSERT_TRUE(colour.isValueOn(c)) << c;
      if (y > 36 && y < 44) continue;  // the border between both, three sigmas wide
      const openvdb::Vec3f expected = y < 40 ? openvdb::Vec3f(1, 0, 0) : openvdb::Vec3f(0, 0, 1);
      ASSERT_LT((colour.getValue(c) - expected).length(), .02f) << c << colour.getValue(c);
    }
  // Also beyond all discs: that of the voxels.
  EXPECT_EQ(colour.getValue(Coord(70, 40, 1)), openvdb::Vec3f(0, 1, 0));
}

// A sample at the surface is the mean of eight voxels, and one of the fog lies in its own.
TEST(DetailGrids, NoSampleOfColourMeetsAVoxelWithout) {
  SceneVoxels v = wall();
  for (const Coord& ijk : CoordBBox(Coord(0, 0, -6), Coord(19, 19, -1))) {  // and much inside
    v.ijk.push_back(ijk);
    v.colour_linear.emplace_back(0, 1, 0), v.density.push_back(.5f);
    v.observed.push_back(0), v.probability.push_back(1), v.bfs_level.push_back(1);
  }
  const DetailGrids grids = detailGrids(v, discs());
  const auto colour = grids.colour->getConstAccessor();
  const auto surface = grids.surface->getConstAccessor();
  for (auto value = grids.surface->cbeginValueOn(); value; ++value) {
    const CoordBBox cell = CoordBBox::createCube(value.getCoord(), 2);
    int inside = 0;
    for (const Coord& c : cell) inside += surface.getValue(c) < 0;
    if (inside == 0 || inside == 8) continue;
    for (const Coord& c : cell) ASSERT_TRUE(colour.isValueOn(c)) << c;
  }
  int64_t tiles = 0;
  for (auto value = grids.density->cbeginValueOn(); value; ++value) {
    tiles += value.isTileValue();
    CoordBBox box;
    value.getBoundingBox(box);
    for (const Coord& c : {box.min(), box.max()}) {
      ASSERT_TRUE(colour.isValueOn(c)) << c;
      ASSERT_GT(colour.getValue(c).length(), .5f) << c;
    }
  }
  EXPECT_GT(tiles, 0);
}

// Files stay small where nothing was measured and colours hardly differ.
TEST(DetailGrids, WhatWasMadeUpInOneColourIsTiles) {
  const SceneVoxels v = wall();
  const DetailGrids grids = detailGrids(v, discs());
  for (auto leaf = grids.colour->constTree().cbeginLeaf(); leaf; ++leaf)
    EXPECT_TRUE(v.seen_distance->constTree().probeConstLeaf(leaf->origin())) << leaf->origin();
  EXPECT_GT(grids.colour->constTree().activeTileCount(), 10u);
}

TEST(DetailGrids, DensityIsTheShareOfAVoxelBehindTheSurface) {
  const DetailGrids grids = detailGrids(wall(), discs());
  EXPECT_EQ(grids.density->getGridClass(), openvdb::GRID_FOG_VOLUME);
  const auto density = grids.density->getConstAccessor();
  const auto surface = grids.surface->getConstAccessor();
  float top = 0;  // where the column's density ends, metres above its voxel 0
  for (int z = 0; z < 8; ++z) top += kEdge * density.getValue(Coord(20, 40, z));
  EXPECT_NEAR(top, .06, .002);
  EXPECT_EQ(density.getValue(Coord(20, 40, 4)), 0);
  EXPECT_EQ(density.getValue(Coord(20, 40, 1)), 1);
  for (auto value = grids.density->cbeginValueOn(); value; ++value) {
    ASSERT_TRUE(*value > 0 && *value <= 1);
    if (value.isVoxelValue()) {
      ASSERT_LT(surface.getValue(value.getCoord()), .5f * kEdge);
    }
  }
}

TEST(DetailGrids, GoIntoTheFileAndComeBackAsVoxels) {
  const TemporaryFolder folder;
  const SceneVoxels v = wall();
  writeSceneVdb(v, folder / "x.vdb", detailGrids(v, discs()));
  const VdbFile file = readVdb("test", folder / "x.vdb", 1 << 30);
  for (const char* name : {"surface", "density", "seen_distance"})
    EXPECT_NEAR(findGrid<FloatGrid>("test", file.grids, name, "x")->voxelSize()[0], kEdge, 1e-6)
        << name;
  EXPECT_NEAR(findGrid<Vec3SGrid>("test", file.grids, "Cd", "x")->voxelSize()[0], kEdge, 1e-6);
  const auto surface = findGrid<FloatGrid>("test", file.grids, "surface", "x");
  EXPECT_EQ(surface->metaValue<int64_t>("dropped_parts"), 0);
  EXPECT_NEAR(findGrid<FloatGrid>("test", file.grids, "probability", "x")->voxelSize()[0], .1,
              1e-6);
  const SceneVoxels read = readSceneVdb(folder / "x.vdb");
  ASSERT_EQ(read.ijk.size(), v.ijk.size());
  for (size_t i = 0; i < read.ijk.size(); ++i)
    if (read.ijk[i] == Coord(3, 3, 0)) {
      EXPECT_LT((read.colour_linear[i] - Eigen::Vector3f(1, 0, 0)).norm(), .02f);
      EXPECT_GT(read.density[i], .5f);
    }
}

// A file may hold any scale: what is wide must not be looked for where there is nothing.
TEST(DetailGrids, AGaussianAsLargeAsTheWorldCostsNothing) {
  Gaussians g = discs();
  for (float size : {1e6f, 1e18f}) {
    g.log_scale[0].setConstant(std::log(size));
    const DetailGrids grids = detailGrids(wall(), g);
    for (auto value = grids.colour->cbeginValueOn(); value; ++value)
      ASSERT_TRUE(std::isfinite((*value).length()));
  }
}

}  // namespace
}  // namespace vdbc
