#pragma once
// A token is a VDB node. The sparse tree is the token hierarchy: no hash maps, no second hierarchy.
//
//   level 0  voxel            value in a leaf (2^3)               0.1 m at the default voxel size
//   level 1  latent           a leaf, or a tile in its parent     0.2 m
//   level 2  coarse           a node of 4^3, or a tile in its parent   0.4 m
//
// A level-l coordinate is ijk >> l (floor). Trees for computing are 2-4-128 (below); files carry
// standard 5-4-3 grids only, conversion happens in scene_vdb.h.
#include <openvdb/Types.h>
#include <openvdb/tree/Tree.h>

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

namespace vdbc {

using openvdb::Coord;
using openvdb::CoordBBox;

template <typename T>
using ComputeTree = openvdb::tree::Tree<openvdb::tree::RootNode<
    openvdb::tree::InternalNode<openvdb::tree::InternalNode<openvdb::tree::LeafNode<T, 1>, 1>, 5>>>;

/// Topology of a set of voxels or, by its tiles, nodes (active states only). OpenVDB deletes the
/// assignment of trees: write `to.root() = from.root()`.
using TokenMask = ComputeTree<openvdb::ValueMask>;
using TokenIndexTree = ComputeTree<openvdb::Int32>;

}  // namespace vdbc

// Instantiated in grid_instances.cpp: else every file that owns one compiles its vtable.
extern template class openvdb::tree::Tree<vdbc::TokenMask::RootNodeType>;
extern template class openvdb::tree::Tree<vdbc::TokenIndexTree::RootNodeType>;

namespace vdbc {

constexpr int kTokenLevels = 3;  // voxel, latent, coarse

/// The coordinate of the level-`level` token that contains voxel `ijk` (floor, also for negatives).
inline Coord tokenCoord(const Coord& ijk, int level) {
  return Coord(ijk.x() >> level, ijk.y() >> level, ijk.z() >> level);
}

/// The first (lowest) voxel of a node of `level`. (Shifting negative numbers left is undefined.)
inline Coord firstVoxel(const Coord& node, int level) {
  return Coord(node.x() * (1 << level), node.y() * (1 << level), node.z() * (1 << level));
}
/// The voxels of a node of `level`.
inline CoordBBox voxelsIn(const Coord& node, int level) {
  return CoordBBox::createCube(firstVoxel(node, level), 1 << level);
}
/// The nodes of `level` that a box of voxels touches.
inline CoordBBox nodesIn(const CoordBBox& voxels, int level) {
  return CoordBBox(tokenCoord(voxels.min(), level), tokenCoord(voxels.max(), level));
}

/// Slot 0..7 of a child in its parent: (x & 1) << 2 | (y & 1) << 1 | (z & 1), the offset of
/// OpenVDB's own 2^3 nodes.
inline int childSlot(const Coord& ijk) {
  return (ijk.x() & 1) << 2 | (ijk.y() & 1) << 1 | (ijk.z() & 1);
}
inline Coord childCoord(const Coord& parent, int slot) {
  return Coord(parent.x() * 2 + (slot >> 2 & 1), parent.y() * 2 + (slot >> 1 & 1),
               parent.z() * 2 + (slot & 1));
}

/// Whether any, or every, voxel of a node of `level` is active in `mask`, a tree or an accessor.
template <typename Mask>
bool anyVoxelOn(const Mask& mask, const Coord& node, int level) {
  for (auto voxel = voxelsIn(node, level).begin(); voxel; ++voxel)
    if (mask.isValueOn(*voxel)) return true;
  return false;
}
template <typename Mask>
bool allVoxelsOn(const Mask& mask, const Coord& node, int level) {
  for (auto voxel = voxelsIn(node, level).begin(); voxel; ++voxel)
    if (!mask.isValueOn(*voxel)) return false;
  return true;
}

/// Rows of all tokens of a voxel topology and the maps between levels. Rows of each level are in
/// tree iteration order, so the rows of a node's children are consecutive. Immutable after
/// construction. See docs/method.md, section 2.3.
class TokenGrid {
 public:
  TokenGrid() = default;
  /// One level-0 token per active voxel of `voxels` (active tiles count as all their voxels).
  explicit TokenGrid(const TokenMask& voxels);
  /// The same from voxel coordinates, in any order, duplicates allowed.
  static TokenGrid fromCoords(const std::vector<Coord>& voxels);

  int64_t size(int level) const { return int64_t(coords_[level].size()); }
  /// [N_level] coordinates in units of that level (ijk >> level).
  const std::vector<Coord>& coords(int level) const { return coords_[level]; }
  /// [N_level] row at level + 1 of each token's parent; level in {0, 1}.
  const std::vector<int32_t>& parents(int level) const { return parents_[level]; }
  /// [N_level] row at level - 1 of each of the 8 children, -1 where absent; level in {1, 2}.
  const std::vector<std::array<int32_t, 8>>& children(int level) const {
    return children_[level - 1];
  }
  /// Row of the token at `ijk` (in units of `level`), -1 where there is none.
  int32_t row(int level, const Coord& ijk) const;

 private:
  // Voxel rows; a node's row is its first child's parent. Shared by copies: it never changes (and
  // OpenVDB's trees cannot be assigned).
  std::shared_ptr<const TokenIndexTree> tree_;
  std::array<std::vector<Coord>, kTokenLevels> coords_;
  std::array<std::vector<int32_t>, kTokenLevels - 1> parents_;
  std::array<std::vector<std::array<int32_t, 8>>, kTokenLevels - 1> children_;
};

/// Mask of voxels from coordinates (any order, duplicates allowed).
TokenMask maskFromCoords(const std::vector<Coord>& voxels);

/// All active voxels of `mask` in tree order (active tiles are expanded).
std::vector<Coord> activeCoords(const TokenMask& mask);

}  // namespace vdbc
