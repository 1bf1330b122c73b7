// Level sets of known signs: distances against a closed form, parts by hand.
#include "vdb/narrow_band.h"

#include <gtest/gtest.h>

#include <cmath>

#include "vdb/threads.h"

namespace vdbc {
namespace {

constexpr float kVoxel = .5f;
constexpr int kHalfWidth = 3;

FloatTree emptyTree() { return FloatTree(kHalfWidth * kVoxel); }

/// Values in whole leaves, as many as the box touches.
void fill(const CoordBBox& box, const std::function<float(const Coord&)>& value, FloatTree* tree) {
  for (const Coord& c : box) tree->touchLeaf(c);
  for (auto leaf = tree->beginLeaf(); leaf; ++leaf)
    for (openvdb::Index n = 0; n < FloatTree::LeafNodeType::SIZE; ++n)
      leaf->setValueOn(n, value(leaf->offsetToGlobalCoord(n)));
}

/// A ball of 7.3 voxels about (1, 2, 3), twice as steep as a distance.
FloatTree steepBall() {
  FloatTree tree = emptyTree();
  fill(
      CoordBBox(Coord(-12), Coord(15)),
      [](const Coord& c) {
        return 2 * kVoxel * float((c - Coord(1, 2, 3)).asVec3d().length() - 7.3);
      },
      &tree);
  return tree;
}

TEST(NarrowBand, DistancesOfABallAreThoseOfItsRadius) {
  FloatTree tree = steepBall();
  solveDistances(kVoxel, kHalfWidth, &tree);
  int active = 0;
  for (const Coord& c : CoordBBox(Coord(-12), Coord(15))) {
    const double expected = double(kVoxel) * ((c - Coord(1, 2, 3)).asVec3d().length() - 7.3);
    const double band = double(kHalfWidth * kVoxel);
    if (std::abs(expected) > band + .1) {
      ASSERT_FALSE(tree.isValueOn(c)) << c;
      ASSERT_EQ(tree.getValue(c), expected < 0 ? -band : band) << c;
    } else {
      ASSERT_NEAR(tree.getValue(c), std::clamp(expected, -band, band), .3 * double(kVoxel)) << c;
      active += tree.isValueOn(c);
    }
  }
  EXPECT_NEAR(active, 4 * M_PI * 7.3 * 7.3 * 6, 300);
}

TEST(NarrowBand, DistancesAreTheSameForAnyNumberOfThreads) {
  const auto at = [](int threads) {
    return withThreads(threads, [] {
      FloatTree tree = steepBall();
      solveDistances(kVoxel, kHalfWidth, &tree);
      return tree;
    });
  };
  const FloatTree one = at(1), four = at(4);
  ASSERT_EQ(one.activeVoxelCount(), four.activeVoxelCount());
  for (auto value = one.cbeginValueOn(); value; ++value)
    ASSERT_EQ(*value, four.getValue(value.getCoord()));
}

TEST(NarrowBand, SmallPartsAreDroppedAndLongOrKeptOnesAreNot) {
  const CoordBBox small(Coord(6, 6, 6), Coord(8, 9, 8)),  // in eight leaves
      pole(Coord(-9, 2, 2), Coord(-9, 2, 7)), kept(Coord(20), Coord(20));
  FloatTree tree = emptyTree();
  fill(
      CoordBBox(Coord(-16), Coord(31)),
      [&](const Coord& c) {
        const bool inside = small.isInside(c) || pole.isInside(c) || kept.isInside(c);
        return inside ? -1.f : 1.f;
      },
      &tree);
  const auto isKept = [&](const Coord& c) { return kept.isInside(c); };
  FloatTree other = tree;
  EXPECT_EQ(dropSmallParts(4, isKept, &other), 0);  // the small one is four voxels wide
  EXPECT_EQ(dropSmallParts(5, isKept, &tree), 1);
  for (auto value = tree.cbeginValueOn(); value; ++value) {
    const Coord c = value.getCoord();
    ASSERT_EQ(*value < 0, pole.isInside(c) || kept.isInside(c)) << c;
  }
}

}  // namespace
}  // namespace vdbc
