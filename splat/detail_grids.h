#pragma once
// What a finished place is, in detail voxels. See docs/method.md, section 6.5.
#include "splat/gaussians.h"
#include "vdb/scene_vdb.h"

namespace vdbc {

/// The surface of the voxels (closedSurface()), how much of each detail voxel lies behind it (0 to
/// 1), and scene-linear colour inside and as far before the surface as a sample at it looks: that
/// of the Gaussians around, near and small ones first, and of the voxels where there are none.
/// Density and colour are tiles where uniform, colour that was made up also where nearly so. Null
/// grids where it is not known what the views measured. Parallel; the same values for any number of
/// threads.
DetailGrids detailGrids(const SceneVoxels& voxels, const Gaussians& gaussians);

}  // namespace vdbc
