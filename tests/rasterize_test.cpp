// The rasteriser against a plain double-precision renderer, its finite differences, and closed
// forms.
#include "splat/rasterize.h"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <numeric>
#include <random>

#include "vdb/error.h"

namespace vdbc {
namespace {

// --- reference
// -------------------------------------------------------------------------------------

/// All parameters of a scene in double precision, by array: mean, log_scale, rotation,
/// opacity_logit, sh, extra channels, camera twist (rotation, translation).
constexpr int kArrays = 7;
struct Parameters {
  int n = 0, sh_degree = 0, channels = 0;
  std::vector<double> arrays[kArrays];
};
const char* const kArrayNames[kArrays] = {"mean", "log_scale", "rotation", "opacity_logit",
                                          "sh",   "extra",     "camera"};

Parameters parametersOf(const Gaussians& g, const ExtraChannels& extra = {}) {
  Parameters p;
  p.n = int(g.size()), p.sh_degree = g.sh_degree;
  for (int i = 0; i < p.n; ++i) {
    for (int j = 0; j < 3; ++j) p.arrays[0].push_back(double(g.mean[size_t(i)][j]));
    for (int j = 0; j < 3; ++j) p.arrays[1].push_back(double(g.log_scale[size_t(i)][j]));
    for (int j = 0; j < 4; ++j) p.arrays[2].push_back(double(g.rotation[size_t(i)][j]));
    p.arrays[3].push_back(double(g.opacity_logit[size_t(i)]));
  }
  p.arrays[4].assign(g.sh.begin(), g.sh.end());
  p.channels = extra.count;
  p.arrays[5].assign(extra.values, extra.values + g.size() * extra.count);
  p.arrays[6].assign(6, 0.);
  return p;
}

/// Real spherical harmonics as in the 3DGS code, unit vector.
std::vector<double> referenceBasis(int degree, const Eigen::Vector3d& d) {
  const double x = d.x(), y = d.y(), z = d.z();
  const double pi = M_PI;
  std::vector<double> b = {0.5 * std::sqrt(1 / pi)};
  if (degree >= 1) {
    const double c = std::sqrt(3 / (4 * pi));
    b.insert(b.end(), {-c * y, c * z, -c * x});
  }
  if (degree >= 2) {
    const double c = 0.5 * std::sqrt(15 / pi);
    b.insert(b.end(), {c * x * y, -c * y * z, 0.25 * std::sqrt(5 / pi) * (3 * z * z - 1),
                       -c * x * z, 0.5 * c * (x * x - y * y)});
  }
  if (degree >= 3) {
    const double c3 = 0.25 * std::sqrt(35 / (2 * pi)), c2 = 0.5 * std::sqrt(105 / pi),
                 c1 = 0.25 * std::sqrt(21 / (2 * pi)), c0 = 0.25 * std::sqrt(7 / pi);
    b.insert(b.end(), {-c3 * y * (3 * x * x - y * y), c2 * x * y * z, -c1 * y * (5 * z * z - 1),
                       c0 * z * (5 * z * z - 3), -c1 * x * (5 * z * z - 1),
                       0.5 * c2 * z * (x * x - y * y), -c3 * x * (x * x - 3 * y * y)});
  }
  return b;
}

struct ReferenceImage {
  std::vector<double> values;  // [H, W, 6 + C]: colour, alpha, depth, median depth, extra channels
};

/// Every pixel asks every Gaussian, in order of depth.
ReferenceImage renderReference(const Parameters& p, const Camera& unmoved,
                               const RasterSettings& settings) {
  Camera camera = unmoved;
  const Eigen::Vector3d turn(p.arrays[6][0], p.arrays[6][1], p.arrays[6][2]);
  camera.world_from_camera.translate(
      Eigen::Vector3d(p.arrays[6][3], p.arrays[6][4], p.arrays[6][5]));
  if (turn.norm() > 0)
    camera.world_from_camera.rotate(Eigen::AngleAxisd(turn.norm(), turn.normalized()));
  struct Spot {
    int index;
    double u, v, z, opacity;
    Eigen::Matrix2d inverse;
    Eigen::Vector3d colour;
  };
  std::vector<Spot> spots;
  const Eigen::Matrix3d world = camera.world_from_camera.linear();
  const Eigen::Vector3d eye = camera.world_from_camera.translation();
  for (int i = 0; i < p.n; ++i) {
    const double* m = &p.arrays[0][size_t(3 * i)];
    const double* s = &p.arrays[1][size_t(3 * i)];
    const double* q = &p.arrays[2][size_t(4 * i)];
    const Eigen::Vector3d mean(m[0], m[1], m[2]);
    const Eigen::Vector3d t = world.transpose() * (mean - eye);
    if (!(t.z() > double(settings.near_m))) continue;
    const Eigen::Matrix3d r = Eigen::Quaterniond(q[0], q[1], q[2], q[3]).normalized().matrix();
    const Eigen::Vector3d variance(std::exp(2 * s[0]), std::exp(2 * s[1]), std::exp(2 * s[2]));
    const Eigen::Matrix3d covariance = r * variance.asDiagonal() * r.transpose();
    const double xc = std::clamp(t.x() / t.z(), (-camera.cx - 0.15 * camera.width) / camera.fx,
                                 (1.15 * camera.width - camera.cx) / camera.fx);
    const double yc = std::clamp(t.y() / t.z(), (-camera.cy - 0.15 * camera.height) / camera.fy,
                                 (1.15 * camera.height - camera.cy) / camera.fy);
    Eigen::Matrix<double, 2, 3> jacobian;
    jacobian << camera.fx / t.z(), 0, -camera.fx * xc / t.z(), 0, camera.fy / t.z(),
        -camera.fy * yc / t.z();
    const Eigen::Matrix<double, 2, 3> a = jacobian * world.transpose();
    const Eigen::Matrix2d sharp = a * covariance * a.transpose();
    const Eigen::Matrix2d cov = sharp + double(settings.low_pass) * Eigen::Matrix2d::Identity();
    Spot spot;
    spot.index = i;
    spot.u = camera.fx * t.x() / t.z() + camera.cx;
    spot.v = camera.fy * t.y() / t.z() + camera.cy;
    spot.z = t.z();
    spot.opacity = 1 / (1 + std::exp(-p.arrays[3][size_t(i)]));
    if (settings.antialias) spot.opacity *= std::sqrt(sharp.determinant() / cov.determinant());
    spot.inverse = cov.inverse();
    const std::vector<double> basis = referenceBasis(p.sh_degree, (mean - eye).normalized());
    for (int c = 0; c < 3; ++c) {
      double value = 0.5;
      for (size_t k = 0; k < basis.size(); ++k)
        value += basis[k] * p.arrays[4][(size_t(i) * basis.size() + k) * 3 + size_t(c)];
      spot.colour[c] = std::max(0.0, value);
    }
    spots.push_back(spot);
  }
  std::stable_sort(spots.begin(), spots.end(),
                   [](const Spot& a, const Spot& b) { return a.z < b.z; });
  ReferenceImage image;
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      Eigen::Vector3d colour = Eigen::Vector3d::Zero();
      double t = 1, weight = 0, weighted_z = 0, median = 0;
      std::vector<double> channels(size_t(p.channels), 0.);
      for (const Spot& s : spots) {
        const Eigen::Vector2d d(x + 0.5 - s.u, y + 0.5 - s.v);
        const double alpha = s.opacity * std::exp(-0.5 * d.dot(s.inverse * d));
        if (alpha < double(settings.min_alpha)) continue;
        const double w = t * std::min(alpha, double(settings.max_alpha));
        colour += w * s.colour;
        weight += w, weighted_z += w * s.z;
        for (size_t c = 0; c < channels.size(); ++c)
          channels[c] += w * p.arrays[5][size_t(s.index) * channels.size() + c];
        if (t > 0.5 && t - w <= 0.5) median = s.z;
        t -= w;
      }
      colour += t * settings.background.cast<double>();
      for (int c = 0; c < 3; ++c) image.values.push_back(colour[c]);
      image.values.push_back(weight);
      image.values.push_back(weight > 0 ? weighted_z / weight : 0);
      image.values.push_back(median);
      image.values.insert(image.values.end(), channels.begin(), channels.end());
    }
  return image;
}

// --- scenes
// ----------------------------------------------------------------------------------------

Camera tiltedCamera(int width, int height) {
  Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = 0.9 * width, camera.fy = 0.95 * width;
  camera.cx = 0.46 * width, camera.cy = 0.55 * height;
  camera.world_from_camera = Eigen::Translation3d(0.3, -0.2, 0.1) *
                             Eigen::AngleAxisd(0.4, Eigen::Vector3d(1, 2, -0.5).normalized());
  return camera;
}

/// n anisotropic Gaussians in front of the camera, some outside the image or half behind.
Gaussians randomScene(int n, int degree, const Camera& camera, unsigned seed, double size = 0.12) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> unit(0, 1);
  std::normal_distribution<double> normal;
  Gaussians g;
  g.resize(n, degree);
  for (int i = 0; i < n; ++i) {
    const size_t s = size_t(i);
    const double z = 0.4 + 3 * unit(random);
    g.mean[s] = camera
                    .unproject(camera.width * (1.5 * unit(random) - 0.25),
                               camera.height * (1.5 * unit(random) - 0.25), z)
                    .cast<float>();
    for (int j = 0; j < 3; ++j)
      g.log_scale[s][j] = float(std::log(size * std::exp(0.7 * normal(random))));
    for (int j = 0; j < 4; ++j) g.rotation[s][j] = float(normal(random));
    g.opacity_logit[s] = float(2 * normal(random));
  }
  for (float& value : g.sh) value = float(0.4 * normal(random));
  return g;
}

