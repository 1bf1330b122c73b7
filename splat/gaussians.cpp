#include "splat/gaussians.h"

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

void moveOrigin(const Eigen::Vector3d& origin, Gaussians* g) {
  const Eigen::Vector3d shift = g->origin - origin;
  for (Eigen::Vector3f& mean : g->mean) mean = (mean.cast<double>() + shift).cast<float>();
  g->origin = origin;
}

void requireConsistent(const Gaussians& g) {
  require(g.sh_degree >= 0 && g.sh_degree <= 3, "Gaussians: expected an SH degree 0-3, found ",
          g.sh_degree);
  requireRows(g, "Gaussians");
}

}  // namespace vdbc
