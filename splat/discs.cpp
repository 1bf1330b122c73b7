#include "splat/discs.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "splat/rasterize.h"
#include "splat/seen_image.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr double kSigmaOfSide = .6;  // a disc's sigma by its patch's side
constexpr double kThickness = .3;    // of the smaller sigma
constexpr float kOpacityLogit = 5;
constexpr double kGainPixels = 224 * 224;
constexpr double kDepthWeight = .05;  // error of colour that a pixel far off its plane counts as

// --- who keeps what ---------------------------------------------------------------------------

constexpr float kThrough = -1;  // instead of a weight: somebody looks through the pixel's point

// The weight of a pixel of view `i` that keeps it: it sees its point finest, and nobody looks
// through it. Else 0 or kThrough.
float ownWeight(const std::vector<SeenImage>& images, size_t i, int x, int y,
                const std::vector<size_t>& neighbours) {
  const SeenImage& image = images[i];
  const size_t p = image.pixel(x, y);
  const Vector3d point = image.point(x, y);
  int supported = 0, seen_through = 0;
  for (size_t j : neighbours) {
    const SeenImage& other = images[j];
    const Vector3d uvz = other.view.camera.project(point);
    const int64_t o = other.view.camera.pixelAt(uvz);
    if (o < 0) continue;
    const Verdict verdict = verdictOf(other, int(uvz.x()), int(uvz.y()), 1 / uvz.z());
    seen_through += verdict == Verdict::kThrough;
    if (verdict != Verdict::kSame) continue;
    ++supported;
    const float mine = image.footprint[p] / image.weight[p],
                theirs = other.footprint[size_t(o)] / other.weight[size_t(o)];
    if (theirs < mine * .999f || (theirs <= mine * 1.001f && j < i)) return 0;
  }
  if (seen_through > supported || (seen_through && image.weight[p] < 1)) return kThrough;
  return image.weight[p];
}

std::vector<float> ownPixels(const std::vector<SeenImage>& images, size_t i) {
  const SeenImage& image = images[i];
  const std::vector<size_t> neighbours = neighboursOf(images, i);
  std::vector<float> own(image.weight.size(), 0.f);
  tbb::parallel_for(0, image.height(), [&](int y) {
    for (int x = 0; x < image.width(); ++x)
      if (image.weight[image.pixel(x, y)] > 0)
        own[image.pixel(x, y)] = ownWeight(images, i, x, y, neighbours);
  });
  return own;
}

// --- patches ----------------------------------------------------------------------------------

struct Patch {
  int x0, y0, x1, y1;  // pixels, end exclusive
  ImagePlane plane;    // that of the largest patch around it that is flat
  bool flat;
};

struct PatchCutter {
  const SeenImage& image;
  const SumTable& table;
  double least_gain;
  std::vector<std::pair<Patch, Sums>>* out;

  // Error of colour and of depth, in colour's terms; fits the plane where none holds yet.
  double errorOf(const Sums& s, Patch* p) const {
    double depth = 0;
    if (!p->flat) {
      double error = 0;
      p->plane = fitPlane(s, &error);
      const double excess = std::sqrt(error / s[kN]) / (kNoiseSigmas * image.noise) - 1;
      p->flat = excess <= 0;
      depth = kDepthWeight * s[kN] * std::clamp(excess, 0., 1.);
    }
    return colourError(s) + depth;
  }

  void cut(Patch patch) const {
    const Sums s = table.over(patch.x0, patch.y0, patch.x1, patch.y1);
    if (s[kN] < .5) return;
    const double error = errorOf(s, &patch);
    double best = -1;
    std::array<Patch, 2> halves;
    const auto attempt = [&](Patch low, Patch high) {
      const Sums a = table.over(low.x0, low.y0, low.x1, low.y1);
      Sums b;
      for (size_t k = 0; k < kSums; ++k) b[k] = s[k] - a[k];
      double left = error;
      if (a[kN] > .5) left -= errorOf(a, &low);
      if (b[kN] > .5) left -= errorOf(b, &high);
      if (left > best) best = left, halves = {low, high};
    };
    const int w = patch.x1 - patch.x0, h = patch.y1 - patch.y0;
    for (int quarter = 1; quarter <= 3; ++quarter) {
      Patch low = patch, high = patch;
      // Long thin discs are bad ones: the longer side is cut.
      if (w >= 2 && 3 * w >= 2 * h && (quarter == 2 || w >= 4)) {
        low.x1 = high.x0 = patch.x0 + std::max(1, w * quarter / 4);
        attempt(low, high);
      }
      low = high = patch;
      if (h >= 2 && 3 * h >= 2 * w && (quarter == 2 || h >= 4)) {
        low.y1 = high.y0 = patch.y0 + std::max(1, h * quarter / 4);
        attempt(low, high);
      }
    }
    // A cut may bring nothing by itself and still open the way to those that do.
    if (best >= 0 && best + .1 * error > least_gain) {
      for (const Patch& half : halves) cut(half);
    } else {
      out->emplace_back(patch, s);
    }
  }
};

