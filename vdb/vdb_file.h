#pragma once
// .vdb files as this project writes them, and the parts that several kinds of them share: a
// checksum behind the grids, the volume's frame, sets of voxels.
#include <openvdb/Grid.h>
#include <openvdb/Metadata.h>

#include <string>

#include "vdb/error.h"
#include "vdb/frame.h"
#include "vdb/grid_instances.h"
#include "vdb/token_grid.h"

namespace vdbc {

/// Writes grids and metadata and the checksum of file_io.h: temporary name, then rename.
/// `operation` opens the message of every Error here.
void writeVdb(const char* operation, const std::string& path, const openvdb::GridCPtrVec& grids,
              const openvdb::MetaMap& metadata);

struct VdbFile {
  openvdb::GridPtrVec grids;
  openvdb::MetaMap metadata;
};
/// All grids and the metadata. Throws Error on files that are missing, larger than `max_bytes`, cut
/// off, of another kind or do not match their checksum (one that other programs wrote again has
/// none).
VdbFile readVdb(const char* operation, const std::string& path, uint64_t max_bytes);

/// The grid of that name. Throws Error if it is not there or of another type.
template <typename GridType>
typename GridType::Ptr findGrid(const char* operation, const openvdb::GridPtrVec& grids,
                                const char* name, const std::string& path) {
  for (const auto& grid : grids)
    if (grid && grid->getName() == name) {
      require(grid->isType<GridType>(), operation, ": ", path, ": expected grid '", name,
              "' of type ", GridType::gridType(), ", found ", grid->type());
      return openvdb::gridPtrCast<GridType>(grid);
    }
  throw Error(joinText(operation, ": ", path, ": no grid '", name, "'"));
}

/// The value of that name and type. Throws Error if it is not there.
template <typename Value>
Value findMetadata(const char* operation, const openvdb::MetaMap& metadata, const char* name,
                   const std::string& path) {
  using Meta = openvdb::TypedMetadata<Value>;
  const auto found = metadata.getMetadata<Meta>(name);
  require(bool(found), operation, ": ", path, ": no metadata '", name, "' of type ",
          Meta::staticTypeName());
  return found->value();
}

/// The frame as files have it, for grids of the nodes of `level` (0: voxels): row vectors, node
/// centres at whole indices.
openvdb::math::Transform::Ptr fileTransform(const VoxelFrame& frame, int level = 0);

/// Adds `voxel_m`, `volume_min`, `volume_max` (voxels, inclusive).
void insertVolume(const VoxelFrame& frame, openvdb::MetaMap* metadata);
/// The frame from insertVolume()'s metadata and a grid's transform as fileTransform(frame, level)
/// makes it. Throws Error unless that is a rotation, translation and the voxels' size.
VoxelFrame readVolume(const char* operation, const openvdb::MetaMap& metadata,
                      const openvdb::math::Transform& transform, int level,
                      const std::string& path);

/// Voxels as a standard 5-4-3 grid, active and true.
BoolGrid::Ptr gridOfMask(const TokenMask& mask);
/// Its active voxels. Throws Error if one lies outside `bounds`.
TokenMask maskOfGrid(const char* operation, const BoolGrid& grid, const CoordBBox& bounds,
                     const std::string& path);

}  // namespace vdbc
