#include "splat/image.h"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "vdb/error.h"

namespace vdbc {
namespace {

void requireSameSize(const char* operation, const Image& a, const Image& b) {
  requireImage(operation, a);
  requireImage(operation, b);
  require(a.width == b.width && a.height == b.height && a.channels == b.channels, operation,
          ": images differ in size: ", a.width, " x ", a.height, " x ", a.channels, " and ",
          b.width, " x ", b.height, " x ", b.channels);
}

/// Weights of the source samples [first, first + weights.size()) of one target sample.
struct Taps {
  int first = 0;
  std::vector<float> weights;
};

std::vector<Taps> resizeTaps(int from, int to) {
  std::vector<Taps> taps(static_cast<size_t>(to));
  const double scale = double(from) / to;  // source samples per target sample
  for (int i = 0; i < to; ++i) {
    Taps& t = taps[size_t(i)];
    if (scale > 1) {  // overlap of the target's interval with each source sample
      const double begin = i * scale, end = std::min((i + 1) * scale, double(from));
      t.first = std::min(int(begin), from - 1);
      for (int s = t.first; s < from && s < end; ++s) {
        const double overlap = std::min(end, s + 1.0) - std::max(begin, double(s));
        t.weights.push_back(float(overlap / (end - begin)));
      }
    } else {  // between the two nearest sample centres; the border value continues outside
      const double centre = std::clamp((i + 0.5) * scale - 0.5, 0.0, double(from - 1));
      t.first = int(centre);
      const float second = float(centre - t.first);
      t.weights.push_back(1 - second);
      if (second > 0) t.weights.push_back(second);
    }
  }
  return taps;
}

constexpr int kSsimWindow = 11;

/// Normalised Gaussian of sigma 1.5; the 11 x 11 window of Wang et al. 2004 is its outer product.
std::array<float, kSsimWindow> ssimWindow() {
  std::array<double, kSsimWindow> w{};
  double sum = 0;
  for (int i = 0; i < kSsimWindow; ++i) {
    const double d = i - kSsimWindow / 2;
    sum += w[size_t(i)] = std::exp(-d * d / (2 * 1.5 * 1.5));
  }
  std::array<float, kSsimWindow> result{};
  for (size_t i = 0; i < w.size(); ++i) result[i] = float(w[i] / sum);
  return result;
}

// The two loops below are nearly all of ssim()'s time; O3 lets them be vectorised, and the clone
// for the machine's registers is chosen when the program starts.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define VDBC_VECTORISED \
  __attribute__((optimize("O3"), target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define VDBC_VECTORISED
#endif

constexpr float kSsimShift = 0.5f;  // variances do not see it, and their cancellation gets smaller

/// a, b, a^2, b^2 and a b of 11 rows (the first at `a`, `b`), filtered down the columns: [5, row].
VDBC_VECTORISED void ssimDown(const float* __restrict a, const float* __restrict b, size_t row,
                              const float* __restrict window, float* __restrict moments) {
  for (size_t i = 0; i < row; ++i) {
    float ma = 0, mb = 0, aa = 0, bb = 0, ab = 0;
    for (size_t k = 0; k < kSsimWindow; ++k) {
      const float va = a[k * row + i] - kSsimShift, vb = b[k * row + i] - kSsimShift;
      const float wa = window[k] * va, wb = window[k] * vb;
      ma += wa, mb += wb, aa += wa * va, bb += wb * vb, ab += wa * vb;
    }
    moments[i] = ma, moments[row + i] = mb;
    moments[2 * row + i] = aa, moments[3 * row + i] = bb, moments[4 * row + i] = ab;
  }
}

/// Filters the moments along the row: SSIM of its windows and channels.
VDBC_VECTORISED void ssimAcross(const float* __restrict moments, size_t row, size_t channels,
                                const float* __restrict window, float* __restrict value) {
  constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
  const size_t count = row - (kSsimWindow - 1) * channels;
  for (size_t i = 0; i < count; ++i) {
    const float* from = moments + i;
    float m[5] = {};
    for (size_t k = 0; k < kSsimWindow; ++k) {
      for (size_t j = 0; j < 5; ++j) m[j] += window[k] * from[j * row + k * channels];
    }
    const float variances = (m[2] - m[0] * m[0]) + (m[3] - m[1] * m[1]);
    const float covariance = m[4] - m[0] * m[1];
    const float ma = m[0] + kSsimShift, mb = m[1] + kSsimShift;
    value[i] = (2 * ma * mb + kC1) * (2 * covariance + kC2) /
               ((ma * ma + mb * mb + kC1) * (variances + kC2));
  }
}

}  // namespace

float srgbFromLinear(float linear) {
  return linear <= 0.0031308f ? 12.92f * linear : 1.055f * std::pow(linear, 1 / 2.4f) - 0.055f;
}

float linearFromSrgb(float srgb) {
  return srgb <= 0.04045f ? srgb / 12.92f : std::pow((srgb + 0.055f) / 1.055f, 2.4f);
}

void requireImage(const char* operation, const Image& image) {
  require(
      image.width > 0 && image.height > 0 && image.channels > 0 &&
          image.data.size() == size_t(image.width) * size_t(image.height) * size_t(image.channels),
      operation, ": inconsistent image: ", image.width, " x ", image.height, " x ", image.channels,
      ", ", image.data.size(), " values");
}

Image resizeImage(const Image& image, int width, int height) {
  requireImage("resizeImage", image);
  require(width > 0 && height > 0, "resizeImage: expected a positive size, found ", width, " x ",
          height);
  const std::vector<Taps> across = resizeTaps(image.width, width);
  const std::vector<Taps> down = resizeTaps(image.height, height);
  const int channels = image.channels;
  Image narrow(width, image.height, channels), result(width, height, channels);
  tbb::parallel_for(0, image.height, [&](int y) {
    for (int x = 0; x < width; ++x) {
      const Taps& t = across[size_t(x)];
      for (int c = 0; c < channels; ++c) {
        float sum = 0;
        for (size_t k = 0; k < t.weights.size(); ++k) {
          sum += t.weights[k] * image.at(t.first + int(k), y, c);
        }
        narrow.at(x, y, c) = sum;
      }
    }
  });
  tbb::parallel_for(0, height, [&](int y) {
    const Taps& t = down[size_t(y)];
    float* to = &result.at(0, y, 0);
    for (size_t k = 0; k < t.weights.size(); ++k) {
      const float* from = &narrow.at(0, t.first + int(k), 0);
      for (size_t i = 0; i < size_t(width) * size_t(channels); ++i) to[i] += t.weights[k] * from[i];
    }
  });
  return result;
}

Image tileImages(const std::vector<Image>& pictures, int columns) {
  const int count = int(pictures.size());
  columns = std::min(columns, count);
  int width = 0, height = 0;
  for (const Image& p : pictures) {
    require(p.width == 0 || p.channels == 3, "tileImages: expected 3 channels, found ", p.channels);
    width = std::max(width, p.width), height = std::max(height, p.height);
  }
  require(columns > 0 && width > 0, "tileImages: expected pictures, found none");
  Image sheet(columns * width, (count + columns - 1) / columns * height, 3, .15f);
  for (int i = 0; i < count; ++i) {
    const Image& p = pictures[size_t(i)];
    const size_t row = 3 * size_t(p.width);
    for (int y = 0; y < p.height; ++y)
      std::copy_n(&p.data[size_t(y) * row], row,
                  &sheet.at(i % columns * width, i / columns * height + y, 0));
  }
  return sheet;
}

double psnr(const Image& a, const Image& b) {
  requireSameSize("psnr", a, b);
  const size_t row = size_t(a.width) * size_t(a.channels);
  std::vector<double> sums(size_t(a.height));
  tbb::parallel_for(size_t(0), sums.size(), [&](size_t y) {
    double sum = 0;
    for (size_t i = y * row; i < (y + 1) * row; ++i) {
      const double d = double(a.data[i]) - double(b.data[i]);
      sum += d * d;
    }
    sums[y] = sum;
  });
  double sum = 0;
  for (double s : sums) sum += s;
  if (sum == 0) return std::numeric_limits<double>::infinity();
  return -10 * std::log10(sum / double(a.data.size()));
}

Image ssimMap(const Image& a, const Image& b) {
  requireSameSize("ssim", a, b);
  require(a.width >= kSsimWindow && a.height >= kSsimWindow,
          "ssim: expected images of at least 11 x 11 pixels, found ", a.width, " x ", a.height);
  const std::array<float, kSsimWindow> window = ssimWindow();
  const size_t row = size_t(a.width) * size_t(a.channels);
  Image map(a.width - 2 * kSsimBorder, a.height - 2 * kSsimBorder, a.channels);
  const size_t map_row = size_t(map.width) * size_t(map.channels);
  tbb::parallel_for(tbb::blocked_range<size_t>(0, size_t(map.height), 8), [&](const auto& range) {
    std::vector<float> moments(5 * row);
    for (size_t y = range.begin(); y < range.end(); ++y) {
      ssimDown(a.data.data() + y * row, b.data.data() + y * row, row, window.data(),
               moments.data());
      ssimAcross(moments.data(), row, size_t(a.channels), window.data(),
                 map.data.data() + y * map_row);
    }
  });
  return map;
}

double ssim(const Image& a, const Image& b) {
  const Image map = ssimMap(a, b);
  double sum = 0;
  for (float v : map.data) sum += double(v);
  return sum / double(map.data.size());
}

}  // namespace vdbc
