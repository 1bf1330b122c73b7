#include "vdb/token_grid.h"

#include <gtest/gtest.h>
#include <openvdb/tree/ValueAccessor.h>

#include <algorithm>
#include <cmath>
#include <random>
#include <set>

namespace vdbc {
namespace {

// Clustered at the origin's eight octants and scattered far away, with duplicates, unsorted.
std::vector<Coord> randomVoxels(unsigned seed, int count) {
  std::mt19937 rng(seed);
  const auto pick = [&](int n) { return int(rng() % unsigned(2 * n + 1)) - n; };
  std::vector<Coord> voxels;
  for (int i = 0; i < count; ++i) {
    const int n = i % 60 == 0 ? 100000 : i % 3 == 1 ? 150 : 6;
    voxels.emplace_back(pick(n), pick(n), pick(n));
  }
  return voxels;
}

TEST(TokenCoord, IsFloorDivision) {
  for (int x = -9; x <= 9; ++x) {
    for (int level = 0; level <= 3; ++level) {
      EXPECT_EQ(tokenCoord(Coord(x, -x, 0), level).x(), int(std::floor(double(x) / (1 << level))));
    }
  }
}

TEST(TokenCoord, ChildOfParentIsTheTokenItself) {
  for (const Coord& c : randomVoxels(1, 300)) {
    EXPECT_EQ(childCoord(tokenCoord(c, 1), childSlot(c)), c);
    EXPECT_EQ(childSlot(c), int(TokenMask::LeafNodeType::coordToOffset(c)));
  }
}

TEST(TokenCoord, VoxelsOfANodeAreThoseWhoseTokenItIs) {
  for (int level = 0; level <= 4; ++level)
    for (const Coord& node : {Coord(0), Coord(-1, 2, -3), Coord(5, -4, 1)}) {
      const CoordBBox voxels = voxelsIn(node, level);
      EXPECT_EQ(voxels.min(), firstVoxel(node, level));
      CoordBBox around = voxels;
      around.expand(2);
      for (auto c = around.begin(); c; ++c)
        EXPECT_EQ(voxels.isInside(*c), tokenCoord(*c, level) == node);
    }
}

TEST(TokenCoord, NodesInABoxAreThoseOfItsVoxels) {
  std::mt19937 rng(8);
  const auto pick = [&](int low, int high) { return low + int(rng() % unsigned(high - low + 1)); };
  for (int trial = 0; trial < 50; ++trial) {
    const Coord low(pick(-9, 9), pick(-9, 9), pick(-9, 9));
    const CoordBBox box(low, low + Coord(pick(0, 6), pick(0, 6), pick(0, 6)));
    for (int level = 0; level <= 3; ++level) {
      std::set<Coord> expected, found;
      for (auto c = box.begin(); c; ++c) expected.insert(tokenCoord(*c, level));
      for (auto node = nodesIn(box, level).begin(); node; ++node) found.insert(*node);
      EXPECT_EQ(found, expected);
    }
  }
}

TEST(TokenMask, AnyAndAllVoxelsOfANode) {
  TokenMask mask;
  mask.addTile(2, Coord(-4, 8, 0), true, true);  // 4^3
  mask.setValueOn(Coord(1, 1, 1)), mask.setValueOff(Coord(-4, 8, 0));
  const openvdb::tree::ValueAccessor<const TokenMask> look(mask);
  for (int level = 0; level <= 3; ++level)
    for (auto node = nodesIn(CoordBBox(Coord(-9), Coord(15)), level).begin(); node; ++node) {
      int on = 0, all = 0;
      for (auto c = voxelsIn(*node, level).begin(); c; ++c, ++all) on += mask.isValueOn(*c);
      EXPECT_EQ(anyVoxelOn(mask, *node, level), on > 0);
      EXPECT_EQ(allVoxelsOn(look, *node, level), on == all);
    }
}

TEST(TokenGrid, ActiveSetEqualsTheSetOfCoordinates) {
  const std::vector<Coord> voxels = randomVoxels(2, 4000);
  const TokenGrid grid = TokenGrid::fromCoords(voxels);
  for (int level = 0; level < kTokenLevels; ++level) {
    std::set<Coord> expected;
    for (const Coord& c : voxels) expected.insert(tokenCoord(c, level));
    const std::vector<Coord>& coords = grid.coords(level);
    EXPECT_EQ(grid.size(level), int64_t(expected.size()));
    EXPECT_EQ(std::set<Coord>(coords.begin(), coords.end()), expected) << "level " << level;
  }
}

TEST(TokenGrid, RowsInvertCoordinates) {
  const std::vector<Coord> voxels = randomVoxels(3, 3000);
  const TokenGrid grid = TokenGrid::fromCoords(voxels);
  for (int level = 0; level < kTokenLevels; ++level) {
    const std::vector<Coord>& coords = grid.coords(level);
    const std::set<Coord> present(coords.begin(), coords.end());
    for (int32_t i = 0; i < grid.size(level); ++i) {
      ASSERT_EQ(grid.row(level, coords[size_t(i)]), i);
      // Neighbours share leaves and nodes with tokens and need not be tokens.
      const Coord other = coords[size_t(i)].offsetBy(1, -1, 2);
      if (present.count(other) == 0) {
        ASSERT_EQ(grid.row(level, other), -1);
      }
    }
    EXPECT_EQ(grid.row(level, Coord(777777, -777777, 777777)), -1);
  }
}

TEST(TokenGrid, EveryChildHasExactlyOneParent) {
  const TokenGrid grid = TokenGrid::fromCoords(randomVoxels(4, 3000));
  for (int level = 0; level + 1 < kTokenLevels; ++level) {
    ASSERT_EQ(grid.parents(level).size(), size_t(grid.size(level)));
    ASSERT_EQ(grid.children(level + 1).size(), size_t(grid.size(level + 1)));
    std::vector<int> claimed(size_t(grid.size(level)), 0);
    for (int32_t p = 0; p < grid.size(level + 1); ++p) {
      for (int slot = 0; slot < 8; ++slot) {
        const int32_t child = grid.children(level + 1)[size_t(p)][size_t(slot)];
        const Coord at = childCoord(grid.coords(level + 1)[size_t(p)], slot);
        EXPECT_EQ(child, grid.row(level, at));
        if (child < 0) continue;
        ++claimed[size_t(child)];
        EXPECT_EQ(grid.parents(level)[size_t(child)], p);
      }
    }
    EXPECT_EQ(std::count(claimed.begin(), claimed.end(), 1), grid.size(level));
  }
}

TEST(TokenGrid, ChildrenOfANodeAreConsecutive) {
  const TokenGrid grid = TokenGrid::fromCoords(randomVoxels(5, 5000));
  for (int level = 0; level + 1 < kTokenLevels; ++level) {
    EXPECT_TRUE(std::is_sorted(grid.parents(level).begin(), grid.parents(level).end()));
  }
}

TEST(TokenGrid, OrderOfInputDoesNotMatter) {
  std::vector<Coord> voxels = randomVoxels(6, 2000);
  const TokenGrid a = TokenGrid::fromCoords(voxels);
  std::shuffle(voxels.begin(), voxels.end(), std::mt19937(1));
  const TokenGrid b = TokenGrid::fromCoords(voxels);
  for (int level = 0; level < kTokenLevels; ++level) EXPECT_EQ(a.coords(level), b.coords(level));
}

TEST(TokenGrid, TilesCountAsAllTheirVoxels) {
  TokenMask mask;
  mask.addTile(2, Coord(-4, 8, 0), true, true);   // 4^3
  mask.addTile(1, Coord(2, 0, 0), true, true);    // 2^3
  mask.addTile(3, Coord(256, 0, 0), true, true);  // 128^3, in the root
  mask.setValueOn(Coord(-1, -1, -1));
  mask.touchLeaf(Coord(1000, 1000, 1000));  // a leaf without active voxels is no token
  TokenMask voxels(mask);
  voxels.voxelizeActiveTiles();
  const TokenGrid grid(mask);
  EXPECT_EQ(grid.size(0), 64 + 8 + 128 * 128 * 128 + 1);
  EXPECT_EQ(grid.size(1), 8 + 1 + 64 * 64 * 64 + 1);
  EXPECT_EQ(grid.size(2), 1 + 1 + 32 * 32 * 32 + 1);
  EXPECT_EQ(grid.row(1, Coord(500, 500, 500)), -1);
  EXPECT_EQ(grid.row(2, Coord(250, 250, 250)), -1);
  EXPECT_EQ(activeCoords(mask), grid.coords(0));
  EXPECT_EQ(activeCoords(voxels), grid.coords(0));
}

TEST(TokenGrid, EmptyGridAnswers) {
  for (const TokenGrid& grid : {TokenGrid(), TokenGrid::fromCoords({})}) {
    for (int level = 0; level < kTokenLevels; ++level) {
      EXPECT_EQ(grid.size(level), 0);
      EXPECT_EQ(grid.row(level, Coord(0, 0, 0)), -1);
    }
  }
}

TEST(TokenGrid, CopiesAndAssignmentsAreTheSame) {
  const TokenGrid a = TokenGrid::fromCoords(randomVoxels(7, 500));
  TokenGrid b;
  b = a;
  for (int32_t i = 0; i < a.size(0); ++i) EXPECT_EQ(b.row(0, a.coords(0)[size_t(i)]), i);
}

// Nothing dense: far-apart voxels cost a bounded amount each.
TEST(TokenGrid, MemoryFollowsActiveVoxels) {
  const auto bytes = [](int count, int spacing) {
    std::vector<Coord> voxels;
    for (int i = 0; i < count; ++i) voxels.emplace_back(i * spacing, 0, 0);
    return double(maskFromCoords(voxels).memUsage());
  };
  EXPECT_NEAR(bytes(400, 1000) / bytes(100, 1000), 4, 0.1);
  EXPECT_NEAR(bytes(100, 1000) / bytes(100, 100000), 1, 0.1);
}

}  // namespace
}  // namespace vdbc
