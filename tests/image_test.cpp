#include "splat/image.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "tests/view_files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

Image randomImage(int w, int h, int c, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> value(0.f, 1.f);
  Image image(w, h, c);
  for (float& v : image.data) v = value(random);
  return image;
}

/// The definition: at each window position, weighted moments with the 2-D window, in double.
double bruteForceSsim(const Image& a, const Image& b) {
  double window[11][11], sum = 0;
  for (int j = 0; j < 11; ++j)
    for (int i = 0; i < 11; ++i)
      sum += window[j][i] = std::exp(-((i - 5) * (i - 5) + (j - 5) * (j - 5)) / (2 * 1.5 * 1.5));
  const double c1 = 1e-4, c2 = 9e-4;
  double total = 0;
  int64_t count = 0;
  for (int c = 0; c < a.channels; ++c)
    for (int y = 0; y + 11 <= a.height; ++y)
      for (int x = 0; x + 11 <= a.width; ++x) {
        double ma = 0, mb = 0, va = 0, vb = 0, cov = 0;
        for (int j = 0; j < 11; ++j)
          for (int i = 0; i < 11; ++i) {
            ma += window[j][i] / sum * a.at(x + i, y + j, c);
            mb += window[j][i] / sum * b.at(x + i, y + j, c);
          }
        for (int j = 0; j < 11; ++j)
          for (int i = 0; i < 11; ++i) {
            const double da = a.at(x + i, y + j, c) - ma, db = b.at(x + i, y + j, c) - mb;
            va += window[j][i] / sum * da * da;
            vb += window[j][i] / sum * db * db;
            cov += window[j][i] / sum * da * db;
          }
        total += (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
        ++count;
      }
  return total / double(count);
}

TEST(Srgb, MatchesTheStandardAndInverts) {
  EXPECT_NEAR(srgbFromLinear(0.18f), 0.46135612950044164, 1e-6);  // 1.055 * .18^(1/2.4) - .055
  EXPECT_NEAR(srgbFromLinear(1.f), 1.0, 1e-6);
  EXPECT_NEAR(linearFromSrgb(0.04045f), 0.04045 / 12.92, 1e-8);
  for (float v = -0.5f; v <= 1.5f; v += 0.01f) {
    EXPECT_NEAR(linearFromSrgb(srgbFromLinear(v)), v, 2e-6) << v;
  }
}

TEST(Resize, SameSizeIsIdentity) {
  const Image image = randomImage(17, 9, 3, 1);
  EXPECT_EQ(resizeImage(image, 17, 9).data, image.data);
}

TEST(Resize, ShrinkingKeepsTheMeanAndEqualsBlockMeans) {
  const Image image = randomImage(24, 18, 3, 2);
  const Image half = resizeImage(image, 8, 6);  // blocks of 3 x 3
  for (int y = 0; y < 6; ++y)
    for (int x = 0; x < 8; ++x)
      for (int c = 0; c < 3; ++c) {
        double mean = 0;
        for (int j = 0; j < 3; ++j)
          for (int i = 0; i < 3; ++i) mean += image.at(3 * x + i, 3 * y + j, c) / 9.0;
        EXPECT_NEAR(half.at(x, y, c), mean, 1e-6);
      }
  const auto meanOf = [](const Image& im) {
    double sum = 0;
    for (float v : im.data) sum += v;
    return sum / double(im.data.size());
  };
  EXPECT_NEAR(meanOf(resizeImage(image, 7, 5)), meanOf(image), 1e-6);  // fractions of pixels too
}

TEST(Resize, GrowingIsExactOnLinearRampsInside) {
  Image ramp(8, 8, 1);
  for (int y = 0; y < 8; ++y)
    for (int x = 0; x < 8; ++x) ramp.at(x, y, 0) = 0.1f * float(x) + 0.02f * float(y);
  const Image big = resizeImage(ramp, 20, 12);
  for (int y = 1; y < 11; ++y)
    for (int x = 2; x < 18; ++x) {
      const double sx = (x + 0.5) * 8 / 20 - 0.5, sy = (y + 0.5) * 8 / 12 - 0.5;
      EXPECT_NEAR(big.at(x, y, 0), 0.1 * sx + 0.02 * sy, 1e-6);
    }
}

TEST(Tiles, StandInRowsInTheirCells) {
  const Image sheet = tileImages({Image(2, 3, 3, .5f), Image(), Image(4, 1, 3, .75f)}, 2);
  ASSERT_EQ(sheet.width, 8);
  ASSERT_EQ(sheet.height, 6);
  for (int y = 0; y < 6; ++y)
    for (int x = 0; x < 8; ++x)
      for (int c = 0; c < 3; ++c) {
        const bool first = x < 2 && y < 3, third = x < 4 && y == 3;
        EXPECT_EQ(sheet.at(x, y, c), first ? .5f : third ? .75f : .15f) << x << ", " << y;
      }
  EXPECT_EQ(tileImages({Image(5, 4, 3)}, 8).width, 5);
  EXPECT_THROW(tileImages({}, 8), Error);
  EXPECT_THROW(tileImages({Image()}, 8), Error);
  EXPECT_THROW(tileImages({Image(5, 4, 1)}, 8), Error);
}

TEST(Psnr, ClosedForms) {
  Image a(13, 7, 3, 0.25f), b(13, 7, 3, 0.75f);
  EXPECT_NEAR(psnr(a, b), 20 * std::log10(2.0), 1e-9);  // mse 1/4
  EXPECT_EQ(psnr(a, a), std::numeric_limits<double>::infinity());
  Image c = a;
  c.data[5] += 0.5f;  // one value of 273
  EXPECT_NEAR(psnr(a, c), 10 * std::log10(273 * 4.0), 1e-9);
}

TEST(Metrics, RefuseImagesOfDifferentSizes) {
  EXPECT_THROW(psnr(Image(12, 12, 3), Image(12, 13, 3)), Error);
  EXPECT_THROW(ssim(Image(12, 12, 3), Image(12, 12, 1)), Error);
  EXPECT_THROW(ssim(Image(10, 12, 3), Image(10, 12, 3)), Error);  // no window fits
}

TEST(Ssim, EqualsBruteForce) {
  for (int channels : {1, 3}) {
    const Image a = randomImage(29, 17, channels, 11), b = randomImage(29, 17, channels, 12);
    const Image smooth = smoothImage(29, 17, channels);
    Image noisy = smooth;
    for (size_t i = 0; i < noisy.data.size(); ++i) noisy.data[i] += 0.02f * (a.data[i] - 0.5f);
    EXPECT_NEAR(ssim(a, b), bruteForceSsim(a, b), 1e-5);
    EXPECT_NEAR(ssim(smooth, noisy), bruteForceSsim(smooth, noisy), 1e-5);
    EXPECT_NEAR(ssim(smooth, b), bruteForceSsim(smooth, b), 1e-5);
  }
}

TEST(Ssim, ClosedFormsAndSymmetry) {
  const Image a = randomImage(40, 30, 3, 5), b = randomImage(40, 30, 3, 6);
  EXPECT_NEAR(ssim(a, a), 1.0, 1e-6);
  EXPECT_NEAR(ssim(a, b), ssim(b, a), 1e-7);
  // Constant images: only the luminance term is left.
  const double expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2 * 0.2 + 0.6 * 0.6 + 1e-4);
  EXPECT_NEAR(ssim(Image(16, 16, 1, 0.2f), Image(16, 16, 1, 0.6f)), expected, 1e-4);
}

}  // namespace
}  // namespace vdbc
