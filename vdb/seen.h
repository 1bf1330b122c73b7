#pragma once
// Filled, seen empty, unobserved: the partition V = F + E + U (paper sec. 4).
#include <vector>

#include "vdb/frame.h"
#include "vdb/token_grid.h"

namespace vdbc {

/// Disjoint topologies of voxels; what is in neither is unobserved (U). Both clipped to the bounds.
struct SeenSpace {
  TokenMask filled;  // F: a valid pixel's point lies in the voxel
  TokenMask empty;   // E: not F, and some ray passes it before its hit voxel; pruned to tiles
};

enum class NodeState : uint8_t { kUnobserved = 0, kEmpty = 1, kFilled = 2 };

/// States pooled to a tree level: filled if any voxel is F, empty if all voxels inside the bounds
/// are E, else unobserved (spec A9). One entry per node of `level` that overlaps the bounds, in x,
/// y, z raster order (z fastest) of `box`.
struct NodeStates {
  int level = 1;
  CoordBBox box;  // in units of `level`, inclusive
  std::vector<NodeState> states;

  int64_t index(const Coord& ijk) const {
    const Coord d = box.dim(), o = ijk - box.min();
    return (int64_t(o.x()) * d.y() + o.y()) * d.z() + o.z();
  }
  NodeState at(const Coord& ijk) const {
    return box.isInside(ijk) ? states[size_t(index(ijk))] : NodeState::kUnobserved;
  }
};
NodeStates poolStates(const VoxelFrame& frame, const SeenSpace& space, int level);

}  // namespace vdbc
