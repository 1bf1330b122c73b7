#include "vdb/mask_vdb.h"

#include <openvdb/openvdb.h>
#include <openvdb/tools/LevelSetUtil.h>
#include <tbb/parallel_for.h>

#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

constexpr const char* kReadMask = "readTokenMask";
constexpr const char* kMask = "mask";

template <typename GridType>
bool copyTopology(const openvdb::GridBase& grid, MaskTree* mask) {
  if (!grid.isType<GridType>()) return false;
  mask->topologyUnion(static_cast<const GridType&>(grid).tree());
  return true;
}

/// False for grids that cannot be masks.
bool activeVoxels(const openvdb::GridBase& grid, MaskTree* mask) {
  if (grid.getGridClass() == openvdb::GRID_LEVEL_SET && grid.isType<FloatGrid>()) {
    const auto inside = openvdb::tools::sdfInteriorMask(static_cast<const FloatGrid&>(grid));
    return copyTopology<BoolGrid>(*inside, mask);
  }
  return copyTopology<BoolGrid>(grid, mask) || copyTopology<FloatGrid>(grid, mask) ||
         copyTopology<MaskGrid>(grid, mask) || copyTopology<Vec3SGrid>(grid, mask);
}

}  // namespace

TokenMask readTokenMask(const std::string& path, const VoxelFrame& frame, int level) {
  constexpr uint64_t kMaxBytes = uint64_t(1) << 32;
  const VdbFile file = readVdb(kReadMask, path, kMaxBytes);
  MaskTree mask;
  openvdb::math::Transform::Ptr transform;
  for (const bool named : {true, false})
    for (const auto& grid : file.grids)
      if (!transform && grid && (!named || grid->getName() == kMask) && activeVoxels(*grid, &mask))
        transform = grid->transformPtr();
  require(bool(transform), kReadMask, ": ", path,
          ": expected a grid of type bool, mask, float or vec3s, found none");

  const CoordBBox nodes = nodesIn(frame.bounds, level);
  std::vector<std::vector<Coord>> rows(size_t(nodes.dim().x()));
  tbb::parallel_for(size_t(0), rows.size(), [&](size_t x) {
    const openvdb::tree::ValueAccessor<const MaskTree, false> cells(mask);
    auto inside = [&](const Coord& voxel) {
      const Eigen::Vector3d p =
          frame.toWorld(Eigen::Vector3d(voxel.x(), voxel.y(), voxel.z()).array() + .5);
      return cells.isValueOn(
          transform->worldToIndexCellCentered(openvdb::Vec3d(p.x(), p.y(), p.z())));
    };
    for (int y = nodes.min().y(); y <= nodes.max().y(); ++y)
      for (int z = nodes.min().z(); z <= nodes.max().z(); ++z) {
        const Coord node(nodes.min().x() + int(x), y, z);
        for (auto voxel = voxelsIn(node, level).begin(); voxel; ++voxel)
          if (inside(*voxel)) {
            rows[x].push_back(node);
            break;
          }
      }
  });
  TokenMask tokens;
  openvdb::tree::ValueAccessor<TokenMask> set(tokens);
  for (const auto& row : rows)
    for (const Coord& node : row) set.setValueOn(node);
  require(!tokens.empty(), kReadMask, ": ", path,
          ": holds no voxel of the place (expected the cameras' frame, metres)");
  return tokens;
}

}  // namespace vdbc
