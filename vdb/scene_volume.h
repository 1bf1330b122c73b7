#pragma once
// Where the grid lies in the world, and the grids that leave the program (formats.md 2.3).
#include <openvdb/math/Transform.h>

#include <optional>
#include <string>
#include <vector>

#include "vdb/carve.h"

namespace vdbc {

constexpr int kMaxVolumeSide = 4096;  // voxels
constexpr int kMaxVolumeIndex =
    1 << 28;  // voxels; far inside int32, so sums of coordinates are too

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
/// the world's. With `bounds`, the grid keeps the world's heading: a turned box would be larger
/// than was asked for. Decision 2 of the design. Throws Error if no view has a usable depth or the
/// volume would exceed 4,096 voxels a side.
VoxelFrame fitVolume(const std::vector<DepthView>& views, const VolumeSettings& settings,
                     const CarveSettings& carving);

/// The frame as files have it, for grids of the nodes of `level` (0: voxels): row vectors, node
/// centres at whole indices.
openvdb::math::Transform::Ptr fileTransform(const VoxelFrame& frame, int level = 0);

/// What a finished scene says about its voxels; arrays are parallel, [N].
struct SceneVoxels {
  VoxelFrame frame;
  std::vector<Coord> ijk;
  std::vector<Eigen::Vector3f> colour_linear;  // scene-linear Rec.709
  std::vector<float> density;                  // 0-1, opacity of the voxel
  std::vector<uint8_t> observed;               // 1: an input view saw it; 0: generated
  std::vector<float> probability;  // its token's, which tau is compared with; 1 for observed
  std::vector<int32_t> bfs_level;  // growth level, 0 for observed
  TokenMask empty;                 // E of the input views (kept open in `surface`)
};

/// Writes standard 5-4-3 grids: surface (level set), density (fog), Cd (vec3s), observed, generated
/// (bool), probability, bfs_level (float), seen_empty (bool); world transform with the grid's
/// rotation; metadata as formats.md 2.3. Voxel ijk's centre is at ijk + 0.5 in frame units: the
/// file's transform has the half-voxel shift so that grid index space is cell-centred. `surface` is
/// the exact distance to the boundary of the voxels; generated ones that lie in `empty` are left
/// out of it. A checksum follows what OpenVDB reads. Written to a temporary name and renamed.
/// Throws Error for voxels outside the bounds, twice the same, or with values that are not finite,
/// and where the file cannot be written.
void writeSceneVdb(const SceneVoxels& voxels, const std::string& path);

/// Several completions of one place, each as its voxels: float grids `occupancy_mean` and
/// `occupancy_variance` (the share of them that fill a voxel, m, and m (1 - m)), cell-centred as
/// above. Throws Error where the file cannot be written.
void writeOccupancyVdb(const VoxelFrame& frame, const std::vector<std::vector<Coord>>& completions,
                       const std::string& path);

/// Reads back what writeSceneVdb wrote (all but `surface`, which is derived), voxels in the order
/// of the file's tree. Also when another program wrote the file again. Throws Error on files that
/// are missing, corrupt, lack the grids or say what cannot be.
SceneVoxels readSceneVdb(const std::string& path);

}  // namespace vdbc
