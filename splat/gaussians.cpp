#include "splat/gaussians.h"

#include <algorithm>

#include "vdb/error.h"

namespace vdbc {

void Gaussians::resize(int64_t n, int degree) {
  require(n >= 0 && degree >= 0 && degree <= 3,
          "Gaussians::resize: expected a count >= 0 and an SH degree 0-3, found ", n, " and ",
          degree);
  sh_degree = degree;
  const size_t count = size_t(n);
  mean.resize(count, Eigen::Vector3f::Zero());
  log_scale.resize(count, Eigen::Vector3f::Zero());
  rotation.resize(count, Eigen::Vector4f(1.f, 0.f, 0.f, 0.f));
  opacity_logit.resize(count, 0.f);
  sh.resize(count * size_t(shCoefficients()) * 3, 0.f);
}

void requireConsistent(const Gaussians& g) {
  require(g.sh_degree >= 0 && g.sh_degree <= 3, "Gaussians: expected an SH degree 0-3, found ",
          g.sh_degree);
  const size_t n = g.mean.size();
  require(g.log_scale.size() == n, "Gaussians: expected ", n, " scales, found ",
          g.log_scale.size());
  require(g.rotation.size() == n, "Gaussians: expected ", n, " rotations, found ",
          g.rotation.size());
  require(g.opacity_logit.size() == n, "Gaussians: expected ", n, " opacities, found ",
          g.opacity_logit.size());
  const size_t values = n * size_t(g.shCoefficients()) * 3;
  require(g.sh.size() == values, "Gaussians: expected ", values, " SH values, found ", g.sh.size());
}

Gaussians selectGaussians(const Gaussians& from, const std::vector<int64_t>& rows) {
  Gaussians to;
  to.resize(int64_t(rows.size()), from.sh_degree);
  to.antialias = from.antialias;
  const size_t stride = size_t(from.shCoefficients()) * 3;
  for (size_t i = 0; i < rows.size(); ++i) {
    const size_t row = size_t(rows[i]);
    to.mean[i] = from.mean[row], to.log_scale[i] = from.log_scale[row];
    to.rotation[i] = from.rotation[row], to.opacity_logit[i] = from.opacity_logit[row];
    std::copy_n(&from.sh[row * stride], stride, &to.sh[i * stride]);
  }
  return to;
}

void append(Gaussians* gaussians, const Gaussians& more) {
  requireConsistent(*gaussians);
  requireConsistent(more);
  require(gaussians->sh_degree == more.sh_degree, "append: expected SH degree ",
          gaussians->sh_degree, ", found ", more.sh_degree);
  if (gaussians == &more) {
    append(gaussians, Gaussians(more));
    return;
  }
  const auto concatenate = [](auto* to, const auto& from) {
    to->insert(to->end(), from.begin(), from.end());
  };
  concatenate(&gaussians->mean, more.mean);
  concatenate(&gaussians->log_scale, more.log_scale);
  concatenate(&gaussians->rotation, more.rotation);
  concatenate(&gaussians->opacity_logit, more.opacity_logit);
  concatenate(&gaussians->sh, more.sh);
}

}  // namespace vdbc
