#pragma once
// Differentiable splatting of 3-D Gaussians on the CPU (Kerbl et al. 2023; EWA: Zwicker et al. 2002).
#include <memory>

#include "splat/gaussians.h"
#include "splat/image.h"
#include "vdb/camera.h"

namespace vdbc {

struct RasterSettings {
  Eigen::Vector3f background = Eigen::Vector3f::Zero();  // display sRGB
  float near_m = 0.05f;       // Gaussians whose centre is nearer are culled
  float low_pass = 0.3f;      // pixel variance added to the 2-D covariance, as in 3DGS
  float min_alpha = 1.f / 255;  // contributions below are skipped
  float max_alpha = 0.99f;
};

struct RasterOutput {
  Image colour;  // [H, W, 3] display sRGB over the background
  Image alpha;   // [H, W, 1]
  Image depth;   // [H, W, 1] expected planar depth, sum w z / sum w; 0 where alpha is 0
};

/// What the backward pass needs from the forward pass; opaque.
struct RasterState;
struct RasterStateDeleter {
  void operator()(RasterState*) const;
};
using RasterStatePtr = std::unique_ptr<RasterState, RasterStateDeleter>;

/// Renders. With `saved`, keeps what rasterizeBackward needs. Tiles of 16 x 16 pixels, front to back,
/// parallel over tiles; the same bytes for any number of threads. Degenerate Gaussians (NaN, zero
/// quaternion, behind the camera) contribute nothing.
RasterOutput rasterize(const Gaussians& gaussians, const Camera& camera,
                       const RasterSettings& settings, RasterStatePtr* saved = nullptr);

/// Derivatives of a scalar loss by the arrays of Gaussians, same layout.
struct GaussianGradients {
  std::vector<Eigen::Vector3f> mean, log_scale;
  std::vector<Eigen::Vector4f> rotation;
  std::vector<float> opacity_logit, sh;
};

/// d_colour: [H, W, 3] derivative of the loss by RasterOutput::colour; d_alpha and d_depth ([H, W, 1])
/// may be null. `gaussians` and `camera` are those of the forward call.
GaussianGradients rasterizeBackward(const Gaussians& gaussians, const Camera& camera,
                                    const RasterState& saved, const Image& d_colour,
                                    const Image* d_alpha = nullptr, const Image* d_depth = nullptr);

}  // namespace vdbc
