#include "splat/fit.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>

#include "splat/rasterize.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

constexpr float kColourKnee = .05f;  // residuals beyond count linearly
constexpr float kDepthKnee = .02f;   // share of the depth
constexpr float kAlphaLoss = .1f, kDepthLoss = .02f;
constexpr float kBeta1 = .9f, kBeta2 = .99f;
// Adam's rates at the start; they fall to a tenth. Means: in units of a Gaussian's largest sigma.
constexpr float kMeanRate = .08f, kScaleRate = .1f, kRotationRate = .005f, kOpacityRate = .05f,
                kColourRate = .002f / kSh0;
constexpr float kLargestGrowth = .4f;  // of a logarithm of sigma
constexpr int kHeldBack = 10;          // one block of 2 x 2 pixels in so many
constexpr int kRound = 20;             // steps, at least, between looks at what is held back
constexpr double kLeastGain = .995;    // of its error: a round that brings less is the last
constexpr double kLastRate = .1;       // of the first

// A view at one of the resolutions that fitting looks at.
struct Target {
  Camera camera;
  Image reduced;              // what `colour` is where it is not the view's own
  const Image* colour;        // [H, W, 3]
  std::vector<float> weight;  // [H * W]
  std::vector<float> depth;   // [H * W] measured ones, metres; 0 elsewhere
  std::vector<uint8_t> held;  // [H * W] 1: only looked at to judge
};

// Exposure of a view: what it shows is gain * rendered + offset.
struct Exposure {
  Eigen::Array3f gain = Eigen::Array3f::Ones(), offset = Eigen::Array3f::Zero();
};

Target targetOf(const SeenImage& image, int divisor, std::mt19937_64* random) {
  Target t;
  const int w = image.width() / divisor, h = image.height() / divisor;
  t.camera = resized(image.view.camera, w, h);
  if (divisor > 1) t.reduced = resizeImage(image.view.colour, w, h);
  t.weight.resize(size_t(w) * size_t(h));
  t.depth.resize(t.weight.size());
  t.held.resize(t.weight.size());
  std::vector<uint8_t> blocks(size_t((w + 1) / 2) * size_t((h + 1) / 2));
  for (uint8_t& b : blocks) b = (*random)() % kHeldBack == 0;
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x) {
      const size_t to = size_t(y) * size_t(w) + size_t(x);
      const size_t from = image.pixel(x * divisor, y * divisor);
      t.weight[to] = image.weight[from];
      t.depth[to] = image.weight[from] == 1 ? 1 / image.q[from] : 0;
      t.held[to] = blocks[size_t(y / 2) * size_t((w + 1) / 2) + size_t(x / 2)];
    }
  return t;
}

// Derivatives of the loss by what was rendered; returns the squared error of held-back pixels.
struct Derivatives {
  Image colour, alpha, depth;
};
Derivatives derivativesOf(const Target& t, const RasterOutput& r, const Exposure& e) {
  const int w = t.camera.width, h = t.camera.height;
  Derivatives d{Image(w, h, 3), Image(w, h, 1), Image(w, h, 1)};
  tbb::parallel_for(0, h, [&](int y) {
    for (int x = 0; x < w; ++x) {
      const size_t i = size_t(y) * size_t(w) + size_t(x);
      if (!(t.weight[i] > 0) || t.held[i]) continue;
      for (size_t c = 0; c < 3; ++c) {
        const float error = e.gain[int(c)] * r.colour.data[3 * i + c] + e.offset[int(c)] -
                            t.colour->data[3 * i + c];
        const float scaled = error / kColourKnee;
        d.colour.data[3 * i + c] =
            t.weight[i] * e.gain[int(c)] * error / std::sqrt(1 + scaled * scaled);
      }
      d.alpha.data[i] = -2 * kAlphaLoss * t.weight[i] * (1 - r.alpha.data[i]);
      if (t.depth[i] > 0 && r.alpha.data[i] > .5f) {
        const float error = (r.depth.data[i] - t.depth[i]) / (t.depth[i] * kDepthKnee);
        d.depth.data[i] = kDepthLoss / t.depth[i] * error / std::sqrt(1 + error * error);
      }
    }
  });
  return d;
}

// The least squares between what is rendered and what was seen, held near none at all.
Exposure exposureOf(const Target& t, const RasterOutput& r) {
  Exposure e;
  for (int c = 0; c < 3; ++c) {
    double n = 0, x = 0, xx = 0, y = 0, xy = 0;
    for (size_t i = 0; i < t.weight.size(); ++i) {
      if (t.weight[i] != 1 || r.alpha.data[i] < .9f) continue;
      const double a = r.colour.data[3 * i + size_t(c)], b = t.colour->data[3 * i + size_t(c)];
      if (std::abs(a - b) > .2) continue;
      n += 1, x += a, xx += a * a, y += b, xy += a * b;
    }
    if (n < 100) continue;
    // A prior as strong as a twentieth of the pixels at a contrast of a quarter.
    const double prior = .05 * n / 16;
    const double var = xx - x * x / n, cov = xy - x * y / n;
    const double gain = std::clamp((cov + prior) / (var + prior), .5, 2.);
    e.gain[c] = float(gain), e.offset[c] = float((y - gain * x) / n);
  }
  return e;
}