Image normalImage(int width, int height, int channels, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal;
  Image image(width, height, channels);
  for (float& value : image.data) value = normal(random);
  return image;
}

/// One isotropic Gaussian of degree 0 on the optical axis, sigma metres, at depth z.
void addOnAxis(Gaussians* g, double z, double sigma, double opacity,
               const Eigen::Vector3f& colour) {
  Gaussians one;
  one.resize(1, 0);
  one.mean[0] = Eigen::Vector3f(0, 0, float(z));
  one.log_scale[0].setConstant(float(std::log(sigma)));
  one.opacity_logit[0] = float(std::log(opacity / (1 - opacity)));
  for (int c = 0; c < 3; ++c) one.sh[size_t(c)] = (colour[c] - 0.5f) / kSh0;
  appendRows(g, one);
}

Camera centredCamera() {
  Camera camera;
  camera.width = camera.height = 41;
  camera.fx = camera.fy = 60;
  camera.cx = camera.cy = 20.5;  // the centre of pixel (20, 20)
  return camera;
}

bool allFinite(const std::vector<float>& values) {
  return std::all_of(values.begin(), values.end(), [](float v) { return std::isfinite(v); });
}
template <typename Vector>
bool allFinite(const std::vector<Vector>& values) {
  return std::all_of(values.begin(), values.end(), [](const Vector& v) { return v.allFinite(); });
}
bool allFinite(const GaussianGradients& d) {
  return allFinite(d.mean) && allFinite(d.log_scale) && allFinite(d.rotation) &&
         allFinite(d.opacity_logit) && allFinite(d.sh) && allFinite(d.extra) &&
         d.camera.allFinite();
}

