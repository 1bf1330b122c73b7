#pragma once
// Rays against meshes and voxels, by Embree: where they end, and what they tell of a
// reconstruction.
#include <memory>
#include <vector>

#include "splat/view.h"
#include "vdb/carve.h"

namespace vdbc {

/// Indexed triangles, world frame, metres.
struct TriangleMesh {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Eigen::Vector3i> triangles;
};

/// Something rays can hit: triangles, or the boxes of voxels. Boxes are solid: a ray that starts
/// inside one hits it at distance 0.
class RayTarget {
 public:
  /// Both sides of every triangle. Throws Error where one names a vertex that is not there.
  static RayTarget fromMesh(const TriangleMesh& mesh);
  /// Voxel ijk of `frame` is the box [ijk, ijk + 1) x voxel_m.
  static RayTarget fromVoxels(const VoxelFrame& frame, const std::vector<Coord>& voxels);
  RayTarget(RayTarget&&) noexcept;
  RayTarget& operator=(RayTarget&&) noexcept;
  ~RayTarget();

  /// Distances (metres along unit directions) to the first hits, infinity where there is none. [N]
  std::vector<float> trace(const std::vector<Eigen::Vector3f>& origins,
                           const std::vector<Eigen::Vector3f>& directions) const;

 private:
  struct Impl;
  explicit RayTarget(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

/// Agreement of traced depth with the views' own depth.
struct DepthAgreement {
  int64_t rays = 0;           // valid pixels compared
  double median_error_m = 0;  // |traced - given| along z, over pixels that hit
  double within_share = 0;    // share of rays that hit within tolerance
  double miss_share = 0;      // share of rays that hit nothing
};
DepthAgreement depthAgreement(const RayTarget& target, const std::vector<View>& views,
                              float tolerance_m);

/// Share of rays from `origins` (uniform directions, fixed seed) that meet the true surface at t
/// but `output` not before t + tolerance_m. NaN where no ray meets the true surface.
double leakRate(const RayTarget& truth, const RayTarget& output,
                const std::vector<Eigen::Vector3f>& origins, int rays, float tolerance_m,
                uint64_t seed);

/// Share of rays from `origins` that hit nothing in `output`: the open directions of a place that
/// is known to be closed, where no truth exists.
double openShare(const RayTarget& output, const std::vector<Eigen::Vector3f>& origins, int rays,
                 uint64_t seed);

}  // namespace vdbc
