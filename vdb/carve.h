#pragma once
// Filled, seen empty, unobserved: the partition V = F + E + U (paper sec. 4, spec A1, A9).
#include <memory>
#include <vector>

#include "vdb/camera.h"
#include "vdb/progress.h"
#include "vdb/token_grid.h"

namespace vdbc {

/// The grid that everything is computed on: a box of voxels and its place in the world.
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

/// A camera and its planar depth, [height * width] row-major, metres; 0 (or less, or NaN) is no
/// ray.
struct DepthView {
  Camera camera;
  const float* depth = nullptr;
};

struct CarveSettings {
  float max_depth_m = 20.f;          // a measurement beyond this is no ray
  float flying_pixel_ratio = 0.05f;  // a pixel whose depth differs from both neighbours of a row or
                                     // column by more than this share of its depth, in opposite
                                     // directions, lies between two surfaces: no ray. 0 = keep all
};

/// Disjoint topologies of voxels; what is in neither is unobserved (U). Both clipped to the bounds.
struct ObservedSpace {
  TokenMask filled;  // F: a valid pixel's point lies in the voxel
  TokenMask empty;   // E: not F, and some ray passes it before its hit voxel; pruned to tiles
};

/// Depth with the pixels that carry no ray set to 0: not finite, <= 0, > max_depth_m, flying.
/// Returns [height * width].
std::vector<float> usableDepth(const DepthView& view, const CarveSettings& settings);

/// F and E exactly as if the ray of every usable pixel centre were traversed in double precision
/// with openvdb::math::DDA from the camera to the voxel of its point; F wins over E. Voxel-driven:
/// each candidate voxel is projected, a min/max depth pyramid decides most, the rest get exact
/// ray-box tests. Parallel; the result does not depend on the number of threads. Spec A1.
ObservedSpace carve(const VoxelFrame& frame, const std::vector<DepthView>& views,
                    const CarveSettings& settings, Progress& progress);

/// The same by traversing every ray (slow; the truth that carve() is tested and timed against).
ObservedSpace carveByTraversal(const VoxelFrame& frame, const std::vector<DepthView>& views,
                               const CarveSettings& settings);

enum class NodeState : uint8_t { kUnobserved = 0, kEmpty = 1, kFilled = 2 };

/// States pooled to a tree level: filled if any voxel is F, empty if all voxels inside the bounds
/// are E, else unobserved (spec A9). One entry per node of `level` that overlaps the bounds, in x,
/// y, z raster order (z fastest) of `box`.
struct NodeStates {
  int level = 1;
  CoordBBox box;  // in units of `level`, inclusive
  std::vector<NodeState> states;

  int64_t index(const Coord& ijk) const {
    const Coord d = box.dim(), o = ijk - box.min();
    return (int64_t(o.x()) * d.y() + o.y()) * d.z() + o.z();
  }
  NodeState at(const Coord& ijk) const {
    return box.isInside(ijk) ? states[size_t(index(ijk))] : NodeState::kUnobserved;
  }
};
NodeStates poolStates(const VoxelFrame& frame, const ObservedSpace& space, int level);

}  // namespace vdbc
