#include "splat/detail.h"

#include <algorithm>
#include <chrono>
#include <cmath>

#include "splat/discs.h"
#include "splat/fit.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

constexpr int kMostSteps = 3000;
constexpr int kBudgetRounds = 8;    // of halving an interval
constexpr float kLeastShown = .2f;  // pixels; discs of which no view shows more go

// The finest discs that keep to the budget: their gain is found by halving.
Gaussians discsWithin(const std::vector<SeenImage>& images, int64_t most) {
  DiscSettings settings;
  Gaussians discs = placeDiscs(images, settings);
  if (most == 0 || discs.size() <= most) return discs;
  const auto with = [&](double factor) {
    DiscSettings s;
    s.gain *= factor, s.noise_gain *= factor;
    return placeDiscs(images, s);
  };
  double low = 0, high = 1;  // binary logarithms
  while (high < 32 && (discs = with(std::exp2(high))).size() > most) low = high, high *= 2;
  require(discs.size() <= most, "seenDetail: expected a budget of at least ", discs.size(),
          " splats, the fewest that these views can be shown with, found ", most);
  for (int i = 0; i < kBudgetRounds; ++i) {
    const double middle = (low + high) / 2;
    Gaussians finer = with(std::exp2(middle));
    if (finer.size() <= most) {
      high = middle, discs = std::move(finer);
    } else {
      low = middle;
    }
  }
  return discs;
}

// Large pictures are fitted at half their size first.
double meanStepSeconds(const std::vector<SeenImage>& images, int64_t splats) {
  double sum = 0;
  for (const SeenImage& image : images) {
    const int64_t pixels = int64_t(image.width()) * image.height();
    const double share = image.width() > kCoarseFrom ? kCoarseShare : 0;
    sum += share * fitSeconds(splats, pixels / 4) + (1 - share) * fitSeconds(splats, pixels);
  }
  return sum / double(images.size());
}

}  // namespace

double fitSeconds(int64_t splats, int64_t pixels) {
  return 2e-4 + 1.15e-7 * double(pixels) + 2.1e-7 * double(splats);
}

Detail seenDetail(const std::vector<View>& views, const DetailSettings& settings,
                  const CarveSettings& carving, const Eigen::Vector3d& origin, Progress& progress) {
  require(settings.seconds >= 0 && settings.splats >= 0,
          "seenDetail: expected seconds and a budget that are not negative, found ",
          settings.seconds, ", ", settings.splats);
  Detail detail;
  detail.discs.origin = origin;
  detail.discs.antialias = true;
  if (views.empty() || settings.seconds == 0) return detail;
  const auto start = std::chrono::steady_clock::now();
  std::vector<SeenImage> images = seenImages(views, carving);
  for (SeenImage& image : images) image.view.camera = cameraFrom(origin, image.view.camera);
  detail.discs = discsWithin(images, settings.splats);
  const double step = meanStepSeconds(images, detail.discs.size());
  FitSettings fit;
  fit.steps = int(std::min(double(kMostSteps), settings.seconds / step));
  fit.seed = settings.seed, fit.progress = &progress;
  detail.steps = fitGaussians(images, fit, &detail.discs);
  detail.estimated_seconds = detail.steps * step;
  if (detail.steps > 0) detail.discs = withoutUnseen(detail.discs, images, kLeastShown);
  detail.discs.origin = origin;
  detail.seconds = secondsSince(start);
  return detail;
}

}  // namespace vdbc
