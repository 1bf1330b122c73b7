#pragma once
// Geometry cross-checked by Embree: an independent ray caster over meshes, voxels and ellipsoids.
#include <memory>
#include <vector>

#include "splat/gaussians.h"
#include "splat/view.h"
#include "vdb/carve.h"

struct RTCSceneTy;

namespace vdbc {

/// Indexed triangles, world frame, metres.
struct TriangleMesh {
  std::vector<Eigen::Vector3f> vertices;
  std::vector<Eigen::Vector3i> triangles;
};

/// Something rays can hit: triangles, the boxes of voxels, or the ellipsoids of Gaussians. Voxels
/// and ellipsoids are solid: a ray that starts inside one hits it at distance 0.
class RayTarget {
 public:
  static RayTarget fromMesh(const TriangleMesh& mesh);
  static RayTarget fromVoxels(const VoxelFrame& frame, const std::vector<Coord>& voxels);
  /// Ellipsoids at `sigmas` standard deviations of the Gaussians with opacity of at least
  /// min_opacity.
  static RayTarget fromGaussians(const Gaussians& gaussians, float sigmas = 1.5f,
                                 float min_opacity = 0.3f);
  RayTarget(RayTarget&&) noexcept;
  RayTarget& operator=(RayTarget&&) noexcept;
  ~RayTarget();

  /// Distances (metres along unit directions) to the first hits, infinity where there is none. [N]
  std::vector<float> trace(const std::vector<Eigen::Vector3f>& origins,
                           const std::vector<Eigen::Vector3f>& directions) const;

  /// The Embree scene (an RTCScene), for renderers that trace packets themselves. Of a mesh it is
  /// one triangle geometry in world coordinates, primitive i = triangle i; owned by this object.
  RTCSceneTy* embreeScene() const;

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
