#pragma once
// The grids that leave the program (docs/formats.md), one value a voxel.
#include <string>
#include <vector>

#include "vdb/carve.h"
#include "vdb/columns.h"
#include "vdb/grid_instances.h"

namespace vdbc {

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
  /// What the views measured, in detail voxels (fuseDepth()); null where that is not known.
  FloatGrid::ConstPtr seen_distance;

  int64_t size() const { return int64_t(ijk.size()); }

  template <typename Self>
  static auto columns(Self& v) {
    return std::make_tuple(column("ijk", v.ijk), column("density", v.density),
                           column("Cd", v.colour_linear), column("observed", v.observed),
                           column("probability", v.probability), column("bfs_level", v.bfs_level));
  }
};

/// What a finished scene is in detail voxels (splat/detail_grids.h); all there, or none.
struct DetailGrids {
  FloatGrid::Ptr surface, density;
  Vec3SGrid::Ptr colour;
};

/// The voxels that `surface` goes round: generated ones that stand where views saw nothing are made
/// up and wrong.
std::vector<Coord> solidVoxels(const SceneVoxels& voxels);

/// Writes standard 5-4-3 grids: surface (level set), density (fog), Cd (vec3s), observed, generated
/// (bool), probability, bfs_level (float), seen_empty (bool); world transform with the grid's
/// rotation; metadata as docs/formats.md says. Voxel ijk's centre is at ijk + 0.5 in frame units:
/// the file's transform has the half-voxel shift so that grid index space is cell-centred.
/// `surface` is the exact distance to the boundary of solidVoxels(); it, `density` and `Cd` are
/// those of `detail` where given. A checksum follows what OpenVDB reads. Written to a temporary
/// name and renamed. Throws Error for voxels outside the bounds, twice the same, or with values
/// that are not finite, and where the file cannot be written.
void writeSceneVdb(const SceneVoxels& voxels, const std::string& path,
                   const DetailGrids& detail = {});

/// Several completions of one place, each as its voxels: float grids `occupancy_mean` and
/// `occupancy_variance` (the share of them that fill a voxel, m, and m (1 - m)), cell-centred as
/// above. Throws Error where the file cannot be written.
void writeOccupancyVdb(const VoxelFrame& frame, const std::vector<std::vector<Coord>>& completions,
                       const std::string& path);

/// Reads back what writeSceneVdb wrote (all but `surface`, which is derived), voxels in the order
/// of the file's tree; density and colour in detail voxels as their mean over each voxel (none: 1,
/// black). Also when another program wrote the file again. Throws Error on files that
/// are missing, corrupt, lack the grids or say what cannot be.
SceneVoxels readSceneVdb(const std::string& path);

}  // namespace vdbc
