#pragma once
// A measured distance, carried on beyond the borders of what was measured.
#include <Eigen/Core>
#include <vector>

#include "vdb/grid_instances.h"

namespace vdbc {

struct ContinuationSettings {
  int plane_voxels = 2;          // half width of the cube in which planes are fitted
  float reach = .2f;             // metres from the border, along the surface
  float before = 0, behind = 0;  // metres: how far off the surface
};

/// A voxel of which no view tells the distance, and the plane by which a measured surface goes on.
struct ContinuedVoxel {
  Coord ijk;
  float distance;          // of its centre, metres
  Eigen::Vector3f normal;  // unit, into what is free
  float reach;             // metres from the border, along the surface
};

/// Carries the distances of `measured` (active where they are known, cut off at plus or minus its
/// background, `voxel` metres along an edge) on into the voxels that are not active, one layer
/// after the other: each takes the mean of the planes through its neighbours, which at the border
/// are fitted to what was measured around. Parallel; the same voxels, in the same order, for any
/// number of threads.
std::vector<ContinuedVoxel> continueDistance(const FloatTree& measured, float voxel,
                                             const ContinuationSettings& settings);

}  // namespace vdbc
