// The curve of probabilities: what it is made of, and that it finds the truth.
#include "mar/calibration.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "vdb/error.h"

namespace vdbc {
namespace {

double sigmoid(double x) { return 1 / (1 + std::exp(-x)); }

TEST(Calibration, TheDefaultChangesNothing) {
  for (double l : {-8., -1., 0., .7, 1.5, 3., 9.})
    EXPECT_FLOAT_EQ(calibrated({}, l), float(sigmoid(l)));
  for (double p : {.01, .5, .93}) EXPECT_NEAR(sigmoid(logit(p)), p, 1e-12);
  EXPECT_TRUE(std::isfinite(logit(0)) && std::isfinite(logit(1)));
}

TEST(Calibration, TheCurveThatMadeTheOutcomesIsFound) {
  const auto truth = [](double l) {
    return sigmoid(-.8 + .45 * l - .3 * std::max(l - 1, 0.) + .9 * std::max(l - 2.5, 0.));
  };
  std::mt19937 random(1);
  std::uniform_real_distribution<double> chance(0, 1), any(-5, 5);
  std::vector<Outcome> outcomes;
  for (int i = 0; i < 40000; ++i) {
    const double l = any(random);
    outcomes.push_back({float(sigmoid(l)), chance(random) < truth(l)});
  }
  const Calibration curve = fitCalibration(outcomes);
  for (double l : {-4., -1., .5, 1.5, 2.2, 3., 4.5})
    EXPECT_NEAR(calibrated(curve, l), truth(l), .02) << l;
}

TEST(Calibration, TermsThatNeverVaryDoNothing) {
  std::vector<Outcome> outcomes;  // no probability exceeds .5
  for (int i = 0; i < 1000; ++i) outcomes.push_back({i % 2 ? .2f : .4f, i % 5 == 0});
  const Calibration curve = fitCalibration(outcomes);
  EXPECT_FLOAT_EQ(curve.slope_above_1, 0);
  EXPECT_FLOAT_EQ(curve.slope_above_2_5, 0);
  EXPECT_NEAR(calibrated(curve, logit(.2)), .2, 1e-3);
  EXPECT_NEAR(calibrated(curve, logit(.4)), .2, 1e-3);
}

TEST(Calibration, NothingIsFittedToOneKindOfOutcome) {
  EXPECT_THROW(fitCalibration({}), Error);
  EXPECT_THROW(fitCalibration({{.5f, true}}), Error);
}

}  // namespace
}  // namespace vdbc