std::vector<double> flat(const GaussianGradients& d, int array) {
  std::vector<double> out;
  const auto take = [&](const auto& vectors) {
    for (const auto& v : vectors)
      for (int j = 0; j < v.size(); ++j) out.push_back(double(v[j]));
  };
  if (array == 0) take(d.mean);
  if (array == 1) take(d.log_scale);
  if (array == 2) take(d.rotation);
  if (array == 3) out.assign(d.opacity_logit.begin(), d.opacity_logit.end());
  if (array == 4) out.assign(d.sh.begin(), d.sh.end());
  if (array == 5) out.assign(d.extra.begin(), d.extra.end());
  if (array == 6) out.assign(d.camera.data(), d.camera.data() + 6);
  return out;
}

// --- against the reference
// -------------------------------------------------------------------------

void expectImagesAgree(const Gaussians& g, const Camera& camera, RasterSettings settings,
                       double least_cover = 0.3) {
  constexpr int kChannels = 3;
  const std::vector<float> values = normalImage(int(g.size()), 1, kChannels, 9).data;
  const ExtraChannels extra = {kChannels, values.data()};
  settings.median_depth = true;
  const RasterOutput out = rasterize(g, camera, settings, nullptr, extra);
  const ReferenceImage truth = renderReference(parametersOf(g, extra), camera, settings);
  double colour_error = 0, alpha_error = 0, depth_error = 0, channel_error = 0, covered = 0;
  int medians_differ = 0;
  for (int y = 0; y < camera.height; ++y)
    for (int x = 0; x < camera.width; ++x) {
      const double* t = &truth.values[size_t(y * camera.width + x) * (6 + kChannels)];
      for (int c = 0; c < 3; ++c)
        colour_error = std::max(colour_error, std::abs(double(out.colour.at(x, y, c)) - t[c]));
      alpha_error = std::max(alpha_error, std::abs(double(out.alpha.at(x, y, 0)) - t[3]));
      depth_error = std::max(depth_error, std::abs(double(out.depth.at(x, y, 0)) - t[4]));
      medians_differ += std::abs(double(out.median_depth.at(x, y, 0)) - t[5]) > 1e-5;
      for (int c = 0; c < kChannels; ++c)
        channel_error =
            std::max(channel_error, std::abs(double(out.channels.at(x, y, c)) - t[6 + c]));
      covered += t[3];
    }
  EXPECT_LT(colour_error, 1e-4);
  EXPECT_LT(alpha_error, 1e-4);
  EXPECT_LT(depth_error, 3e-4);    // metres; the image ends at 1e-4 transmittance
  EXPECT_LT(channel_error, 3e-4);  // values are up to 4
  EXPECT_EQ(medians_differ, 0);
  EXPECT_GE(covered, least_cover * camera.width * camera.height);
}

TEST(Rasterize, ImageMatchesReference) {
  RasterSettings settings;
  settings.background = {0.2f, 0.5f, 0.9f};
  for (int degree = 0; degree <= 3; ++degree) {
    settings.antialias = degree % 2;
    const Camera camera = tiltedCamera(75, 53);  // no multiple of a tile
    expectImagesAgree(randomScene(400, degree, camera, unsigned(1 + degree)), camera, settings);
  }
}

TEST(Rasterize, DenseImageMatchesReference) {  // many chunks a tile, blocks that end early
  const Camera camera = tiltedCamera(40, 33);
  expectImagesAgree(randomScene(5000, 0, camera, 5, 0.05), camera, RasterSettings());
}

enum class Loss { kColour, kAllBuiltIn, kEverything };  // colour; + alpha and depth; + the rest

/// All derivatives of sum(weights * image) against central differences of the reference.
void expectGradientsAgree(const Gaussians& g, const Camera& camera, RasterSettings settings,
                          Loss what, int channels = 3) {
  const int w = camera.width, h = camera.height;
  const bool everything = what == Loss::kEverything, built_in = what != Loss::kColour;
  if (!everything) channels = 0;
  const std::vector<float> values = normalImage(int(g.size()), 1, channels, 9).data;
  const ExtraChannels extra = {channels, values.data()};
  const Image d_colour = normalImage(w, h, 3, 11), d_alpha = normalImage(w, h, 1, 12),
              d_depth = normalImage(w, h, 1, 13), d_median = normalImage(w, h, 1, 14),
              d_channels = normalImage(w, h, channels, 15);
  settings.median_depth = everything;
  RasterStatePtr state;
  rasterize(g, camera, settings, &state, extra);
  BackwardExtras extras;
  extras.camera = true;
  extras.extra = extra;
  if (everything) extras.d_channels = &d_channels, extras.d_median_depth = &d_median;
  const GaussianGradients d =
      rasterizeBackward(g, camera, *state, d_colour, built_in ? &d_alpha : nullptr,
                        built_in ? &d_depth : nullptr, extras);
  const size_t stride = size_t(6 + channels);
  const auto loss = [&](const Parameters& p) {
    const ReferenceImage image = renderReference(p, camera, settings);
    double sum = 0;
    for (size_t i = 0; i < d_alpha.data.size(); ++i) {
      const double* pixel = &image.values[stride * i];
      for (size_t c = 0; c < 3; ++c) sum += double(d_colour.data[3 * i + c]) * pixel[c];
      if (built_in) sum += double(d_alpha.data[i]) * pixel[3] + double(d_depth.data[i]) * pixel[4];
      if (everything) sum += double(d_median.data[i]) * pixel[5];
      for (size_t c = 0; c < size_t(channels); ++c)
        sum += double(d_channels.data[size_t(channels) * i + c]) * pixel[6 + c];
    }
    return sum;
  };
  Parameters p = parametersOf(g, extra);
  for (int array = 0; array < kArrays; ++array) {
    const std::vector<double> ours = flat(d, array);
    ASSERT_EQ(ours.size(), p.arrays[array].size());
    std::vector<double> truth(ours.size());
    double square = 0;
    for (size_t i = 0; i < ours.size(); ++i) {
      double& value = p.arrays[array][i];
      const double at = value, step = 1e-6;
      value = at + step;
      const double above = loss(p);
      value = at - step;
      truth[i] = (above - loss(p)) / (2 * step);
      value = at;
      square += truth[i] * truth[i];
    }
    if (ours.empty()) continue;
    const double rms = std::sqrt(square / double(ours.size()));
    EXPECT_GT(rms, 1e-3) << kArrayNames[array];
    for (size_t i = 0; i < ours.size(); ++i)
      EXPECT_NEAR(ours[i], truth[i], 5e-3 * std::max(std::abs(truth[i]), 0.02 * rms))
          << kArrayNames[array] << " value " << i << ", rms " << rms;
  }
}

