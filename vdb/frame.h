#pragma once
// The grid that everything is computed on, and its place in the world.
#include <openvdb/Types.h>

#include <Eigen/Geometry>

namespace vdbc {

using openvdb::Coord;
using openvdb::CoordBBox;

constexpr int kMaxVolumeSide = 4096;  // voxels
/// The limit on coordinates, voxels: far inside int32, so that sums of coordinates are too. Grids
/// of ours start at their volume; this is what other people's may hold.
constexpr int kMaxVolumeIndex = 1 << 28;
/// The limit on places in the world, metres: double precision keeps a hundredth of a millimetre.
constexpr double kMaxWorldM = 1e10;

/// A box of voxels and its place in the world. Grids that are fitted to views start at their
/// volume, wherever in the world it is: all that is computed in the grid's own terms is near 0.
/// world = origin + rotation * (ijk * voxel_m); voxel ijk covers [ijk, ijk + 1) (corner-based).
struct VoxelFrame {
  float voxel_m = 0.1f;                                               // voxel edge, metres
  Eigen::Isometry3d world_from_grid = Eigen::Isometry3d::Identity();  // metres to metres
  CoordBBox bounds;  // voxels of the volume, inclusive

  Eigen::Vector3d toIndex(const Eigen::Vector3d& p_world) const {
    return world_from_grid.inverse() * p_world / double(voxel_m);
  }
  Eigen::Vector3d toWorld(const Eigen::Vector3d& p_index) const {
    return world_from_grid * (p_index * double(voxel_m));
  }
};

}  // namespace vdbc
