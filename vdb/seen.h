#pragma once
// Filled, seen empty, unobserved: the partition V = F + E + U (paper sec. 4), as topologies.
#include <openvdb/tree/ValueAccessor.h>

#include <vector>

#include "vdb/frame.h"
#include "vdb/token_grid.h"

namespace vdbc {

enum class NodeState : uint8_t { kUnobserved = 0, kEmpty = 1, kFilled = 2 };

/// Of a node, by the topologies of what was filled and seen empty: trees or accessors.
template <typename Mask>
NodeState stateOf(const Mask& filled, const Mask& empty, const Coord& node) {
  return filled.isValueOn(node)  ? NodeState::kFilled
         : empty.isValueOn(node) ? NodeState::kEmpty
                                 : NodeState::kUnobserved;
}

/// What was seen of a box of nodes of one tree level. Memory follows what was seen: U is what is in
/// neither topology, however large the box.
struct SeenSpace {
  int level = 0;
  CoordBBox box;     // nodes of that level, inclusive; both topologies lie in it
  TokenMask filled;  // F: a valid pixel's point lies in the node
  TokenMask empty;   // E: not F, and all of it was passed by rays before they hit; pruned to tiles

  /// U outside the box. Safe to call from several threads; StateLookup is faster.
  NodeState at(const Coord& node) const { return stateOf(filled, empty, node); }
};

/// SeenSpace::at() for many neighbouring nodes; one a thread. The space has to outlive it.
class StateLookup {
 public:
  explicit StateLookup(const SeenSpace& space) : filled_(space.filled), empty_(space.empty) {}
  NodeState operator()(const Coord& node) const { return stateOf(filled_, empty_, node); }

 private:
  openvdb::tree::ValueAccessor<const TokenMask> filled_, empty_;
};

/// Voxels pooled to nodes of `level`: F if any voxel is F, E if all voxels in the box are E, else
/// U. Throws Error for levels below 0 or above 10, and unless `voxels` are of level 0.
SeenSpace poolSeen(const SeenSpace& voxels, int level);

/// The part of `space` in a box of nodes; what lies outside of `space` is U.
SeenSpace seenIn(const SeenSpace& space, const CoordBBox& nodes);

/// F and E as lists, tiles expanded, by x, then y, then z.
std::vector<Coord> filledNodes(const SeenSpace& space);
std::vector<Coord> emptyNodes(const SeenSpace& space);
/// The nodes of `nodes`, a part of the box, that are U, in the same order. Takes time by its
/// volume.
std::vector<Coord> unobservedNodes(const SeenSpace& space, const CoordBBox& nodes);
/// E nodes with a U node of the box among their 26 neighbours, in the same order.
std::vector<Coord> emptyShell(const SeenSpace& space);

}  // namespace vdbc