TEST(Rasterize, BackwardMatchesFiniteDifferences) {
  const Camera camera = tiltedCamera(35, 28);
  RasterSettings settings;
  settings.background = {0.3f, 0.1f, 0.7f};
  expectGradientsAgree(randomScene(40, 0, camera, 21), camera, settings, Loss::kColour);
}

TEST(Rasterize, BackwardMatchesFiniteDifferencesWithAlphaAndDepth) {
  const Camera camera = tiltedCamera(35, 28);
  expectGradientsAgree(randomScene(40, 0, camera, 22), camera, RasterSettings(), Loss::kAllBuiltIn);
}

TEST(Rasterize, BackwardMatchesFiniteDifferencesForEverySphericalHarmonic) {
  const Camera camera = tiltedCamera(20, 18);
  for (int degree = 1; degree <= 3; ++degree)
    expectGradientsAgree(randomScene(14, degree, camera, unsigned(30 + degree), 0.2), camera,
                         RasterSettings(), Loss::kAllBuiltIn);
}

TEST(Rasterize, BackwardMatchesFiniteDifferencesWithEveryOutput) {
  const Camera camera = tiltedCamera(20, 18);
  RasterSettings settings;
  settings.background = {0.3f, 0.1f, 0.7f};
  for (const bool antialias : {false, true})
    for (const int channels : {0, 1, 5, 19}) {
      settings.antialias = antialias;
      expectGradientsAgree(randomScene(14, 3, camera, unsigned(35 + channels), 0.2), camera,
                           settings, Loss::kEverything, channels);
    }
}

TEST(Rasterize, BackwardMatchesFiniteDifferencesWhereTheLowPassDims) {
  const Camera camera = tiltedCamera(24, 20);  // Gaussians of about a pixel
  RasterSettings settings;
  settings.antialias = true;
  Gaussians g = randomScene(60, 1, camera, 38, 0.04);
  for (float& logit : g.opacity_logit) logit += 3.f;
  expectGradientsAgree(g, camera, settings, Loss::kEverything);
}

TEST(Rasterize, EveryVectorWidthMatchesReference) {
  const Camera camera = tiltedCamera(27, 22);
  for (const int bits : {128, 256, 512}) {
    RasterSettings settings;
    settings.vector_bits = bits;
    settings.antialias = true;
    try {
      rasterize(Gaussians(), camera, settings);
    } catch (const Error&) {
      GTEST_LOG_(INFO) << "this CPU has no registers of " << bits << " bits";
      continue;
    }
    expectImagesAgree(randomScene(1000, 3, camera, 36, 0.08), camera, settings);
    expectGradientsAgree(randomScene(14, 2, camera, 37, 0.2), camera, settings, Loss::kEverything);
  }
}

TEST(Rasterize, NeedlesHaveTheRightGradient) {  // large off-diagonal terms of the conic
  const Camera camera = tiltedCamera(40, 40);
  Gaussians g = randomScene(12, 0, camera, 41);
  for (auto& s : g.log_scale) s = {std::log(0.4f), std::log(0.01f), std::log(0.02f)};
  expectGradientsAgree(g, camera, RasterSettings(), Loss::kEverything);
}

// --- closed forms
// ----------------------------------------------------------------------------------

TEST(Rasterize, OneGaussianIsItsClosedForm) {
  const Camera camera = centredCamera();
  RasterSettings settings;
  settings.background = {0.f, 0.25f, 1.f};
  Gaussians g;
  const Eigen::Vector3f colour(0.9f, 0.4f, 0.1f);
  const double z = 2, sigma = 0.1, opacity = 0.8;
  addOnAxis(&g, z, sigma, opacity, colour);
  const RasterOutput out = rasterize(g, camera, settings);
  const double variance = std::pow(60 * sigma / z, 2) + 0.3;
  EXPECT_NEAR(out.alpha.at(20, 20, 0), opacity, 1e-5);
  for (int y = 0; y < 41; ++y)
    for (int x = 0; x < 41; ++x) {
      const double r2 = (x - 20) * (x - 20) + (y - 20) * (y - 20);
      double alpha = opacity * std::exp(-0.5 * r2 / variance);
      if (alpha < 1. / 255) alpha = 0;
      ASSERT_NEAR(out.alpha.at(x, y, 0), alpha, 1e-5) << x << " " << y;
      for (int c = 0; c < 3; ++c)
        ASSERT_NEAR(out.colour.at(x, y, c),
                    alpha * double(colour[c]) + (1 - alpha) * double(settings.background[c]), 1e-5);
      ASSERT_NEAR(out.depth.at(x, y, 0), alpha > 0 ? z : 0, 1e-5);
    }
}

