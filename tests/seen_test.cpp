// Filled, seen empty, unobserved, by nodes (docs/method.md, sections 2.4 and 2.5): against brute
// force over every voxel and node.
#include "vdb/seen.h"

#include <gtest/gtest.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <set>

#include "vdb/error.h"

namespace vdbc {
namespace {

Coord randomIn(const CoordBBox& box, std::mt19937& random) {
  Coord c;
  for (int axis = 0; axis < 3; ++axis)
    c[axis] = box.min()[axis] + int(random() % unsigned(box.dim()[axis]));
  return c;
}

CoordBBox randomBoxIn(const CoordBBox& box, std::mt19937& random) {
  const Coord a = randomIn(box, random), b = randomIn(box, random);
  return CoordBBox(Coord::minComponent(a, b), Coord::maxComponent(a, b));
}

/// Voxels in an odd box: empty ones in large pieces with holes, filled ones scattered.
SeenSpace randomSpace(unsigned seed) {
  std::mt19937 random(seed);
  const auto odd = [&](int most) { return int(random() % unsigned(most)); };
  const Coord low(odd(40) - 35, odd(40) - 35, odd(40) - 35);
  SeenSpace space;
  space.box = CoordBBox(low, low + Coord(odd(25), odd(25), odd(25)));
  for (int i = 0; i < 4; ++i) space.empty.sparseFill(randomBoxIn(space.box, random), true, true);
  for (int i = odd(4); i > 0; --i) {
    const CoordBBox hole(randomIn(space.box, random), randomIn(space.box, random));
    if (!hole.empty()) space.empty.sparseFill(hole, false, false);
  }
  for (int i = odd(60); i > 0; --i) {
    const Coord c = randomIn(space.box, random);
    (i % 3 ? space.filled.setValueOn(c) : space.empty.setValueOff(c));
  }
  if (seed % 4 == 0) space.empty.sparseFill(space.box, true, true);
  space.empty.topologyDifference(space.filled);
  openvdb::tools::prune(space.empty);
  return space;
}

/// The same for nodes of a level.
SeenSpace randomNodes(unsigned seed) {
  SeenSpace space = randomSpace(seed);
  space.level = 1 + int(seed % 2);
  return space;
}

bool touchesUnobserved(const SeenSpace& space, const Coord& c) {
  for (auto n = CoordBBox(c.offsetBy(-1), c.offsetBy(1)).begin(); n; ++n)
    if (space.box.isInside(*n) && space.at(*n) == NodeState::kUnobserved) return true;
  return false;
}

TEST(PoolSeen, FollowsItsRuleOnRandomVoxels) {
  std::map<std::pair<int, NodeState>, int> kinds;
  for (unsigned seed = 1; seed <= 60; ++seed) {
    const SeenSpace voxels = randomSpace(seed);
    for (int level = 0; level <= 5; ++level) {
      SCOPED_TRACE(testing::Message() << "seed " << seed << " level " << level);
      const SeenSpace pooled = poolSeen(voxels, level);
      EXPECT_EQ(pooled.level, level);
      struct Counts {
        int voxels = 0, filled = 0, empty = 0;
      };
      std::map<Coord, Counts> counts;
      for (auto c = voxels.box.begin(); c; ++c) {
        const int side = 1 << level;
        Counts& n = counts[Coord(int(std::floor(double((*c).x()) / side)),
                                 int(std::floor(double((*c).y()) / side)),
                                 int(std::floor(double((*c).z()) / side)))];
        ++n.voxels, n.filled += voxels.filled.isValueOn(*c), n.empty += voxels.empty.isValueOn(*c);
      }
      EXPECT_EQ(pooled.box.volume(), counts.size());
      uint64_t filled = 0, empty = 0;
      for (const auto& [node, n] : counts) {
        const NodeState truth = n.filled              ? NodeState::kFilled
                                : n.empty == n.voxels ? NodeState::kEmpty
                                                      : NodeState::kUnobserved;
        ASSERT_TRUE(pooled.box.isInside(node));
        ASSERT_EQ(pooled.at(node), truth) << node;
        ++kinds[{level, truth}];
        filled += truth == NodeState::kFilled, empty += truth == NodeState::kEmpty;
      }
      // Nothing beside them.
      EXPECT_EQ(pooled.filled.activeVoxelCount(), filled);
      EXPECT_EQ(pooled.empty.activeVoxelCount(), empty);
    }
  }
  for (int level = 0; level <= 3; ++level)
    for (NodeState state : {NodeState::kFilled, NodeState::kEmpty, NodeState::kUnobserved})
      EXPECT_GT((kinds[{level, state}]), 20) << level;
}

TEST(PoolSeen, KeepsWideEmptySpaceAsTiles) {
  // 25 km of seen empty space at 10 cm, with one filled voxel.
  SeenSpace voxels;
  voxels.box = CoordBBox(Coord(-128000), Coord(127999, 511, 511));
  voxels.box.min().y() = voxels.box.min().z() = 0;
  voxels.empty.sparseFill(voxels.box, true, true);
  voxels.filled.setValueOn(Coord(777, 77, 7)), voxels.empty.setValueOff(Coord(777, 77, 7));
  for (int level : {1, 2}) {
    const SeenSpace pooled = poolSeen(voxels, level);
    EXPECT_EQ(pooled.empty.activeVoxelCount(), pooled.box.volume() - 1);
    EXPECT_EQ(filledNodes(pooled), std::vector<Coord>{tokenCoord(Coord(777, 77, 7), level)});
    // A few thousand tiles of 128^3, of which one is parted into 32^3 for the filled node.
    EXPECT_LT(pooled.empty.leafCount() + pooled.empty.activeTileCount(), 4000u + 32768u + 100u);
  }
}

TEST(PoolSeen, RefusesOtherLevels) {
  SeenSpace voxels;
  voxels.box = CoordBBox(Coord(0), Coord(3));
  EXPECT_THROW(poolSeen(voxels, -1), Error);
  EXPECT_THROW(poolSeen(voxels, 11), Error);
  voxels.level = 1;
  EXPECT_THROW(poolSeen(voxels, 1), Error);
  EXPECT_THROW(poolSeen(voxels, 2), Error);
}

TEST(PoolSeen, NothingSeenIsNothing) {
  const SeenSpace none = poolSeen(SeenSpace(), 2);
  EXPECT_TRUE(none.box.empty());
  EXPECT_TRUE(filledNodes(none).empty() && emptyNodes(none).empty() && emptyShell(none).empty());
  EXPECT_EQ(none.at(Coord(0)), NodeState::kUnobserved);
  SeenSpace unseen;
  unseen.box = CoordBBox(Coord(-5), Coord(6));
  const SeenSpace pooled = poolSeen(unseen, 1);
  EXPECT_EQ(pooled.box, CoordBBox(Coord(-3), Coord(3)));
  EXPECT_EQ(unobservedNodes(pooled, pooled.box).size(), 7u * 7 * 7);
}

TEST(SeenSpace, FilledWinsAndLookupsAgree) {
  SeenSpace space;
  space.box = CoordBBox(Coord(0), Coord(3));
  space.filled.setValueOn(Coord(1)), space.empty.sparseFill(space.box, true, true);
  space.empty.setValueOff(Coord(2));
  EXPECT_EQ(space.at(Coord(1)), NodeState::kFilled);
  EXPECT_EQ(space.at(Coord(2)), NodeState::kUnobserved);
  EXPECT_EQ(space.at(Coord(3)), NodeState::kEmpty);
  EXPECT_EQ(space.at(Coord(4)), NodeState::kUnobserved);
  for (unsigned seed = 1; seed <= 5; ++seed) {
    const SeenSpace random = randomSpace(seed);
    const StateLookup lookup(random);
    CoordBBox around = random.box;
    around.expand(2);
    for (auto c = around.begin(); c; ++c) ASSERT_EQ(lookup(*c), random.at(*c)) << *c;
  }
}

TEST(SeenSpace, ListsAreSortedAndComplete) {
  for (unsigned seed = 1; seed <= 40; ++seed) {
    SCOPED_TRACE(seed);
    const SeenSpace space = randomNodes(seed);
    std::mt19937 random(seed);
    std::vector<Coord> filled, empty, shell;
    for (auto c = space.box.begin(); c; ++c) {  // by x, then y, then z
      const NodeState state = space.at(*c);
      if (state == NodeState::kFilled) filled.push_back(*c);
      if (state == NodeState::kEmpty) empty.push_back(*c);
      if (state == NodeState::kEmpty && touchesUnobserved(space, *c)) shell.push_back(*c);
    }
    EXPECT_EQ(filledNodes(space), filled);
    EXPECT_EQ(emptyNodes(space), empty);
    EXPECT_EQ(emptyShell(space), shell);
    for (const CoordBBox& part : {space.box, randomBoxIn(space.box, random)}) {
      std::vector<Coord> unobserved;
      for (auto c = part.begin(); c; ++c)
        if (space.at(*c) == NodeState::kUnobserved) unobserved.push_back(*c);
      EXPECT_EQ(unobservedNodes(space, part), unobserved);
    }
  }
}

TEST(SeenIn, IsTheSpaceInTheBoxAndUnobservedBeyond) {
  for (unsigned seed = 1; seed <= 40; ++seed) {
    SCOPED_TRACE(seed);
    const SeenSpace space = randomNodes(seed);
    std::mt19937 random(seed);
    CoordBBox around = space.box;
    around.expand(6);
    for (const CoordBBox& box : {randomBoxIn(around, random), randomBoxIn(space.box, random)}) {
      const SeenSpace part = seenIn(space, box);
      EXPECT_EQ(part.level, space.level);
      EXPECT_EQ(part.box, box);
      uint64_t filled = 0, empty = 0;
      for (auto c = box.begin(); c; ++c) {
        ASSERT_EQ(part.at(*c), space.at(*c)) << *c;
        filled += part.at(*c) == NodeState::kFilled, empty += part.at(*c) == NodeState::kEmpty;
      }
      EXPECT_EQ(part.filled.activeVoxelCount(), filled);
      EXPECT_EQ(part.empty.activeVoxelCount(), empty);
    }
  }
}

}  // namespace
}  // namespace vdbc
