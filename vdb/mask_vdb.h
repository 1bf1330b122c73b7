#pragma once
// Where in a scene something applies, as a .vdb of anybody's: region and lock masks.
#include <string>

#include "vdb/carve.h"

namespace vdbc {

/// Tokens of `level` in the frame's volume that hold the centre of a voxel which lies in the file's
/// mask, in world space: the active voxels of the grid `mask`, or else of the first grid that is
/// not points; of a level set its inside. Throws Error on files that are missing, corrupt, have no
/// such grid or miss the volume.
TokenMask readTokenMask(const std::string& path, const VoxelFrame& frame, int level);

}  // namespace vdbc
