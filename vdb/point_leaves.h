#pragma once
// Private: points into the leaves of an OpenVDB points tree, and the checks before they are read.
// Compiling what includes this is slow.
#include <openvdb/points/AttributeArray.h>
#include <openvdb/points/PointDataGrid.h>

#include <string>
#include <vector>

namespace vdbc {

using PointTree = openvdb::points::PointDataTree;
using PointLeaf = PointTree::LeafNodeType;
using PointGrid = openvdb::points::PointDataGrid;

// Pairs of type and codec that every OpenVDB reader has registered: these, and fixed point.
using HalfCodec = openvdb::points::TruncateCodec;
using ExactCodec = openvdb::points::NullCodec;
constexpr float kMaxHalf = 65504.f;

/// Points rows[begin] to rows[end - 1] lie in `leaf`, in that order.
struct LeafRows {
  PointLeaf* leaf;
  size_t begin, end;
};

/// A tree with room for every point; only P is there, not yet set.
struct PointLayout {
  PointTree::Ptr tree;
  std::vector<int64_t> rows;  // of all points, by leaf, then voxel, then number
  std::vector<LeafRows> leaves;
};

/// Sorts points into the leaves of a new tree. `voxels` [N] are the points' voxels, which must lie
/// within 2^20 of each other; `position` is the type of the attribute P.
PointLayout layOutPoints(const std::vector<openvdb::Coord>& voxels,
                         const openvdb::NamePair& position);

/// The points of a leaf. Throws Error or openvdb's own unless its voxels share out exactly the
/// values that each of its attributes has.
size_t checkedPointCount(const char* operation, const PointLeaf& leaf, const std::string& path);

template <typename T, typename Codec>
auto writeHandle(PointLeaf& leaf, const char* name) {
  return openvdb::points::AttributeWriteHandle<T, Codec>(leaf.attributeArray(name));
}
/// Throws openvdb::TypeError where the attribute has another type.
template <typename T>
auto readHandle(const PointLeaf& leaf, const char* name) {
  return openvdb::points::AttributeHandle<T>(leaf.constAttributeArray(name));
}

inline bool hasAttribute(const PointLeaf& leaf, const char* name) {
  return leaf.attributeSet().descriptor().find(name) != openvdb::points::AttributeSet::INVALID_POS;
}

}  // namespace vdbc