TEST(Rasterize, TheNearerOneIsInFrontWhateverTheOrder) {
  const Camera camera = centredCamera();
  RasterSettings settings;
  settings.background = {0.1f, 0.2f, 0.3f};
  const Eigen::Vector3f red(1, 0, 0), green(0, 1, 0);
  Gaussians near_first, far_first;
  addOnAxis(&near_first, 1, 0.1, 0.6, red);
  addOnAxis(&near_first, 3, 0.3, 0.7, green);
  addOnAxis(&far_first, 3, 0.3, 0.7, green);
  addOnAxis(&far_first, 1, 0.1, 0.6, red);
  for (const Gaussians& g : {near_first, far_first}) {
    const RasterOutput out = rasterize(g, camera, settings);
    for (int c = 0; c < 3; ++c)
      EXPECT_NEAR(out.colour.at(20, 20, c),
                  0.6f * red[c] + 0.4f * 0.7f * green[c] + 0.4f * 0.3f * settings.background[c],
                  1e-5f);
    EXPECT_NEAR(out.alpha.at(20, 20, 0), 1 - 0.4 * 0.3, 1e-5);
    EXPECT_NEAR(out.depth.at(20, 20, 0), (0.6 * 1 + 0.28 * 3) / 0.88, 1e-5);
  }
}

TEST(Rasterize, NothingIsBackground) {
  RasterSettings settings;
  settings.background = {0.1f, 0.2f, 0.3f};
  for (int side : {1, 16, 37}) {
    Camera camera = tiltedCamera(side, side);
    RasterStatePtr state;
    const Gaussians none;
    const RasterOutput out = rasterize(none, camera, settings, &state);
    for (size_t i = 0; i < out.alpha.data.size(); ++i) {
      for (size_t c = 0; c < 3; ++c)
        EXPECT_EQ(out.colour.data[3 * i + c], settings.background[int(c)]);
      EXPECT_EQ(out.alpha.data[i], 0.f);
      EXPECT_EQ(out.depth.data[i], 0.f);
    }
    EXPECT_TRUE(rasterizeBackward(none, camera, *state, Image(side, side, 3, 1.f)).mean.empty());
  }
}

TEST(Rasterize, OnePixelImage) {
  Camera camera = centredCamera();
  camera.width = camera.height = 1;
  camera.cx = camera.cy = 0.5;
  Gaussians g;
  addOnAxis(&g, 1, 0.05, 0.5, {1, 1, 1});
  RasterStatePtr state;
  const RasterOutput out = rasterize(g, camera, RasterSettings(), &state);
  EXPECT_NEAR(out.colour.at(0, 0, 0), 0.5, 1e-5);
  const GaussianGradients d = rasterizeBackward(g, camera, *state, Image(1, 1, 3, 1.f));
  EXPECT_NEAR(d.opacity_logit[0], 3 * 0.5 * 0.5, 1e-5);  // d(3 alpha) / dlogit = 3 o (1 - o)
  EXPECT_NEAR(d.sh[0], 0.5 * double(kSh0), 1e-5);
}

TEST(Rasterize, ColoursBelowBlackAreBlackWithoutGradient) {
  const Camera camera = centredCamera();
  Gaussians g;
  addOnAxis(&g, 1, 0.1, 0.5, {-0.2f, 0.3f, -3.f});
  RasterStatePtr state;
  const RasterOutput out = rasterize(g, camera, RasterSettings(), &state);
  EXPECT_EQ(out.colour.at(20, 20, 0), 0.f);
  EXPECT_NEAR(out.colour.at(20, 20, 1), 0.15f, 1e-5f);
  const GaussianGradients d = rasterizeBackward(g, camera, *state, Image(41, 41, 3, 1.f));
  EXPECT_EQ(d.sh[0], 0.f);
  EXPECT_GT(d.sh[1], 0.f);
  EXPECT_EQ(d.sh[2], 0.f);
}

TEST(Rasterize, FarFromTheOriginIsAsGoodAsNear) {
  const Camera camera = tiltedCamera(40, 30);
  const Gaussians g = randomScene(100, 1, camera, 51);
  Camera moved = camera;
  Gaussians far = g;
  const Eigen::Vector3d shift(512, -256, 128);  // floats there step by 6e-5 m
  moved.world_from_camera = Eigen::Translation3d(shift) * camera.world_from_camera;
  for (auto& m : far.mean) m = (m.cast<double>() + shift).cast<float>();
  expectImagesAgree(far, moved, RasterSettings());
}

// --- laws
// ------------------------------------------------------------------------------------------

bool sameBytes(const std::vector<float>& a, const std::vector<float>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * 4) == 0;
}

/// Every output and gradient of one scene, everything asked for.
struct Everything {
  RasterOutput out;
  GaussianGradients d;
};
Everything runEverything(const Gaussians& g, const Camera& camera, int channels = 3,
                         int vector_bits = 0) {
  const int w = camera.width, h = camera.height;
  const std::vector<float> values = normalImage(int(g.size()), 1, channels, 9).data;
  const Image d_colour = normalImage(w, h, 3, 1), d_depth = normalImage(w, h, 1, 2),
              d_alpha = normalImage(w, h, 1, 3), d_median = normalImage(w, h, 1, 4),
              d_channels = normalImage(w, h, channels, 5);
  RasterSettings settings;
  settings.median_depth = settings.antialias = true;
  settings.vector_bits = vector_bits;
  RasterStatePtr state;
  BackwardExtras extras;
  extras.extra = {channels, values.data()};
  extras.d_channels = &d_channels, extras.d_median_depth = &d_median, extras.camera = true;
  Everything all;
  all.out = rasterize(g, camera, settings, &state, extras.extra);
  all.d = rasterizeBackward(g, camera, *state, d_colour, &d_alpha, &d_depth, extras);
  return all;
}
bool allFinite(const RasterOutput& out) {
  return allFinite(out.colour.data) && allFinite(out.alpha.data) && allFinite(out.depth.data) &&
         allFinite(out.median_depth.data) && allFinite(out.channels.data);
}

