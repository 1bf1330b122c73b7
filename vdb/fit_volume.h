#pragma once
// Where the grid lies in the world.
#include <optional>
#include <vector>

#include "vdb/carve.h"

namespace vdbc {

struct VolumeSettings {
  float voxel_m = 0.1f;
  /// Unit vector that points up in the input's world frame.
  Eigen::Vector3d up = Eigen::Vector3d::UnitZ();
  /// World box (min, max corners, metres) to complete; else fitted to what was seen.
  std::optional<Eigen::AlignedBox3d> bounds;
  float margin_m = 1.5f;           // horizontal room for what was not seen, when fitted
  float vertical_margin_m = 0.4f;  // the same above and below
  bool align_walls = true;         // turn the grid about `up` so that walls lie along its axes
};

/// The volume of a scene: z of the grid is up, yaw follows the walls (strongest direction of the
/// horizontal surface normals), the box holds the seen points (0.5 % outliers trimmed at each side)
/// and the cameras, grown by the margins; bounds are multiples of 4 voxels. The grid's origin is
/// the box's lowest corner, so that the same place gives the same voxels wherever in the world it
/// lies. With `bounds`, the grid keeps the world's heading: a turned box would be larger than was
/// asked for. See docs/method.md, section 2.2. Throws Error if no view has a usable depth, or the
/// volume would exceed kMaxVolumeSide voxels a side or lie beyond kMaxWorldM.
VoxelFrame fitVolume(const std::vector<DepthView>& views, const VolumeSettings& settings,
                     const CarveSettings& carving);

}  // namespace vdbc
