#pragma once
// What is done to a level set whose signs are known: parts that are none are dropped, distances are
// solved for.
#include <functional>

#include "vdb/grid_instances.h"

namespace vdbc {

/// Makes those connected parts of negative voxels (by faces, in leaves) positive that are shorter
/// than `least_voxels` along every axis and of which no voxel is `kept`. Returns how many.
int64_t dropSmallParts(int least_voxels, const std::function<bool(const Coord&)>& kept,
                       FloatTree* tree);

/// Replaces values, of which only those beside a change of sign say how far off the surface is, by
/// the signed distance to it in the same unit, `voxel` along an edge: solves the Eikonal equation
/// (Godunov's upwind scheme) up to `half_width` voxels. Only voxels within are active; beyond are
/// inactive ones of plus or minus the half width. The tree's background is half the width, its
/// leaves reach over the band. Parallel; the same values for any number of threads.
void solveDistances(float voxel, int half_width, FloatTree* tree);

}  // namespace vdbc