TEST(Rasterize, SameBytesForAnyNumberOfThreads) {
  const Camera camera = tiltedCamera(150, 110);
  const Gaussians g = randomScene(30000, 1, camera, 61, 0.03);
  const auto run = [&](size_t threads) {
    tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads);
    return runEverything(g, camera);
  };
  const Everything one = run(1);
  for (size_t threads : {2, 3, 5}) {
    const Everything many = run(threads);
    EXPECT_TRUE(sameBytes(one.out.colour.data, many.out.colour.data));
    EXPECT_TRUE(sameBytes(one.out.alpha.data, many.out.alpha.data));
    EXPECT_TRUE(sameBytes(one.out.depth.data, many.out.depth.data));
    EXPECT_TRUE(sameBytes(one.out.median_depth.data, many.out.median_depth.data));
    EXPECT_TRUE(sameBytes(one.out.channels.data, many.out.channels.data));
    EXPECT_EQ(one.d.mean, many.d.mean);
    EXPECT_EQ(one.d.log_scale, many.d.log_scale);
    EXPECT_EQ(one.d.rotation, many.d.rotation);
    EXPECT_TRUE(sameBytes(one.d.opacity_logit, many.d.opacity_logit));
    EXPECT_TRUE(sameBytes(one.d.sh, many.d.sh));
    EXPECT_TRUE(sameBytes(one.d.extra, many.d.extra));
    EXPECT_EQ(one.d.camera, many.d.camera);
  }
}

TEST(Rasterize, MoreOutputsDoNotChangeTheOthers) {
  const Camera camera = tiltedCamera(60, 50);
  const Gaussians g = randomScene(2000, 1, camera, 63);
  RasterSettings settings;
  const RasterOutput plain = rasterize(g, camera, settings);
  EXPECT_TRUE(plain.median_depth.data.empty() && plain.channels.data.empty());
  settings.median_depth = true;
  const std::vector<float> ones(size_t(g.size()), 1.f);
  const RasterOutput more = rasterize(g, camera, settings, nullptr, {1, ones.data()});
  EXPECT_TRUE(sameBytes(plain.colour.data, more.colour.data));
  EXPECT_TRUE(sameBytes(plain.depth.data, more.depth.data));
  EXPECT_TRUE(sameBytes(plain.alpha.data, more.channels.data));  // ones blend to alpha
  for (size_t i = 0; i < plain.alpha.data.size(); ++i) {
    if (std::abs(plain.alpha.data[i] - 0.5f) < 1e-5f) continue;
    EXPECT_EQ(more.median_depth.data[i] > 0, plain.alpha.data[i] > 0.5f);
  }
}

TEST(Rasterize, DepthOrderSurvivesEveryListLength) {  // the sort changes its way with the length
  const Camera camera = tiltedCamera(16, 16);
  for (int n : {1, 2, 63, 64, 65, 3000}) {
    Gaussians g = randomScene(n, 0, camera, 64, 0.3);
    for (float& logit : g.opacity_logit) logit = -3.f;
    if (n > 100)  // most at almost one depth, one much nearer: leading bits alone do not tell
      for (size_t i = 1; i < size_t(n); ++i)
        g.mean[i] = camera.unproject(8, 8, 3 + 1e-6 * double((i * 7919) % size_t(n))).cast<float>();
    expectImagesAgree(g, camera, RasterSettings(), 0);
  }
}

TEST(Rasterize, EveryImageSize) {
  for (const auto& [w, h] :
       {std::pair{1, 1}, {1, 300}, {300, 1}, {17, 15}, {8192, 3}, {8192, 8192}}) {
    const Camera camera = tiltedCamera(w, h);
    Gaussians g = randomScene(40, 0, camera, 65);
    const bool large = w * h > 1 << 20;
    RasterStatePtr state;
    const RasterOutput out = rasterize(g, camera, RasterSettings(), &state);
    EXPECT_TRUE(allFinite(out));
    EXPECT_EQ(out.colour.data.size(), size_t(w) * size_t(h) * 3);
    EXPECT_TRUE(allFinite(rasterizeBackward(g, camera, *state, Image(w, h, 3, 1.f))));
    if (!large) {
      EXPECT_TRUE(allFinite(runEverything(g, camera).d));
    }
  }
}

TEST(Rasterize, VectorWidthsAgree) {
  const Camera camera = tiltedCamera(90, 70);
  const Gaussians g = randomScene(3000, 3, camera, 66, 0.06);
  const Everything truth = runEverything(g, camera, 3, 128);
  for (const int bits : {256, 512}) {
    Everything other;
    try {
      other = runEverything(g, camera, 3, bits);
    } catch (const Error&) {
      continue;  // not on this CPU
    }
    const auto worst = [](const std::vector<float>& a, const std::vector<float>& b) {
      double error = 0, square = 0;
      for (size_t i = 0; i < a.size(); ++i) {
        error = std::max(error, std::abs(double(a[i]) - double(b[i])));
        square += double(a[i]) * double(a[i]);
      }
      return error / std::sqrt(square / double(a.size()));
    };
    EXPECT_LT(worst(truth.out.colour.data, other.out.colour.data), 1e-4) << bits;
    EXPECT_LT(worst(truth.out.alpha.data, other.out.alpha.data), 1e-4) << bits;
    EXPECT_LT(worst(truth.out.channels.data, other.out.channels.data), 1e-4) << bits;
    EXPECT_LT((truth.d.camera - other.d.camera).norm(), 1e-3 * truth.d.camera.norm()) << bits;
    EXPECT_LT(worst(truth.d.sh, other.d.sh), 0.01) << bits;  // a pixel may cross min_alpha
    EXPECT_LT(worst(truth.d.extra, other.d.extra), 0.01) << bits;
  }
  EXPECT_THROW(runEverything(g, camera, 3, 64), Error);
}

