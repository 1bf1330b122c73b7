#pragma once
// A measured distance, carried on beyond the borders of what was measured.
#include <Eigen/Core>
#include <vector>

#include "vdb/grid_instances.h"

namespace vdbc {

/// A voxel of which no view tells the distance, and the plane by which a measured surface goes on.
struct ContinuedVoxel {
  Coord ijk;
  float distance;          // of its centre, metres
  Eigen::Vector3f normal;  // unit, into what is free
  float reach;             // metres from the border, along the axes
};

/// Carries the distances of `measured` (active where they are known, cut off at plus or minus its
/// background, `voxel` metres along an edge) on into the voxels that are not active, one layer after
/// the other, up to `reach`: each takes the mean of the planes through its neighbours, which at the
/// border are fitted to what was measured in the cube of `plane_voxels` to each side. Parallel; the
/// same voxels, in the same order, for any number of threads.
std::vector<ContinuedVoxel> continueDistance(const FloatTree& measured, float voxel,
                                             int plane_voxels, float reach);

}  // namespace vdbc
