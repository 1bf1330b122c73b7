#pragma once
// Differentiable splatting of 3-D Gaussians on the CPU (Kerbl et al. 2023; EWA: Zwicker et al.
// 2002).
#include <memory>

#include "splat/gaussians.h"
#include "splat/image.h"
#include "vdb/camera.h"

namespace vdbc {

struct RasterSettings {
  Eigen::Vector3f background = Eigen::Vector3f::Zero();  // display sRGB
  float near_m = 0.05f;         // Gaussians whose centre is nearer are culled
  float low_pass = 0.3f;        // pixel variance added to the 2-D covariance, as in 3DGS
  float min_alpha = 1.f / 255;  // contributions below are skipped
  float max_alpha = 0.99f;
  /// Opacity times sqrt(det cov / det (cov + low_pass I)), cov the 2-D covariance: what the
  /// low-pass widens it also dims, so that thin and far Gaussians keep their weight (Yu et al.
  /// 2024, Mip-Splatting, sec. 4.2).
  bool antialias = false;
  bool median_depth = false;  // fill RasterOutput::median_depth
  int vector_bits = 0;  // 0: the widest registers of this CPU; 128, 256 or 512 to compare them
};

/// More values per Gaussian, blended like colour but over nothing.
struct ExtraChannels {
  int count = 0;
  const float* values = nullptr;  // [N, count]
};

struct RasterOutput {
  Image colour;  // [H, W, 3] display sRGB over the background
  Image alpha;   // [H, W, 1]
  Image depth;   // [H, W, 1] expected planar depth, sum w z / sum w; 0 where alpha is 0
  /// [H, W, 1] planar depth of the Gaussian at which transmittance falls to 0.5 or below; 0 where
  /// it never does. Empty unless asked for.
  Image median_depth;
  Image channels;  // [H, W, C] sum w value of the extra channels; empty without any
};

/// What the backward pass needs from the forward pass; opaque.
struct RasterState;
struct RasterStateDeleter {
  void operator()(RasterState*) const;
};
using RasterStatePtr = std::unique_ptr<RasterState, RasterStateDeleter>;

/// Renders. With `saved`, keeps what rasterizeBackward needs. Tiles of 16 x 16 pixels, front to
/// back, parallel over tiles; the same bytes for any number of threads. Degenerate Gaussians (NaN,
/// zero quaternion, behind the camera) contribute nothing.
RasterOutput rasterize(const Gaussians& gaussians, const Camera& camera,
                       const RasterSettings& settings, RasterStatePtr* saved = nullptr,
                       const ExtraChannels& extra = {});

/// What a forward call had to do, for benchmarks.
struct RasterWork {
  int64_t visible = 0;    // Gaussians that may touch the image
  int64_t instances = 0;  // the same times the 16 x 16 tiles each is listed in
  int64_t blocks = 0;     // the same times the 4 x 4 blocks of each tile that look at it
  int64_t pairs = 0;  // pixels and Gaussians that count: alpha >= min_alpha, pixel not opaque yet
};
RasterWork workOf(const RasterState& state);

/// Derivatives of a scalar loss by the arrays of Gaussians, same layout.
struct GaussianGradients {
  std::vector<Eigen::Vector3f> mean, log_scale;
  std::vector<Eigen::Vector4f> rotation;
  std::vector<float> opacity_logit, sh;
  std::vector<float> extra;  // [N, C]; empty without extra channels
  /// By the pose: rotation (radians), then translation (metres), both in camera axes; the
  /// derivative at xi = 0 of the loss seen from world_from_camera * exp(xi). Zero unless asked for.
  Eigen::Matrix<double, 6, 1> camera = Eigen::Matrix<double, 6, 1>::Zero();
};

/// What rasterizeBackward takes and gives beyond colour, alpha and depth.
struct BackwardExtras {
  ExtraChannels extra;                    // those of the forward call
  const Image* d_channels = nullptr;      // [H, W, C] by RasterOutput::channels; null is 0
  const Image* d_median_depth = nullptr;  // [H, W, 1]; moves the depth of the median Gaussian alone
  bool camera = false;                    // fill GaussianGradients::camera
};

/// d_colour: [H, W, 3] derivative of the loss by RasterOutput::colour; d_alpha and d_depth ([H, W,
/// 1]) may be null. `gaussians` and `camera` are those of the forward call.
GaussianGradients rasterizeBackward(const Gaussians& gaussians, const Camera& camera,
                                    const RasterState& saved, const Image& d_colour,
                                    const Image* d_alpha = nullptr, const Image* d_depth = nullptr,
                                    const BackwardExtras& extras = {});

}  // namespace vdbc
