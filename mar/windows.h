#pragma once
// Private: parts of a volume that the networks look at as one.
#include <map>
#include <vector>

#include "mar/config.h"
#include "vdb/frame.h"

namespace vdbc {

/// What a window decides, and that with its surroundings, from whose middle positions are measured.
struct Window {
  CoordBBox core;    // voxels
  VoxelFrame frame;  // its bounds are the core grown by the overlap
};

/// Cuts a volume into windows no wider than the position code was made for, around its content: a
/// room that fits into one, less its overlaps, is not cut, however wide the volume. Windows are
/// numbered, z fastest, and made when asked for: a wide volume has many, of which few hold
/// anything.
class Windows {
 public:
  /// `content` [voxels]: the filled coarse nodes.
  Windows(const VoxelFrame& whole, const CoordBBox& content, const CompleterConfig& config);

  Window window(size_t number) const;
  /// The window whose core holds the first voxel of a node of `level`.
  size_t of(const Coord& node, int level) const;
  /// The windows whose frames hold one of the nodes of `level`, ascending.
  std::vector<size_t> around(const std::vector<Coord>& nodes, int level) const;
  /// Tokens of level 1 by window, in their order.
  std::map<size_t, std::vector<Coord>> split(const std::vector<Coord>& tokens) const;

 private:
  size_t at(const Coord& voxel) const;

  VoxelFrame whole_;
  int overlap_;                            // voxels
  std::array<std::vector<int>, 3> begin_;  // first voxel of each part of an axis
};

}  // namespace vdbc
