#pragma once
// Probabilities that mean what they say (docs/method.md, section 4.9).
#include <vector>

namespace vdbc {

/// A curve over l, the logit of what the occupancy head says: the logit becomes bias + slope * l +
/// slope_above_1 * max(l - 1, 0) + slope_above_2_5 * max(l - 2.5, 0). The default changes nothing.
struct Calibration {
  float bias = 0, slope = 1, slope_above_1 = 0, slope_above_2_5 = 0;

  template <typename Config, typename Visit>
  static void fields(Config& c, Visit&& visit) {
    visit("calibration_bias", c.bias), visit("calibration_slope", c.slope);
    visit("calibration_slope_above_1", c.slope_above_1);
    visit("calibration_slope_above_2_5", c.slope_above_2_5);
  }
};

/// Of a probability; 0 and 1, which have none, count as a ten-thousandth from there.
double logit(double probability);
/// The curve's probability.
float calibrated(const Calibration& curve, double logit);

/// What became of a token that was asked about.
struct Outcome {
  float probability = 0;  // before any curve
  bool occupied = false;
};
/// The likeliest curve (logistic regression by Newton's method). Throws Error without outcomes of
/// both kinds.
Calibration fitCalibration(const std::vector<Outcome>& outcomes);

}  // namespace vdbc