// Only differences between views can be known.
void centre(std::vector<Exposure>* exposures) {
  Exposure mean;
  mean.gain.setZero();
  for (const Exposure& e : *exposures) mean.gain += e.gain.log(), mean.offset += e.offset;
  const float n = float(exposures->size());
  mean.gain = (mean.gain / n).exp(), mean.offset /= n;
  for (Exposure& e : *exposures) e.gain /= mean.gain, e.offset -= mean.offset;
}

// First and second moments of a row of parameters.
template <int N>
struct Moments {
  std::vector<Eigen::Matrix<float, N, 1>> first, second;
  explicit Moments(size_t n)
      : first(n, Eigen::Matrix<float, N, 1>::Zero()),
        second(n, Eigen::Matrix<float, N, 1>::Zero()) {}

  template <typename Parameter, typename Gradient>
  void step(size_t i, float rate, float correction, Parameter&& parameter, const Gradient& g) {
    first[i] = kBeta1 * first[i] + (1 - kBeta1) * g;
    second[i] = kBeta2 * second[i] + (1 - kBeta2) * g.cwiseProduct(g);
    parameter -=
        (rate * correction * first[i].array() / (second[i].array().sqrt() + 1e-12f)).matrix();
  }
};

class Adam {
 public:
  explicit Adam(Gaussians* g)
      : g_(*g),
        mean_(n()),
        scale_(n()),
        rotation_(n()),
        opacity_(n()),
        colour_(n()),
        steps_(n()),
        largest_(n()),
        start_(g->log_scale) {
    for (size_t i = 0; i < n(); ++i) largest_[i] = std::exp(g->log_scale[i].maxCoeff());
  }

  // `decay` scales all rates. Only Gaussians that the view saw move.
  void step(const GaussianGradients& d, float decay) {
    tbb::parallel_for(tbb::blocked_range<size_t>(0, n(), 1024), [&](const auto& range) {
      for (size_t i = range.begin(); i < range.end(); ++i) stepRow(d, decay, i);
    });
  }

 private:
  using Vector1 = Eigen::Matrix<float, 1, 1>;
  size_t n() const { return g_.mean.size(); }

  void stepRow(const GaussianGradients& d, float decay, size_t i) {
    const auto colour_gradient = Eigen::Map<const Eigen::Vector3f>(&d.sh[3 * i]);
    if (d.opacity_logit[i] == 0 && colour_gradient.isZero(0)) return;
    const int t = ++steps_[i];
    const float correction =
        std::sqrt(1 - std::pow(kBeta2, float(t))) / (1 - std::pow(kBeta1, float(t)));
    mean_.step(i, decay * kMeanRate * largest_[i], correction, g_.mean[i], d.mean[i]);
    scale_.step(i, decay * kScaleRate, correction, g_.log_scale[i], d.log_scale[i]);
    g_.log_scale[i] = g_.log_scale[i].cwiseMin((start_[i].array() + kLargestGrowth).matrix());
    rotation_.step(i, decay * kRotationRate, correction, g_.rotation[i], d.rotation[i]);
    opacity_.step(i, decay * kOpacityRate, correction, Eigen::Map<Vector1>(&g_.opacity_logit[i]),
                  Eigen::Map<const Vector1>(&d.opacity_logit[i]));
    colour_.step(i, decay * kColourRate, correction, Eigen::Map<Eigen::Vector3f>(&g_.sh[3 * i]),
                 colour_gradient);
  }

  Gaussians& g_;
  Moments<3> mean_, scale_;
  Moments<4> rotation_;
  Moments<1> opacity_;
  Moments<3> colour_;
  std::vector<int> steps_;
  std::vector<float> largest_;
  std::vector<Eigen::Vector3f> start_;
};

// One resolution of all views. Its pictures may be those of `images`.
std::vector<Target> targetsOf(const std::vector<SeenImage>& images, int divisor,
                              std::mt19937_64* random) {
  std::vector<Target> targets;
  for (const SeenImage& image : images) targets.push_back(targetOf(image, divisor, random));
  for (size_t i = 0; i < images.size(); ++i)
    targets[i].colour = divisor > 1 ? &targets[i].reduced : &images[i].view.colour;
  return targets;
}

