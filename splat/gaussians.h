#pragma once
// 3-D Gaussians as plain arrays, in the encodings of the 3DGS file format.
#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "vdb/columns.h"

namespace vdbc {

constexpr float kSh0 = 0.28209479177387814f;  // colour (display sRGB) = 0.5 + kSh0 * sh[0]

/// N anisotropic Gaussians; arrays are parallel. Axes and units of the input's world, metres.
struct Gaussians {
  /// Place in the world that means are measured from: single precision reaches a few kilometres,
  /// and survey coordinates lie hundreds from their world's origin.
  Eigen::Vector3d origin = Eigen::Vector3d::Zero();
  int sh_degree = 0;                       // 0..3
  std::vector<Eigen::Vector3f> mean;       // [N] metres from `origin`
  std::vector<Eigen::Vector3f> log_scale;  // [N] natural log of sigma, metres
  std::vector<Eigen::Vector4f> rotation;   // [N] quaternion w x y z; need not be normalised
  std::vector<float> opacity_logit;        // [N]
  std::vector<float> sh;                   // [N, (sh_degree+1)^2, 3] coefficient-major, RGB fastest
  bool antialias = false;                  // made for RasterSettings::antialias; kept by files

  int64_t size() const { return int64_t(mean.size()); }
  int shCoefficients() const { return (sh_degree + 1) * (sh_degree + 1); }
  void resize(int64_t n, int degree);

  template <typename Self>
  static auto columns(Self& g) {
    return std::make_tuple(column("mean", g.mean), column("log_scale", g.log_scale),
                           column("rotation", g.rotation), column("opacity_logit", g.opacity_logit),
                           column("sh", g.sh, size_t(g.shCoefficients()) * 3));
  }
};

/// Where a Gaussian is in the world, as near as single precision gets.
inline Eigen::Vector3f worldMean(const Gaussians& g, size_t row) {
  return (g.origin + g.mean[row].cast<double>()).cast<float>();
}

/// Means from another origin, at the same places.
void moveOrigin(const Eigen::Vector3d& origin, Gaussians* gaussians);

/// Throws Error unless all arrays have matching lengths and the SH degree is 0-3.
void requireConsistent(const Gaussians& gaussians);

}  // namespace vdbc
