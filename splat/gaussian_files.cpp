#include "splat/gaussian_files.h"

#include <algorithm>
#include <cmath>

namespace vdbc {

std::vector<int64_t> finiteRows(const Gaussians& g) {
  const size_t values = size_t(g.shCoefficients()) * 3;
  std::vector<int64_t> rows;
  rows.reserve(size_t(g.size()));
  for (size_t i = 0; i < size_t(g.size()); ++i) {
    const float* sh = g.sh.data() + i * values;
    if (g.mean[i].allFinite() && g.log_scale[i].allFinite() && g.rotation[i].allFinite() &&
        std::isfinite(g.opacity_logit[i]) &&
        std::all_of(sh, sh + values, [](float v) { return std::isfinite(v); }))
      rows.push_back(int64_t(i));
  }
  return rows;
}

std::vector<int64_t> writableRows(const Gaussians& g) {
  std::vector<int64_t> rows = finiteRows(g);
  const auto isZero = [&](int64_t row) { return !(g.rotation[size_t(row)].stableNorm() > 1e-30f); };
  rows.erase(std::remove_if(rows.begin(), rows.end(), isZero), rows.end());
  return rows;
}

Eigen::Vector4f unitRotation(const Eigen::Vector4f& q) {
  return std::abs(q.squaredNorm() - 1.f) < 1e-6f ? q : q.stableNormalized();
}

}  // namespace vdbc
