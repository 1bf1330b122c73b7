// Windows part a volume (docs/method.md, section 4.11), against every voxel of small ones.
#include "mar/windows.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>

#include "vdb/token_grid.h"

namespace vdbc {
namespace {

VoxelFrame frameOf(const CoordBBox& bounds, float voxel_m) {
  VoxelFrame frame;
  frame.bounds = bounds, frame.voxel_m = voxel_m;
  return frame;
}

/// Volumes of one window and of many, that begin anywhere.
std::vector<VoxelFrame> volumes() {
  return {frameOf(CoordBBox(Coord(0), Coord(19, 23, 11)), .1f),
          frameOf(CoordBBox(Coord(-3, 5, 0), Coord(124, 12, 3)), .1f),  // 12.8 m: just one
          frameOf(CoordBBox(Coord(-3, 5, 0), Coord(125, 12, 3)), .1f),  // one voxel more
          frameOf(CoordBBox(Coord(-61, -7, 2), Coord(70, 66, 40)), .4f),
          frameOf(CoordBBox(Coord(1, 2, 3), Coord(97, 41, 47)), .35f)};
}

/// Where something may have been seen in it: everywhere, in a corner, nowhere, beyond it.
std::vector<CoordBBox> contents(const VoxelFrame& frame) {
  CoordBBox beyond = frame.bounds;
  beyond.expand(40);
  return {frame.bounds, voxelsIn(tokenCoord(frame.bounds.max(), 2), 2), CoordBBox(),
          voxelsIn(tokenCoord(frame.bounds.min(), 2), 2), beyond};
}

/// All of them, by number.
std::vector<Window> allOf(const Windows& windows, const VoxelFrame& frame) {
  std::vector<Window> all;
  for (size_t i = 0; i <= windows.of(frame.bounds.max(), 0); ++i) all.push_back(windows.window(i));
  return all;
}

TEST(Windows, CoresPartTheVolumeAndCutNoCoarseNode) {
  size_t most = 0;
  for (const VoxelFrame& frame : volumes())
    for (const CoordBBox& content : contents(frame)) {
      const Windows windows(frame, content, CompleterConfig());
      const std::vector<Window> all = allOf(windows, frame);
      most = std::max(most, all.size());
      uint64_t volume = 0;
      for (const Window& w : all) {
        EXPECT_TRUE(frame.bounds.isInside(w.core));
        volume += w.core.volume();
      }
      EXPECT_EQ(volume, frame.bounds.volume());
      for (auto voxel = frame.bounds.begin(); voxel; ++voxel) {
        const size_t own = windows.of(*voxel, 0);
        ASSERT_LT(own, all.size());
        ASSERT_TRUE(all[own].core.isInside(*voxel)) << *voxel;  // of equal volume: in no other
        for (int level : {1, 2})
          ASSERT_EQ(windows.of(tokenCoord(*voxel, level), level), own) << *voxel << " " << level;
      }
    }
  EXPECT_GT(most, 30u);
}

TEST(Windows, FramesAreCoresWithTheirSurroundingsInThePositionCodesExtent) {
  CompleterConfig narrow;
  narrow.positions.extent_m = 6, narrow.window_overlap_m = .8f;
  for (const CompleterConfig& config : {CompleterConfig(), narrow})
    for (const VoxelFrame& frame : volumes())
      for (const CoordBBox& content : contents(frame)) {
        const Windows windows(frame, content, config);
        const int overlap = int(std::lround(config.window_overlap_m / frame.voxel_m / 4)) *
                            4;  // whole coarse nodes
        for (const Window& w : allOf(windows, frame)) {
          EXPECT_EQ(w.frame.voxel_m, frame.voxel_m);
          for (int axis = 0; axis < 3; ++axis) {
            EXPECT_EQ(w.frame.bounds.min()[axis],
                      std::max(w.core.min()[axis] - overlap, frame.bounds.min()[axis]));
            EXPECT_EQ(w.frame.bounds.max()[axis],
                      std::min(w.core.max()[axis] + overlap, frame.bounds.max()[axis]));
            EXPECT_LE(float(w.frame.bounds.dim()[axis]) * frame.voxel_m,
                      config.positions.extent_m + 1e-3f);
            if (frame.bounds.dim()[axis] * double(frame.voxel_m) <=
                double(config.positions.extent_m)) {
              EXPECT_EQ(w.core.dim()[axis], frame.bounds.dim()[axis]) << "no need to cut";
            }
          }
        }
      }
}

TEST(Windows, AroundAreThoseWhoseFramesHoldANode) {
  std::mt19937 random(1);
  for (const VoxelFrame& frame : volumes())
    for (const CoordBBox& content : contents(frame)) {
      const Windows windows(frame, content, CompleterConfig());
      const std::vector<Window> all = allOf(windows, frame);
      for (int level : {1, 2})
        for (int trial = 0; trial < 60; ++trial) {
          std::vector<Coord> nodes;
          for (int i = 0; i < trial % 4; ++i) {
            Coord voxel;
            for (int axis = 0; axis < 3; ++axis)
              voxel[axis] =
                  frame.bounds.min()[axis] + int(random() % unsigned(frame.bounds.dim()[axis]));
            nodes.push_back(tokenCoord(voxel, level));
          }
          std::vector<size_t> truth;
          for (size_t i = 0; i < all.size(); ++i)
            if (std::any_of(nodes.begin(), nodes.end(), [&](const Coord& node) {
                  return all[i].frame.bounds.hasOverlap(voxelsIn(node, level));
                }))
              truth.push_back(i);
          ASSERT_EQ(windows.around(nodes, level), truth);
        }
    }
}

TEST(Windows, SplitKeepsTokensAndTheirOrder) {
  std::mt19937 random(2);
  const VoxelFrame frame = volumes()[3];
  const Windows windows(frame, frame.bounds, CompleterConfig());
  std::vector<Coord> tokens;
  for (auto node = nodesIn(frame.bounds, 1).begin(); node; ++node)
    if (random() % 20 == 0) tokens.push_back(*node);
  std::shuffle(tokens.begin(), tokens.end(), random);
  std::map<size_t, std::vector<Coord>> truth;
  for (const Coord& token : tokens) truth[windows.of(token, 1)].push_back(token);
  EXPECT_GT(truth.size(), 10u);
  EXPECT_EQ(windows.split(tokens), truth);
}

TEST(Windows, ContentThatFitsIntoOneIsNotCut) {
  std::mt19937 random(3);
  const VoxelFrame frame = frameOf(CoordBBox(Coord(-501, -333, -20), Coord(499, 707, 31)), .1f);
  for (int trial = 0; trial < 100; ++trial) {
    const Coord low(int(random() % 224) - 125, int(random() % 224) - 83, -5);
    const Coord side(int(random() % 24), int(random() % 24), 9);  // coarse nodes, less one
    const CoordBBox content(firstVoxel(low, 2), voxelsIn(low + side, 2).max());
    const Windows windows(frame, content, CompleterConfig());
    ASSERT_EQ(windows.of(content.min(), 0), windows.of(content.max(), 0)) << content;
  }
}

TEST(Windows, HaveAtLeastACoarseNodeASide) {
  CompleterConfig narrow;
  narrow.positions.extent_m = 1, narrow.window_overlap_m = .25f;
  const VoxelFrame frame = volumes()[1];
  const Windows windows(frame, frame.bounds, narrow);
  for (const Window& w : allOf(windows, frame)) EXPECT_FALSE(w.core.empty());
}

TEST(Windows, AVolumeOfAnySizeCostsNothing) {
  // 10^5 windows a side.
  const VoxelFrame frame = frameOf(CoordBBox(Coord(-4800000), Coord(4799999)), .1f);
  const Windows windows(frame, frame.bounds, CompleterConfig());
  const size_t middle = windows.of(Coord(0), 1);
  EXPECT_TRUE(windows.window(middle).core.isInside(Coord(0)));
  const std::vector<size_t> around = windows.around({Coord(0)}, 1);
  EXPECT_TRUE(std::count(around.begin(), around.end(), middle));
  EXPECT_LE(around.size(), 8u);
}

}  // namespace
}  // namespace vdbc
