#include "splat/metrics.h"

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <limits>

#include "vdb/error.h"

namespace vdbc {
namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

/// Values of 8 bits from a formula in whole numbers: the same on any machine.
Image pattern(int kind, int width = 96, int height = 64) {
  Image image(width, height, 3);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c) {
        int v = 0;
        if (kind == 0) v = (5 * x + 3 * y + 70 * c) / 3 % 256;                // ramps with edges
        if (kind == 1) v = (5 * x + 3 * y + 70 * c + 24) / 3 % 256;           // the same, moved
        if (kind == 2) v = (x / 8 + y / 8) % 2 ? 200 - 40 * c : 30 + 60 * c;  // checkers
        if (kind == 3) v = ((x * 7919 + y * 104729 + c * 1299709) % 1021) % 256;  // noise
        image.at(x, y, c) = float(v) / 255.f;
      }
  return image;
}

Image uniformImage(float r, float g, float b) {
  Image image(24, 24, 3);
  for (size_t i = 0; i < image.data.size(); ++i)
    image.data[i] = i % 3 == 0 ? r : i % 3 == 1 ? g : b;
  return image;
}

TEST(Flip, EqualsTheAuthorsProgram) {
  // Means by version 1.6 of the authors' program (sRGB turned linear before, as it wants it).
  const struct {
    int a, b;
    double at67, at30;
  } published[] = {{0, 1, .175077, .166657}, {0, 2, .679577, .727393}, {2, 3, .562249, .720127}};
  for (const auto& p : published) {
    EXPECT_NEAR(flip(pattern(p.a), pattern(p.b)), p.at67, 5e-5) << p.a << " " << p.b;
    EXPECT_NEAR(flip(pattern(p.a), pattern(p.b), 30), p.at30, 5e-5) << p.a << " " << p.b;
  }
}

// Uniform images have no features: what is left is the colour pipeline, here in double precision.
double flipOfUniform(const Eigen::Vector3d& srgb_a, const Eigen::Vector3d& srgb_b) {
  const auto lab = [](const Eigen::Vector3d& srgb) {
    Eigen::Matrix3d m;
    m << .4124564, .3575761, .1804375, .2126729, .7151522, .0721750, .0193339, .1191920, .9503041;
    Eigen::Vector3d linear, white = m * Eigen::Vector3d::Ones();
    for (int c = 0; c < 3; ++c)
      linear[c] = srgb[c] <= .04045 ? srgb[c] / 12.92 : std::pow((srgb[c] + .055) / 1.055, 2.4);
    const Eigen::Vector3d xyz = (m * linear).cwiseQuotient(white);
    double f[3];
    for (int c = 0; c < 3; ++c)
      f[c] = xyz[c] > std::pow(6. / 29, 3) ? std::cbrt(xyz[c]) : xyz[c] * 841 / 108 + 4. / 29;
    const double l = 116 * f[1] - 16;
    return Eigen::Vector3d(l, .01 * l * 500 * (f[0] - f[1]), .01 * l * 200 * (f[1] - f[2]));
  };
  const auto difference = [&](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
    const Eigen::Vector3d d = lab(a) - lab(b);
    return std::pow(std::abs(d[0]) + std::hypot(d[1], d[2]), .7);
  };
  const double e = difference(srgb_a, srgb_b) / difference({0, 1, 0}, {0, 0, 1});
  return e < .4 ? e / .4 * .95 : .95 + (e - .4) / .6 * .05;
}

TEST(Flip, UniformImagesHaveAClosedForm) {
  const Eigen::Vector3d colours[] = {
      {0, 0, 0}, {1, 1, 1}, {.5, .5, .5}, {.2, .7, .1}, {.9, .1, .4}};
  for (const auto& a : colours)
    for (const auto& b : colours) {
      const Image map = flipMap(uniformImage(float(a[0]), float(a[1]), float(a[2])),
                                uniformImage(float(b[0]), float(b[1]), float(b[2])));
      for (float v : map.data)
        ASSERT_NEAR(v, flipOfUniform(a, b), 1e-4) << a.transpose() << " / " << b.transpose();
    }
  EXPECT_NEAR(flip(uniformImage(0, 1, 0), uniformImage(0, 0, 1)), 1, 1e-5);  // the largest there is
}

TEST(Flip, IsSymmetricBoundedAndZeroForEqualImages) {
  for (int kind = 0; kind < 4; ++kind) {
    const Image a = pattern(kind), b = pattern((kind + 1) % 4);
    const Image map = flipMap(a, b);
    EXPECT_EQ(map.width, a.width);
    EXPECT_EQ(map.height, a.height);
    EXPECT_EQ(map.channels, 1);
    EXPECT_EQ(map.data, flipMap(b, a).data);
    EXPECT_GE(*std::min_element(map.data.begin(), map.data.end()), 0.f);
    EXPECT_LE(*std::max_element(map.data.begin(), map.data.end()), 1.f);
    EXPECT_EQ(flip(a, a), 0);
  }
}

TEST(Flip, GrowsWithTheDifferenceAndAppliesToAnySize) {
  const Image a = pattern(0);
  double before = 0;
  for (float step : {.01f, .05f, .2f}) {
    Image b = a;
    for (float& v : b.data) v = std::min(1.f, v + step);
    EXPECT_GT(flip(a, b), before);
    before = flip(a, b);
  }
  EXPECT_GT(flip(Image(1, 1, 3, 0.f), Image(1, 1, 3, 1.f)), .9);
  EXPECT_GT(flip(Image(300, 1, 3, 0.f), Image(300, 1, 3, 1.f)), .9);
}

