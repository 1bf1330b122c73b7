#pragma once
// From depth to what was seen: the exact partition of a volume into F, E and U (paper sec. 4).
#include <vector>

#include "vdb/camera.h"
#include "vdb/progress.h"
#include "vdb/seen.h"

namespace vdbc {

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

/// Depth with the pixels that carry no ray set to 0: not finite, <= 0, > max_depth_m, flying.
/// Returns [height * width].
std::vector<float> usableDepth(const DepthView& view, const CarveSettings& settings);

/// F and E exactly as if the ray of every usable pixel centre were traversed in double precision
/// with openvdb::math::DDA from the camera to the voxel of its point; F wins over E. Voxel-driven:
/// each candidate voxel is projected, a min/max depth pyramid decides most, the rest get exact
/// ray-box tests. Parallel; the result does not depend on the number of threads. See
/// docs/method.md, section 2.4.
SeenSpace carve(const VoxelFrame& frame, const std::vector<DepthView>& views,
                const CarveSettings& settings, Progress& progress);

/// The same by traversing every ray (slow; the truth that carve() is tested and timed against).
SeenSpace carveByTraversal(const VoxelFrame& frame, const std::vector<DepthView>& views,
                           const CarveSettings& settings);

}  // namespace vdbc
