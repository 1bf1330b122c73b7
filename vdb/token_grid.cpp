#include "vdb/token_grid.h"

#include <openvdb/tree/LeafManager.h>
#include <openvdb/tree/ValueAccessor.h>
#include <tbb/parallel_for.h>

#include <limits>

#include "vdb/error.h"

namespace vdbc {
namespace {

// Calls f(leaf, row of its first active voxel) in parallel; returns the number of active voxels.
// LeafManager lists leaves in tree order, so rows are in tree order whatever the thread count.
template <typename TreeT, typename F>
int64_t forEachLeaf(TreeT& tree, const F& f) {
  const openvdb::tree::LeafManager<TreeT> leaves(tree);
  std::vector<int64_t> first(leaves.leafCount() + 1, 0);
  for (size_t i = 0; i < leaves.leafCount(); ++i) {
    first[i + 1] = first[i] + leaves.leaf(i).onVoxelCount();
  }
  tbb::parallel_for(tbb::blocked_range<size_t>(0, leaves.leafCount(), 256),
                    [&](const tbb::blocked_range<size_t>& range) {
                      for (size_t i = range.begin(); i != range.end(); ++i) {
                        f(leaves.leaf(i), first[i]);
                      }
                    });
  return first.back();
}

// The leaves are 2^3: expanding tiles is what makes the count of rows grow, so check before.
TokenMask voxelized(const TokenMask& mask) {
  const auto count = mask.activeVoxelCount();
  require(count <= uint64_t(std::numeric_limits<int32_t>::max()),
          "token grid: expected at most 2^31 - 1 active voxels, found ", count);
  TokenMask copy(mask);
  copy.voxelizeActiveTiles();
  return copy;
}

}  // namespace

TokenGrid::TokenGrid(const TokenMask& voxels) {
  const TokenMask mask = voxelized(voxels);
  const auto tree =
      std::make_shared<TokenIndexTree>(mask, /*background=*/-1, openvdb::TopologyCopy());
  tree_ = tree;

  coords_[0].resize(size_t(mask.activeVoxelCount()));
  forEachLeaf(*tree, [&](TokenIndexTree::LeafNodeType& leaf, int64_t row) {
    for (auto v = leaf.beginValueOn(); v; ++v, ++row) {
      v.setValue(int32_t(row));
      coords_[0][size_t(row)] = v.getCoord();
    }
  });

  // Parents of consecutive rows are equal or new: a node's children are consecutive in tree order.
  for (int level = 0; level + 1 < kTokenLevels; ++level) {
    const auto& fine = coords_[level];
    auto& coarse = coords_[level + 1];
    auto& parents = parents_[level];
    auto& children = children_[level];
    parents.resize(fine.size());
    for (size_t i = 0; i < fine.size(); ++i) {
      const Coord parent = tokenCoord(fine[i], 1);
      if (coarse.empty() || coarse.back() != parent) {
        coarse.push_back(parent);
        children.push_back({-1, -1, -1, -1, -1, -1, -1, -1});
      }
      parents[i] = int32_t(coarse.size()) - 1;
      children.back()[size_t(childSlot(fine[i]))] = int32_t(i);
    }
  }
}

TokenGrid TokenGrid::fromCoords(const std::vector<Coord>& voxels) {
  return TokenGrid(maskFromCoords(voxels));
}

int32_t TokenGrid::row(int level, const Coord& ijk) const {
  assert(level >= 0 && level < kTokenLevels);
  if (!tree_) return -1;
  if (level == 0) return tree_->getValue(ijk);
  // A node holds no row of its own: any voxel below it leads to it. (Shifting negative numbers left
  // is undefined, so coordinates are doubled.)
  const auto twice = [](const Coord& c) { return Coord(c.x() * 2, c.y() * 2, c.z() * 2); };
  for (int slot = 0; slot < (level == 1 ? 1 : 8); ++slot) {
    const Coord latent = level == 1 ? ijk : childCoord(ijk, slot);
    const auto* leaf = tree_->probeConstLeaf(twice(latent));
    if (!leaf) continue;
    if (const auto v = leaf->cbeginValueOn()) {
      const int32_t row = parents_[0][size_t(*v)];
      return level == 1 ? row : parents_[1][size_t(row)];
    }
  }
  return -1;
}

TokenMask maskFromCoords(const std::vector<Coord>& voxels) {
  TokenMask mask;
  openvdb::tree::ValueAccessor<TokenMask> accessor(mask);
  for (const Coord& ijk : voxels) accessor.setValueOn(ijk);
  return mask;
}

std::vector<Coord> activeCoords(const TokenMask& mask) {
  const TokenMask copy = voxelized(mask);
  std::vector<Coord> coords(size_t(copy.activeVoxelCount()));
  forEachLeaf(copy, [&](const TokenMask::LeafNodeType& leaf, int64_t row) {
    for (auto v = leaf.cbeginValueOn(); v; ++v, ++row) coords[size_t(row)] = v.getCoord();
  });
  return coords;
}

}  // namespace vdbc