TEST(Rasterize, OpacityOneIsOpaque) {
  const Camera camera = centredCamera();
  Gaussians g;
  addOnAxis(&g, 1, 0.2, 0.5, {1, 1, 1});
  g.opacity_logit[0] = std::numeric_limits<float>::infinity();
  const Everything all = runEverything(g, camera);
  EXPECT_NEAR(all.out.alpha.at(20, 20, 0), 0.99f, 1e-4f);
  EXPECT_TRUE(allFinite(all.d));
  EXPECT_EQ(all.d.opacity_logit[0], 0.f);
}

TEST(Rasterize, AntialiasingKeepsTheLightOfThinGaussians) {
  // A Gaussian much smaller than a pixel: the low-pass alone would show it as wide as
  // sqrt(low_pass) whatever its size; compensated, its summed alpha goes with its area.
  const Camera camera = centredCamera();
  RasterSettings settings;
  settings.antialias = true;
  settings.min_alpha = 1e-6f;
  for (const double sigma : {0.002, 0.004, 0.05}) {
    Gaussians g;
    addOnAxis(&g, 2, sigma, 0.6, {1, 1, 1});
    double sum = 0;
    for (float a : rasterize(g, camera, settings).alpha.data) sum += double(a);
    const double variance = std::pow(60 * sigma / 2, 2);
    // integral of o sqrt(det / det_with) exp(..) = o 2 pi sqrt(det)
    // sampled at pixel centres, of a kernel no narrower than sigma = sqrt(.3)
    EXPECT_NEAR(sum, 0.6 * variance / (variance + 0.3) * 2 * M_PI * (variance + 0.3),
                0.02 * 0.6 * 2 * M_PI * variance * (1 + 0.3))
        << sigma;
  }
}

TEST(Rasterize, SavingStateDoesNotChangeTheImage) {
  const Camera camera = tiltedCamera(50, 50);
  const Gaussians g = randomScene(500, 0, camera, 62);
  RasterStatePtr state;
  EXPECT_TRUE(sameBytes(rasterize(g, camera, RasterSettings(), &state).colour.data,
                        rasterize(g, camera, RasterSettings()).colour.data));
}

TEST(Rasterize, DegenerateGaussiansContributeNothing) {
  const Camera camera = tiltedCamera(40, 40);
  const RasterSettings settings;
  const Gaussians clean = randomScene(50, 1, camera, 71);
  const RasterOutput truth = rasterize(clean, camera, settings);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const float infinity = std::numeric_limits<float>::infinity();
  const auto inFront = [&](double z) { return camera.unproject(20, 20, z).cast<float>().eval(); };
  const std::vector<std::function<void(Gaussians&)>> spoils = {
      [&](Gaussians& g) { g.rotation[0].setZero(); },
      [&](Gaussians& g) { g.rotation[0].setConstant(1e30f); },
      [&](Gaussians& g) { g.rotation[0][2] = nan; },
      [&](Gaussians& g) { g.mean[0][1] = nan; },
      [&](Gaussians& g) { g.mean[0][1] = infinity; },
      [&](Gaussians& g) { g.mean[0] = inFront(1e30); },
      [&](Gaussians& g) { g.mean[0] = inFront(0); },
      [&](Gaussians& g) { g.mean[0] = inFront(-1); },
      [&](Gaussians& g) { g.mean[0] = inFront(0.04); },
      [&](Gaussians& g) { g.log_scale[0][0] = nan; },
      [&](Gaussians& g) { g.log_scale[0].setConstant(infinity); },
      [&](Gaussians& g) { g.log_scale[0].setConstant(80.f); },
      [&](Gaussians& g) { g.opacity_logit[0] = nan; },
      [&](Gaussians& g) { g.opacity_logit[0] = -infinity; },
      [&](Gaussians& g) { g.opacity_logit[0] = -1e30f; },
      [&](Gaussians& g) { g.sh[0] = nan; },
      [&](Gaussians& g) { g.sh[4] = infinity; },
  };
  for (size_t k = 0; k < spoils.size(); ++k) {
    Gaussians g;
    g.resize(1, 1);
    g.mean[0] = inFront(1);
    g.log_scale[0].setConstant(-2.f);
    g.opacity_logit[0] = 1.f;
    spoils[k](g);
    appendRows(&g, clean);
    EXPECT_TRUE(sameBytes(rasterize(g, camera, settings).colour.data, truth.colour.data))
        << "case " << k;
    const auto [out, d] = runEverything(g, camera);
    EXPECT_TRUE(allFinite(out) && allFinite(d)) << "case " << k;
    EXPECT_EQ(d.mean[0], Eigen::Vector3f::Zero()) << "case " << k;
    EXPECT_EQ(d.opacity_logit[0], 0.f) << "case " << k;
  }
}