// Mean squared error of colour over the pixels that are held back.
class HeldBack {
 public:
  void add(const Target& t, const RasterOutput& r, const Exposure& e) {
    for (size_t i = 0; i < t.weight.size(); ++i) {
      if (!t.held[i] || t.weight[i] != 1) continue;
      for (size_t c = 0; c < 3; ++c) {
        const double error = double(e.gain[int(c)] * r.colour.data[3 * i + c] + e.offset[int(c)] -
                                    t.colour->data[3 * i + c]);
        sum_ += error * error;
      }
      ++pixels_;
    }
  }
  // Since the last time.
  double take() {
    const double mean = sum_ / double(std::max<int64_t>(1, 3 * pixels_));
    sum_ = 0, pixels_ = 0;
    return mean;
  }

 private:
  double sum_ = 0;
  int64_t pixels_ = 0;
};

class Fit {
 public:
  Fit(const std::vector<SeenImage>& images, const FitSettings& settings, Gaussians* gaussians)
      : images_(images),
        settings_(settings),
        g_(gaussians),
        adam_(gaussians),
        random_(settings.seed),
        exposures_(images.size()),
        order_(images.size()) {
    std::iota(order_.begin(), order_.end(), size_t(0));
    raster_.antialias = gaussians->antialias;
  }

  // Large pictures are fitted at half their size first.
  int run() {
    if (images_[0].width() > kCoarseFrom) phase(2, int(kCoarseShare * settings_.steps));
    phase(1, settings_.steps);
    return steps_;
  }

 private:
  // Until `end` steps are taken in all or, the views taken in turns, a round brings no more to the
  // pixels held back; a last round at the lowest rates then lets everything settle.
  void phase(int divisor, int end) {
    const std::vector<Target> targets = targetsOf(images_, divisor, &random_);
    const int n = int(targets.size()), round = (kRound + n - 1) / n * n;
    HeldBack held;
    double best = 1e30;
    bool settling = false;
    for (int taken = 0; steps_ < end; ++taken) {
      if (taken % n == 0) std::shuffle(order_.begin(), order_.end(), random_);
      const double done = settling ? 1 : double(steps_) / settings_.steps;
      step(targets, order_[size_t(taken % n)], float(std::pow(kLastRate, done)), &held);
      if ((taken + 1) % round != 0) continue;
      const double now = held.take();
      if (settling) return;
      settling = now > best * kLeastGain;
      if (settling && divisor > 1) return;
      best = now;
    }
  }

  void step(const std::vector<Target>& targets, size_t view, float decay, HeldBack* held) {
    const Target& target = targets[view];
    RasterStatePtr state;
    const RasterOutput rendered = rasterize(*g_, target.camera, raster_, &state);
    if (images_.size() > 1 && steps_ >= int(images_.size())) {
      exposures_[view] = exposureOf(target, rendered);
      centre(&exposures_);
    }
    held->add(target, rendered, exposures_[view]);
    const Derivatives d = derivativesOf(target, rendered, exposures_[view]);
    adam_.step(rasterizeBackward(*g_, target.camera, *state, d.colour, &d.alpha, &d.depth), decay);
    ++steps_;
    if (settings_.progress) report(*settings_.progress, 100 * steps_ / settings_.steps);
  }

  const std::vector<SeenImage>& images_;
  const FitSettings& settings_;
  Gaussians* g_;
  Adam adam_;
  std::mt19937_64 random_;
  std::vector<Exposure> exposures_;
  std::vector<size_t> order_;
  RasterSettings raster_;
  int steps_ = 0;
};

}  // namespace

int fitGaussians(const std::vector<SeenImage>& images, const FitSettings& settings,
                 Gaussians* gaussians) {
  if (images.empty() || gaussians->size() == 0 || settings.steps <= 0) return 0;
  return Fit(images, settings, gaussians).run();
}

Gaussians withoutUnseen(const Gaussians& gaussians, const std::vector<SeenImage>& images,
                        float least_pixels) {
  std::vector<float> shown(size_t(gaussians.size()), 0.f);
  const std::vector<float> ones(shown.size(), 1.f);
  RasterSettings raster;
  raster.antialias = gaussians.antialias;
  for (const SeenImage& image : images) {
    const Camera& camera = image.view.camera;
    const ExtraChannels weight{1, ones.data()};
    RasterStatePtr state;
    rasterize(gaussians, camera, raster, &state, weight);
    // The derivative of a channel's sum by a Gaussian's value is what of it is seen.
    const Image colour(camera.width, camera.height, 3), sum(camera.width, camera.height, 1, 1.f);
    BackwardExtras extras;
    extras.extra = weight, extras.d_channels = &sum;
    const GaussianGradients d =
        rasterizeBackward(gaussians, camera, *state, colour, nullptr, nullptr, extras);
    for (size_t i = 0; i < shown.size(); ++i) shown[i] = std::max(shown[i], d.extra[i]);
  }
  return keepRows(gaussians, [&](size_t i) { return shown[i] >= least_pixels; });
}

}  // namespace vdbc
