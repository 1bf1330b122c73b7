#pragma once
// Depth views as one level set, as fine as they measured. See docs/method.md, section 6.5.
#include <vector>

#include "vdb/carve.h"
#include "vdb/grid_instances.h"

namespace vdbc {

struct FuseSettings {
  /// Edge of the detail voxels, metres; rounded down to a whole part of the frame's voxel. 0: as
  /// the views ask for, eight pixels or four sigmas of the depth's noise, 1 to 5 cm.
  float voxel_m = 0;
  CarveSettings carving;
};

constexpr int kDetailBand = 3;  // detail voxels: distances beyond are cut off

/// The signed distance to what the views measured (metres, positive before it), in detail voxels of
/// the voxels that `seen` says are filled and kDetailBand around them; active where a view tells
/// it: in front of what was measured, and so far behind. Detail voxel ijk covers [ijk, ijk + 1)
/// times their size in the frame's grid, the transform is a file's (vdb_file.h). A mean over views
/// of the distance to the plane around the pixel, by angle and distance (Curless and Levoy 1996);
/// free space counts, so that what one view saw in the air goes where others look through it.
/// Voxel-driven, parallel over leaves; the same bytes for any number of threads. Throws Error for a
/// voxel size that is not finite or larger than the frame's.
FloatGrid::Ptr fuseDepth(const VoxelFrame& frame, const SeenSpace& seen,
                         const std::vector<DepthView>& views, const FuseSettings& settings);

/// How many detail voxels lie along the edge of one of the frame's. Throws Error where `fused` does
/// not fit the frame.
int detailPartsOf(const VoxelFrame& frame, const openvdb::GridBase& fused);

/// One closed level set: the boundary of the solid voxels, smoothed, where the views saw it that of
/// what was measured, and over two and a half voxels beyond the borders a slope between both. In
/// the grid of `fused`, half width kDetailBand. Parts smaller than .1 m along all axes of which
/// nothing was measured are left out; the grid's metadata `dropped_parts` is how many. Parallel;
/// the same values for any number of threads.
FloatGrid::Ptr closedSurface(const VoxelFrame& frame, const std::vector<Coord>& solid,
                             const FloatGrid& fused);

}  // namespace vdbc