TEST(Rasterize, ExtremeGaussiansStayFinite) {
  const Camera camera = tiltedCamera(40, 40);
  for (float log_scale : {-200.f, -30.f, 0.f, 5.f, 12.f, 20.f, 40.f})
    for (float logit : {-5.4f, 0.f, 15.f, 200.f, std::numeric_limits<float>::infinity()})
      for (double z : {0.050001, 1., 1e6}) {
        Gaussians g = randomScene(20, 1, camera, 72);
        Gaussians more;
        more.resize(3, 1);
        for (size_t i = 0; i < 3; ++i) {
          more.mean[i] = camera.unproject(i == 2 ? 4000 : 20, 20, z).cast<float>();
          more.log_scale[i] = {log_scale, i == 1 ? -4.f : log_scale, log_scale};
          more.rotation[i] = {1e-15f, 2e-15f, -1e-15f, 3e-15f};
          more.opacity_logit[i] = logit;
        }
        appendRows(&g, more);
        const Everything all = runEverything(g, camera);  // antialiased
        EXPECT_TRUE(allFinite(all.out) && allFinite(all.d))
            << log_scale << " " << logit << " " << z;
        RasterStatePtr state;
        EXPECT_TRUE(allFinite(rasterize(g, camera, RasterSettings(), &state)));
        const Image ones(40, 40, 1, 1.f);
        EXPECT_TRUE(
            allFinite(rasterizeBackward(g, camera, *state, Image(40, 40, 3, 1.f), &ones, &ones)))
            << log_scale << " " << logit << " " << z;
      }
}

TEST(Rasterize, BrokenLossGivesFiniteGradients) {
  const Camera camera = tiltedCamera(40, 40);
  const Gaussians g = randomScene(50, 0, camera, 73);
  RasterStatePtr state;
  rasterize(g, camera, RasterSettings(), &state);
  Image d(40, 40, 3, 1.f);
  d.at(20, 20, 1) = std::numeric_limits<float>::quiet_NaN();
  d.at(3, 5, 0) = std::numeric_limits<float>::infinity();
  BackwardExtras extras;
  extras.camera = true;
  EXPECT_TRUE(allFinite(rasterizeBackward(g, camera, *state, d, nullptr, nullptr, extras)));
}

TEST(Rasterize, GaussiansWithBrokenChannelsContributeNothing) {
  const Camera camera = tiltedCamera(40, 40);
  const Gaussians clean = randomScene(50, 0, camera, 75);
  Gaussians g = clean;
  appendRows(&g, randomScene(2, 0, camera, 76));
  std::vector<float> values = normalImage(52, 2, 1, 77).data;
  values[101] = std::numeric_limits<float>::quiet_NaN();
  values[102] = std::numeric_limits<float>::infinity();
  RasterStatePtr state;
  BackwardExtras extras;
  extras.extra = {2, values.data()};
  const RasterOutput out = rasterize(g, camera, RasterSettings(), &state, extras.extra);
  EXPECT_TRUE(sameBytes(out.colour.data, rasterize(clean, camera, RasterSettings()).colour.data));
  EXPECT_TRUE(allFinite(out));
  const Image d_channels(40, 40, 2, 1.f);
  extras.d_channels = &d_channels;
  EXPECT_TRUE(allFinite(
      rasterizeBackward(g, camera, *state, Image(40, 40, 3, 1.f), nullptr, nullptr, extras)));
}

TEST(Rasterize, MismatchesThrow) {
  const Camera camera = tiltedCamera(40, 40);
  Gaussians g = randomScene(5, 0, camera, 74);
  RasterStatePtr state;
  rasterize(g, camera, RasterSettings(), &state);
  EXPECT_THROW(rasterizeBackward(g, camera, *state, Image(40, 39, 3)), Error);
  EXPECT_THROW(rasterizeBackward(g, camera, *state, Image(40, 40, 1)), Error);
  const Image wide(41, 40, 1);
  EXPECT_THROW(rasterizeBackward(g, camera, *state, Image(40, 40, 3), &wide), Error);
  EXPECT_THROW(rasterizeBackward(g, camera, *state, Image(40, 40, 3), nullptr, &wide), Error);
  BackwardExtras extras;
  const Image two(40, 40, 2);
  extras.d_channels = &two;
  EXPECT_THROW(rasterizeBackward(g, camera, *state, Image(40, 40, 3), nullptr, nullptr, extras),
               Error);
  EXPECT_THROW(rasterize(g, camera, RasterSettings(), nullptr, {2, nullptr}), Error);
  Gaussians fewer = randomScene(4, 0, camera, 74);
  EXPECT_THROW(rasterizeBackward(fewer, camera, *state, Image(40, 40, 3)), Error);
  Camera bad = camera;
  bad.width = 0;
  EXPECT_THROW(rasterize(g, bad, RasterSettings()), Error);
  bad = camera, bad.fx = std::nan("");
  EXPECT_THROW(rasterize(g, bad, RasterSettings()), Error);
  RasterSettings settings;
  settings.min_alpha = 0;
  EXPECT_THROW(rasterize(g, camera, settings), Error);
  g.sh.pop_back();
  EXPECT_THROW(rasterize(g, camera, RasterSettings()), Error);
}

TEST(Gaussians, AppendConcatenatesAndChecks) {
  Gaussians a = randomScene(3, 1, tiltedCamera(8, 8), 81);
  const Gaussians b = randomScene(2, 1, tiltedCamera(8, 8), 82);
  const Gaussians a0 = a;
  appendRows(&a, b);
  ASSERT_EQ(a.size(), 5);
  EXPECT_EQ(a.mean[1], a0.mean[1]);
  EXPECT_EQ(a.rotation[3], b.rotation[0]);
  EXPECT_EQ(a.sh[size_t(4 * 12 + 7)], b.sh[12 + 7]);
  appendRows(&a, a);
  EXPECT_EQ(a.size(), 10);
  EXPECT_EQ(a.log_scale[9], b.log_scale[1]);
  EXPECT_THROW(appendRows(&a, randomScene(1, 0, tiltedCamera(8, 8), 83)), Error);
  a.opacity_logit.pop_back();
  EXPECT_THROW(requireConsistent(a), Error);
}

}  // namespace
}  // namespace vdbc
