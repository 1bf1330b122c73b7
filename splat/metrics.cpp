#include "splat/metrics.h"

#include <tbb/parallel_for.h>

#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "vdb/error.h"

namespace vdbc {
namespace {

// ---- FLIP. Andersson et al. 2020.

/// One channel, [height * width].
using Plane = std::vector<float>;

/// Taps of an odd one-dimensional filter, centre in the middle.
using Taps = std::vector<float>;

/// A filter along x and one along y: together a separable one.
struct Separable {
  const Taps* across;
  const Taps* down;
};

struct Size {
  int width = 0, height = 0;
  size_t pixels() const { return size_t(width) * size_t(height); }
};

/// Convolves along x and then y; outside, the border pixels go on.
Plane filtered(const Plane& from, Size size, const Separable& filter) {
  const int w = size.width, h = size.height;
  const int rx = int(filter.across->size() / 2), ry = int(filter.down->size() / 2);
  Plane rows(size.pixels()), result(size.pixels());
  tbb::parallel_for(0, h, [&](int y) {
    const float* row = from.data() + size_t(y) * size_t(w);
    std::vector<float> padded(size_t(w + 2 * rx));
    for (int x = 0; x < w + 2 * rx; ++x) padded[size_t(x)] = row[std::clamp(x - rx, 0, w - 1)];
    float* to = rows.data() + size_t(y) * size_t(w);
    for (size_t k = 0; k < filter.across->size(); ++k) {
      const float weight = (*filter.across)[filter.across->size() - 1 - k];
      for (int x = 0; x < w; ++x) to[x] += weight * padded[size_t(x) + k];
    }
  });
  tbb::parallel_for(0, h, [&](int y) {
    float* to = result.data() + size_t(y) * size_t(w);
    for (size_t k = 0; k < filter.down->size(); ++k) {
      const float weight = (*filter.down)[filter.down->size() - 1 - k];
      const float* row = rows.data() + size_t(std::clamp(y + int(k) - ry, 0, h - 1)) * size_t(w);
      for (int x = 0; x < w; ++x) to[x] += weight * row[x];
    }
  });
  return result;
}

/// exp(-scale x^2) at the whole numbers from -radius to radius.
std::vector<double> gaussian(int radius, double scale) {
  std::vector<double> g;
  for (int x = -radius; x <= radius; ++x) g.push_back(std::exp(-scale * x * x));
  return g;
}

double sumOf(const std::vector<double>& values) {
  double sum = 0;
  for (double v : values) sum += v;
  return sum;
}

/// The positive taps sum to 1, the negative ones, if any, to -1.
Taps normalised(const std::vector<double>& taps) {
  double positive = 0, negative = 0;
  for (double t : taps) (t > 0 ? positive : negative) += t;
  Taps result;
  for (double t : taps) result.push_back(float(t > 0 ? t / positive : t < 0 ? -t / negative : 0.));
  return result;
}

/// Contrast sensitivity of one channel: a sum of a sqrt(pi / b) exp(-pi^2 x^2 / b), x in degrees.
struct Sensitivity {
  double a[2], b[2];
};
constexpr Sensitivity kSensitivity[3] = {{{1, 0}, {.0047, 1e-5}},       // luminance
                                         {{1, 0}, {.0053, 1e-5}},       // red-green
                                         {{34.1, 13.5}, {.04, .025}}};  // blue-yellow
constexpr double kWidestB = .04;

Plane eyeFiltered(const Plane& from, Size size, const Sensitivity& s, double pixels_per_degree) {
  const int radius = int(std::ceil(3 * std::sqrt(kWidestB / 2) / M_PI * pixels_per_degree));
  Plane result(size.pixels());
  // Each term is separable. Its weight: what it contributes to the sum over the square.
  std::array<std::vector<double>, 2> g;
  std::array<double, 2> weight{};
  for (size_t i = 0; i < 2; ++i) {
    g[i] = gaussian(radius, M_PI * M_PI / (s.b[i] * pixels_per_degree * pixels_per_degree));
    weight[i] = s.a[i] * std::sqrt(M_PI / s.b[i]) * sumOf(g[i]) * sumOf(g[i]);
  }
  for (size_t i = 0; i < 2; ++i) {
    if (s.a[i] == 0) continue;
    const Taps taps = normalised(g[i]);
    const Plane term = filtered(from, size, {&taps, &taps});
    const float share = float(weight[i] / (weight[0] + weight[1]));
    for (size_t p = 0; p < result.size(); ++p) result[p] += share * term[p];
  }
  return result;
}

/// CIE XYZ of linear sRGB (IEC 61966-2-1), relative to its own white: white is (1, 1, 1).
const Eigen::Matrix3f& xyzFromRgb() {
  static const Eigen::Matrix3f matrix = [] {
    Eigen::Matrix3d m;
    m << .4124564, .3575761, .1804375, .2126729, .7151522, .0721750, .0193339, .1191920, .9503041;
    const Eigen::Vector3d white = m * Eigen::Vector3d::Ones();
    return Eigen::Matrix3f((white.cwiseInverse().asDiagonal() * m).cast<float>());
  }();
  return matrix;
}

/// YCxCz: a linear kin of L*a*b*.
Eigen::Vector3f opponentFromRgb(const Eigen::Vector3f& rgb) {
  const Eigen::Vector3f t = xyzFromRgb() * rgb;
  return {116 * t.y() - 16, 500 * (t.x() - t.y()), 200 * (t.y() - t.z())};
}

Eigen::Vector3f rgbFromOpponent(const Eigen::Vector3f& c) {
  static const Eigen::Matrix3f rgb_from_xyz = xyzFromRgb().inverse();
  const float y = (c.x() + 16) / 116;
  return rgb_from_xyz * Eigen::Vector3f(y + c.y() / 500, y, y - c.z() / 200);
}

/// L*a*b* with a and b scaled by luminance, the Hunt effect.
Eigen::Vector3f huntLabFromRgb(const Eigen::Vector3f& rgb) {
  const auto f = [](float t) {
    constexpr float kDelta = 6.f / 29;
    return t > kDelta * kDelta * kDelta ? std::cbrt(t) : t / (3 * kDelta * kDelta) + 4.f / 29;
  };
  const Eigen::Vector3f t = (xyzFromRgb() * rgb).unaryExpr(f);
  const float l = 116 * t.y() - 16;
  return {l, .01f * l * 500 * (t.x() - t.y()), .01f * l * 200 * (t.y() - t.z())};
}

/// HyAB (Abasi et al. 2020): lightness by the city block, colour by the straight line.
float hyab(const Eigen::Vector3f& a, const Eigen::Vector3f& b) {
  const Eigen::Vector3f d = a - b;
  return std::abs(d.x()) + std::hypot(d.y(), d.z());
}

constexpr float kColourPower = .7f;              // q_c
constexpr float kKneeIn = .4f, kKneeOut = .95f;  // p_c, p_t
constexpr float kFeaturePower = .5f;             // q_f
constexpr double kFeatureWidthDegrees = .082;    // w

/// Colour difference as 0-1: most of the range for those below p_c of the largest.
float colourDifference(const Eigen::Vector3f& a, const Eigen::Vector3f& b) {
  static const float largest =
      std::pow(hyab(huntLabFromRgb({0, 1, 0}), huntLabFromRgb({0, 0, 1})), kColourPower);
  const float e = std::pow(hyab(a, b), kColourPower) / largest;
  if (e < kKneeIn) return kKneeOut / kKneeIn * e;
  return std::min(1.f, kKneeOut + (e - kKneeIn) / (1 - kKneeIn) * (1 - kKneeOut));
}

/// What the two pipelines compare.
struct Seen {
  std::vector<Eigen::Vector3f> colour;  // Hunt-adjusted L*a*b*, as the eye blurs it
  Plane edges, points;                  // strengths of the features of luminance
};

Plane magnitude(const Plane& x, const Plane& y) {
  Plane result(x.size());
  for (size_t i = 0; i < x.size(); ++i) result[i] = std::hypot(x[i], y[i]);
  return result;
}

Seen see(const Image& image, double pixels_per_degree) {
  const Size size{image.width, image.height};
  std::array<Plane, 3> opponent;
  for (Plane& plane : opponent) plane.resize(size.pixels());
  Plane luminance(size.pixels());
  tbb::parallel_for(size_t(0), size.pixels(), [&](size_t i) {
    Eigen::Vector3f rgb;
    for (size_t c = 0; c < 3; ++c) {
      const float v = image.data[3 * i + c];
      rgb[Eigen::Index(c)] = v > 0 ? linearFromSrgb(std::min(v, 1.f)) : 0.f;
    }
    const Eigen::Vector3f o = opponentFromRgb(rgb);
    for (size_t c = 0; c < 3; ++c) opponent[c][i] = o[Eigen::Index(c)];
    luminance[i] = (o.x() + 16) / 116;
  });

  Seen seen;
  for (size_t c = 0; c < 3; ++c)
    opponent[c] = eyeFiltered(opponent[c], size, kSensitivity[c], pixels_per_degree);
  seen.colour.resize(size.pixels());
  tbb::parallel_for(size_t(0), size.pixels(), [&](size_t i) {
    const Eigen::Vector3f rgb = rgbFromOpponent({opponent[0][i], opponent[1][i], opponent[2][i]});
    seen.colour[i] = huntLabFromRgb(rgb.cwiseMax(0.f).cwiseMin(1.f));
  });

  // First and second derivatives of a Gaussian.
  const double sigma = .5 * kFeatureWidthDegrees * pixels_per_degree;
  const int radius = int(std::ceil(3 * sigma));
  const std::vector<double> g = gaussian(radius, .5 / (sigma * sigma));
  std::vector<double> first, second;
  for (int x = -radius; x <= radius; ++x) {
    const double value = g[size_t(x + radius)];
    first.push_back(-x * value);
    second.push_back((x * x / (sigma * sigma) - 1) * value);
  }
  const Taps blur = normalised(g), edge = normalised(first), point = normalised(second);
  const auto response = [&](const Taps& across, const Taps& down) {
    return filtered(luminance, size, {&across, &down});
  };
  seen.edges = magnitude(response(edge, blur), response(blur, edge));
  seen.points = magnitude(response(point, blur), response(blur, point));
  return seen;
}

void requireColours(const char* operation, const Image& image) {
  require(image.width > 0 && image.height > 0 && image.channels == 3 &&
              image.data.size() == size_t(image.width) * size_t(image.height) * 3,
          operation, ": expected an image of 3 channels, found ", image.width, " x ", image.height,
          " x ", image.channels, ", ", image.data.size(), " values");
}

}  // namespace

Image flipMap(const Image& reference, const Image& test, double pixels_per_degree) {
  requireColours("flip", reference);
  requireColours("flip", test);
  require(reference.width == test.width && reference.height == test.height,
          "flip: images differ in size: ", reference.width, " x ", reference.height, " and ",
          test.width, " x ", test.height);
  // Below, the derivatives' filters have no two signs; above, the filters outgrow any image.
  require(pixels_per_degree >= 1 && pixels_per_degree <= 1e4,
          "flip: expected 1 to 10000 pixels a degree, found ", pixels_per_degree);
  const Seen a = see(reference, pixels_per_degree), b = see(test, pixels_per_degree);
  Image map(reference.width, reference.height, 1);
  tbb::parallel_for(size_t(0), map.data.size(), [&](size_t i) {
    const float colour = colourDifference(a.colour[i], b.colour[i]);
    const float feature =
        std::max(std::abs(a.edges[i] - b.edges[i]), std::abs(a.points[i] - b.points[i]));
    // Luminance is in 0-1, so each component of a response is, too.
    const float noticed = std::pow(std::min(1.f, feature * float(M_SQRT1_2)), kFeaturePower);
    map.data[i] = std::pow(colour, 1 - noticed);
  });
  return map;
}

double flip(const Image& reference, const Image& test, double pixels_per_degree) {
  const Image map = flipMap(reference, test, pixels_per_degree);
  double sum = 0;
  for (float v : map.data) sum += double(v);
  return sum / double(map.data.size());
}

PictureError pictureError(const Image& reference, const Image& test,
                          const std::vector<uint8_t>& mask) {
  requireColours("pictureError", reference);
  requireColours("pictureError", test);
  require(reference.width == test.width && reference.height == test.height &&
              mask.size() == size_t(test.width) * size_t(test.height),
          "pictureError: expected images and a mask of one size, found ", reference.width, " x ",
          reference.height, ", ", test.width, " x ", test.height, " and ", mask.size(), " pixels");
  Image seen = test;
  PictureError e;
  double squares = 0;
  for (size_t i = 0; i < mask.size(); ++i)
    for (size_t c = 3 * i; c < 3 * i + 3; ++c) {
      if (!mask[i]) seen.data[c] = reference.data[c];
      const double d = double(seen.data[c]) - double(reference.data[c]);
      squares += d * d;
    }
  const Image flips = flipMap(reference, seen), similarities = ssimMap(reference, seen);
  double flip_sum = 0, ssim_sum = 0, windows = 0;
  for (int y = 0; y < test.height; ++y)
    for (int x = 0; x < test.width; ++x) {
      if (!mask[size_t(y) * size_t(test.width) + size_t(x)]) continue;
      ++e.pixels;
      flip_sum += double(flips.at(x, y, 0));
      const int wx = x - kSsimBorder, wy = y - kSsimBorder;
      if (wx < 0 || wy < 0 || wx >= similarities.width || wy >= similarities.height) continue;
      for (int c = 0; c < 3; ++c) ssim_sum += double(similarities.at(wx, wy, c)) / 3;
      ++windows;
    }
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  e.psnr = e.pixels ? -10 * std::log10(squares / (3 * double(e.pixels))) : kNan;
  e.flip = e.pixels ? flip_sum / double(e.pixels) : kNan;
  e.ssim = windows > 0 ? ssim_sum / windows : kNan;
  return e;
}

DepthError depthError(const std::vector<float>& depth, const std::vector<float>& truth) {
  require(depth.size() == truth.size(), "depthError: expected ", truth.size(), " depths, found ",
          depth.size());
  const auto isDepth = [](float d) { return d > 0 && std::isfinite(d); };
  std::vector<double> errors;
  size_t measured = 0;
  double squares = 0;
  for (size_t i = 0; i < truth.size(); ++i) {
    if (!isDepth(truth[i])) continue;
    ++measured;
    if (!isDepth(depth[i])) continue;
    errors.push_back(std::abs(double(depth[i]) - double(truth[i])));
    squares += errors.back() * errors.back();
  }
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  if (errors.empty()) return {kNan, kNan, measured ? 0. : kNan};
  const auto middle = errors.begin() + std::ptrdiff_t((errors.size() - 1) / 2);
  std::nth_element(errors.begin(), middle, errors.end());
  return {*middle, std::sqrt(squares / double(errors.size())),
          double(errors.size()) / double(measured)};
}

}  // namespace vdbc
