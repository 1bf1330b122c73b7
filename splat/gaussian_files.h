#pragma once
// Private: what all files of Gaussians share.
#include <cstdint>
#include <vector>

#include "splat/gaussians.h"

namespace vdbc {

constexpr uint64_t kMaxGaussianBytes = uint64_t(1) << 38;  // of a file

/// What other programs call the opacity-compensated low pass, and its absence.
constexpr const char *kAntialiasedMode = "mip", *kDefaultMode = "default";
inline const char* renderMode(const Gaussians& g) {
  return g.antialias ? kAntialiasedMode : kDefaultMode;
}

/// Rows without NaN or infinity, ascending.
std::vector<int64_t> finiteRows(const Gaussians& gaussians);

/// Rows worth writing: finite, with a rotation.
std::vector<int64_t> writableRows(const Gaussians& gaussians);

/// `q` (w x y z) at length 1; what is normalised already stays bit for bit.
Eigen::Vector4f unitRotation(const Eigen::Vector4f& q);

}  // namespace vdbc