TEST(Flip, ClampsAndTakesNoNan) {
  Image a = pattern(0), wild = a;
  wild.data[5] = -3, wild.data[6] = 7, wild.data[7] = kNan;
  Image tame = a;
  tame.data[5] = 0, tame.data[6] = 1, tame.data[7] = 0;
  EXPECT_EQ(flipMap(a, wild).data, flipMap(a, tame).data);
}

TEST(Flip, RefusesWhatItCannotCompare) {
  EXPECT_THROW(flip(Image(8, 8, 3), Image(8, 9, 3)), Error);
  EXPECT_THROW(flip(Image(8, 8, 1), Image(8, 8, 1)), Error);
  EXPECT_THROW(flip(Image(), Image()), Error);
  for (double ppd : {0., -1., std::numeric_limits<double>::quiet_NaN(), 1e9})
    EXPECT_THROW(flip(Image(8, 8, 3), Image(8, 8, 3), ppd), Error);
}

TEST(PictureErrorOf, AllPixelsGiveTheWholeImagesMetrics) {
  const Image a = pattern(0), b = pattern(1);
  const PictureError e = pictureError(a, b, std::vector<uint8_t>(96 * 64, 1));
  EXPECT_NEAR(e.psnr, psnr(a, b), 1e-9);
  EXPECT_NEAR(e.ssim, ssim(a, b), 1e-9);
  EXPECT_NEAR(e.flip, flip(a, b), 1e-9);
  EXPECT_EQ(e.pixels, 96 * 64);
}

TEST(PictureErrorOf, AStripeHasAClosedForm) {
  // Columns below 16 are wrong by a constant and count; the others, wrong in any way, do not.
  constexpr int kSide = 40, kEdge = 16;
  const double a = .2, b = .6;
  const Image reference(kSide, kSide, 3, float(a));
  Image test = pattern(3, kSide, kSide);
  std::vector<uint8_t> mask(kSide * kSide, 0);
  for (int y = 0; y < kSide; ++y)
    for (int x = 0; x < kEdge; ++x) {
      mask[size_t(y * kSide + x)] = 1;
      for (int c = 0; c < 3; ++c) test.at(x, y, c) = float(b);
    }
  const PictureError e = pictureError(reference, test, mask);
  EXPECT_EQ(e.pixels, kSide * kEdge);
  EXPECT_NEAR(e.psnr, -20 * std::log10(b - a), 1e-5);
  // Of a window, the share w is wrong: mean and variance of two values, covariance 0.
  double sum = 0, total = 0, expected = 0;
  for (int d = -5; d <= 5; ++d) total += std::exp(-d * d / 4.5);
  for (int x = 5; x < kEdge; ++x) {
    double w = 0;
    for (int d = -5; d <= 5; ++d)
      if (x + d < kEdge) w += std::exp(-d * d / 4.5) / total;
    const double mean = a + (b - a) * w, variance = (b - a) * (b - a) * w * (1 - w);
    expected += (2 * a * mean + 1e-4) * 9e-4 / ((a * a + mean * mean + 1e-4) * (variance + 9e-4));
    ++sum;
  }
  EXPECT_NEAR(e.ssim, expected / sum, 1e-4);
  // FLIP: as of the picture that is right elsewhere.
  Image right = reference;
  for (int y = 0; y < kSide; ++y)
    for (int x = 0; x < kEdge; ++x)
      for (int c = 0; c < 3; ++c) right.at(x, y, c) = float(b);
  const Image map = flipMap(reference, right);
  double flips = 0;
  for (size_t i = 0; i < mask.size(); ++i) flips += mask[i] ? double(map.data[i]) : 0;
  EXPECT_NEAR(e.flip, flips / (kSide * kEdge), 1e-9);
}

TEST(PictureErrorOf, RefusesWhatDoesNotFit) {
  const Image a = pattern(0);
  const PictureError none = pictureError(a, pattern(1), std::vector<uint8_t>(96 * 64, 0));
  for (double v : {none.psnr, none.ssim, none.flip}) EXPECT_TRUE(std::isnan(v));
  EXPECT_THROW(pictureError(a, a, std::vector<uint8_t>(96 * 63, 1)), Error);
  EXPECT_THROW(pictureError(a, pattern(0, 64, 96), std::vector<uint8_t>(96 * 64, 1)), Error);
  EXPECT_THROW(pictureError(Image(16, 16, 1), Image(16, 16, 1), std::vector<uint8_t>(256, 1)),
               Error);
}

TEST(DepthErrorOf, ComparesWhereBothAreMeasured) {
  const DepthError e = depthError({1, 2, 0, kNan, 5, 9}, {1.1f, 1.5f, 3, 4, 0, 6});
  EXPECT_NEAR(e.median_abs_m, .5, 1e-6);  // of .1, .5 and 3
  EXPECT_NEAR(e.rmse_m, std::sqrt((.01 + .25 + 9) / 3), 1e-6);
  EXPECT_DOUBLE_EQ(e.share, 3 / 5.);
  EXPECT_EQ(depthError({2, 3}, {2, 3}).rmse_m, 0);
  EXPECT_TRUE(std::isnan(depthError({0, 0}, {1, 1}).median_abs_m));
  EXPECT_EQ(depthError({0, 0}, {1, 1}).share, 0);
  EXPECT_TRUE(std::isnan(depthError({1, 1}, {0, kNan}).share));
  EXPECT_THROW(depthError({1}, {1, 2}), Error);
}

}  // namespace
}  // namespace vdbc