// The disc of a patch, by the moments of its pixels on its plane.
void addDisc(const SeenImage& image, const Patch& patch, const Sums& s, Gaussians* g) {
  const Camera& c = image.view.camera;
  const double n = s[kN], u = s[kU] / n, v = s[kV] / n;
  const double q = patch.flat ? patch.plane.at(u, v) : s[kQ] / n;
  if (!(q > 0)) return;
  const double a = patch.plane.a, b = patch.plane.b, x = (u - c.cx) / c.fx, y = (v - c.cy) / c.fy;
  Eigen::Matrix<double, 3, 2> tangents;  // of the point (x, y, 1) / q by u and v
  tangents << 1 / c.fx - x * a / q, -x * b / q, -y * a / q, 1 / c.fy - y * b / q, -a / q, -b / q;
  tangents /= q;
  // A pixel is a square: its own variance is 1/12.
  Eigen::Matrix2d spread;
  spread << s[kUU] / n - u * u + 1. / 12, s[kUV] / n - u * v, 0, s[kVV] / n - v * v + 1. / 12;
  spread(1, 0) = spread(0, 1);
  const Eigen::LLT<Eigen::Matrix2d> root(spread);
  const Eigen::JacobiSVD<Eigen::Matrix<double, 3, 2>> svd(
      tangents * Eigen::Matrix2d(root.matrixL()), Eigen::ComputeFullU);
  const double to_sigma = kSigmaOfSide * std::sqrt(12.);  // from a square's deviation
  Vector3d sigma(svd.singularValues()[0], svd.singularValues()[1], 0);
  sigma *= to_sigma;
  const double across =
      to_sigma * std::sqrt(std::max(spread(0, 0), spread(1, 1))) / (q * c.fx * kLeastCosine);
  sigma[0] = std::min(sigma[0], across), sigma[1] = std::min(sigma[1], across);
  sigma[2] = kThickness * sigma[1];
  Matrix3d axes = c.world_from_camera.linear() * svd.matrixU();
  if (axes.determinant() < 0) axes.col(2) *= -1;
  const Eigen::Quaterniond rotation(axes);
  const Vector3d mean = c.unproject(u, v, 1 / q);
  if (!mean.allFinite() || !(sigma.minCoeff() > 0) || !sigma.allFinite()) return;
  g->mean.push_back(mean.cast<float>());
  g->log_scale.push_back(sigma.array().log().cast<float>());
  g->rotation.push_back(
      Eigen::Vector4d(rotation.w(), rotation.x(), rotation.y(), rotation.z()).cast<float>());
  g->opacity_logit.push_back(kOpacityLogit);
  for (Sum channel : {kR, kG, kB}) g->sh.push_back((float(s[channel] / n) - .5f) / kSh0);
}

// Discs of the pixels with a weight.
Gaussians discsOf(const SeenImage& image, const std::vector<float>& weight,
                  const DiscSettings& settings) {
  const SumTable table(image.view.colour, image.q, weight);
  std::vector<std::pair<Patch, Sums>> patches;
  const int w = image.width(), h = image.height(), side = std::max(8, w / 40);
  const double gain = settings.gain * std::pow(double(w) * h / kGainPixels, 1.5) +
                      settings.noise_gain * image.colour_noise;
  const PatchCutter cutter{image, table, gain, &patches};
  for (int y = 0; y < h; y += side)
    for (int x = 0; x < w; x += side)
      cutter.cut({x, y, std::min(x + side, w), std::min(y + side, h), {}, false});
  Gaussians g;
  g.antialias = true;
  for (const auto& [patch, sums] : patches) addDisc(image, patch, sums, &g);
  return g;
}

// Pixels that nobody owns for a reason that did not hold: nothing stands there in a picture.
std::vector<float> gapsOf(const SeenImage& image, const std::vector<float>& own,
                          const Gaussians& discs) {
  RasterSettings raster;
  raster.antialias = true;
  const RasterOutput seen = rasterize(discs, image.view.camera, raster);
  std::vector<float> gaps(own.size(), 0.f);
  for (size_t i = 0; i < own.size(); ++i) {
    if (image.weight[i] != 1 || own[i] == kThrough) continue;
    const double behind = 1 / double(image.q[i]) * 1.02 + 3 * image.noise / std::pow(image.q[i], 2);
    if (seen.alpha.data[i] < .7f || seen.depth.data[i] > behind) gaps[i] = 1;
  }
  return gaps;
}

}  // namespace

Gaussians placeDiscs(const std::vector<SeenImage>& images, const DiscSettings& settings) {
  require(settings.gain > 0 && settings.noise_gain >= 0,
          "placeDiscs: expected a positive gain, found ", settings.gain);
  const size_t n = images.size();
  std::vector<std::vector<float>> own(n);
  std::vector<Gaussians> parts(n);
  const auto append = [&](Gaussians* all) {
    for (const Gaussians& part : parts) appendRows(all, part);
  };
  tbb::parallel_for(size_t(0), n, [&](size_t i) {
    own[i] = ownPixels(images, i);
    parts[i] = discsOf(images[i], own[i], settings);
  });
  Gaussians all;
  all.antialias = true;
  append(&all);
  tbb::parallel_for(size_t(0), n, [&](size_t i) {
    parts[i] = discsOf(images[i], gapsOf(images[i], own[i], all), settings);
  });
  append(&all);
  return all;
}

}  // namespace vdbc
