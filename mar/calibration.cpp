#include "mar/calibration.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Matrix4d;
using Eigen::Vector4d;

// What the curve weighs.
Vector4d termsOf(double l) { return {1, l, std::max(l - 1, 0.), std::max(l - 2.5, 0.)}; }

double sigmoid(double x) { return 1 / (1 + std::exp(-x)); }

}  // namespace

double logit(double probability) {
  const double p = std::clamp(probability, 1e-4, 1 - 1e-4);
  return std::log(p / (1 - p));
}

float calibrated(const Calibration& c, double l) {
  const Vector4d weights(c.bias, c.slope, c.slope_above_1, c.slope_above_2_5);
  return float(sigmoid(weights.dot(termsOf(l))));
}

Calibration fitCalibration(const std::vector<Outcome>& outcomes) {
  const auto occupied =
      std::count_if(outcomes.begin(), outcomes.end(), [](const Outcome& o) { return o.occupied; });
  require(occupied > 0 && occupied < int64_t(outcomes.size()),
          "fitCalibration: expected tokens that are occupied and tokens that are not, found ",
          occupied, " of ", outcomes.size(), " occupied");
  constexpr double kRidge = 1e-3;  // for terms that never vary
  Vector4d w = Vector4d::Zero();
  for (int step = 0; step < 50; ++step) {
    Matrix4d hessian = kRidge * Matrix4d::Identity();
    Vector4d gradient = kRidge * w;
    for (const Outcome& o : outcomes) {
      const Vector4d terms = termsOf(logit(o.probability));
      const double p = sigmoid(w.dot(terms));
      gradient += (p - o.occupied) * terms;
      hessian += p * (1 - p) * terms * terms.transpose();
    }
    const Vector4d change = hessian.ldlt().solve(gradient);
    w -= change;
    if (change.norm() < 1e-9) break;
  }
  return {float(w[0]), float(w[1]), float(w[2]), float(w[3])};
}

}  // namespace vdbc
