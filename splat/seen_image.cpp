#include "splat/seen_image.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <queue>
#include <tuple>

#include "vdb/error.h"
#include "vdb/median.h"

namespace vdbc {
namespace {

// Shares of the image's width, so that they hold at every resolution.
constexpr double kHoleReach = .09;      // how far planes are continued into holes of the depth
constexpr double kBorder = .006;        // along the image's border holes stay as they are
constexpr float kHoleColour = 1.f;      // sum of colour steps that continuing a plane may cross
constexpr size_t kMostNeighbours = 16;  // views that a view is compared with
constexpr int kLeastAlike = 2;          // of 8 neighbours
constexpr double kLeastNoise = 2e-4;    // of 1/z, share: what poses and rounding leave

void addPixel(double u, double v, double q, const float* c, Sums* row) {
  Sums& s = *row;
  s[kN] += 1, s[kU] += u, s[kV] += v, s[kUU] += u * u, s[kUV] += u * v, s[kVV] += v * v;
  s[kQ] += q, s[kUQ] += u * q, s[kVQ] += v * q, s[kQQ] += q * q;
  s[kR] += c[0], s[kG] += c[1], s[kB] += c[2];
  s[kCC] += double(c[0]) * c[0] + double(c[1]) * c[1] + double(c[2]) * c[2];
}

}  // namespace

ImagePlane fitPlane(const Sums& s, double* error) {
  const double n = s[kN];
  ImagePlane p;
  p.u0 = s[kU] / n, p.v0 = s[kV] / n, p.q0 = s[kQ] / n;
  // The ridge decides for columns and rows of single pixels, which have no slope across.
  const double ridge = 1e-6 * n;
  const double uu = s[kUU] - s[kU] * p.u0 + ridge, uv = s[kUV] - s[kU] * p.v0,
               vv = s[kVV] - s[kV] * p.v0 + ridge;
  const double uq = s[kUQ] - s[kU] * p.q0, vq = s[kVQ] - s[kV] * p.q0;
  const double det = uu * vv - uv * uv;
  p.a = (vv * uq - uv * vq) / det;
  p.b = (uu * vq - uv * uq) / det;
  *error = std::max(0., s[kQQ] - s[kQ] * p.q0 - p.a * uq - p.b * vq);
  return p;
}

double colourError(const Sums& s) {
  return std::max(0., s[kCC] - (s[kR] * s[kR] + s[kG] * s[kG] + s[kB] * s[kB]) / s[kN]);
}

SumTable::SumTable(const Image& colour, const std::vector<float>& q,
                   const std::vector<float>& weight)
    : width_(colour.width),
      height_(colour.height),
      sums_(size_t(width_ + 1) * size_t(height_ + 1), Sums{}) {
  for (int y = 0; y < height_; ++y) {
    Sums row{};
    for (int x = 0; x < width_; ++x) {
      const size_t i = size_t(y) * size_t(width_) + size_t(x);
      if (weight[i] > 0) addPixel(x + .5, y + .5, q[i], &colour.data[3 * i], &row);
      const Sums& above = at(x + 1, y);
      Sums& here = at(x + 1, y + 1);
      for (size_t k = 0; k < kSums; ++k) here[k] = above[k] + row[k];
    }
  }
}

Sums SumTable::over(int x0, int y0, int x1, int y1) const {
  Sums s;
  const Sums &a = at(x0, y0), &b = at(x1, y0), &c = at(x0, y1), &d = at(x1, y1);
  for (size_t k = 0; k < kSums; ++k) s[k] = d[k] - b[k] - c[k] + a[k];
  return s;
}

namespace {

// Median residual of planes through 5 x 5 pixels, all measured; 22 degrees of freedom each.
double depthNoise(const SumTable& table) {
  std::vector<double> residuals, depths;
  for (int y = 0; y + 5 <= table.height(); y += 3)
    for (int x = 0; x + 5 <= table.width(); x += 3) {
      const Sums s = table.over(x, y, x + 5, y + 5);
      if (s[kN] < 24.5) continue;
      double error = 0;
      fitPlane(s, &error);
      residuals.push_back(std::sqrt(error / 22));
      depths.push_back(s[kQ] / 25);
    }
  const double least = kLeastNoise * median(&depths);
  return std::max(median(&residuals), least);
}

// Immerkaer's fast noise estimate by a median: the second differences of smooth images vanish.
double colourNoise(const Image& colour) {
  std::vector<double> values;
  for (int y = 1; y + 1 < colour.height; y += 2)
    for (int x = 1; x + 1 < colour.width; x += 2) {
      const auto at = [&](int dx, int dy) { return colour.at(x + dx, y + dy, 1); };
      values.push_back(std::abs(at(-1, -1) + at(1, -1) + at(-1, 1) + at(1, 1) + 4 * at(0, 0) -
                                2 * (at(0, -1) + at(0, 1) + at(-1, 0) + at(1, 0))));
    }
  const double sigma = median(&values) / (.6745 * 6);
  return sigma * sigma;
}

double cosine(const Camera& c, const ImagePlane& p, double u, double v) {
  // n . P = 1 is 1/z = n . (x, y, 1), so n follows from the slopes.
  const double x = (u - c.cx) / c.fx, y = (v - c.cy) / c.fy;
  const double nx = p.a * c.fx, ny = p.b * c.fy, q = p.at(u, v), nz = q - nx * x - ny * y;
  return std::abs(q) / (std::sqrt(nx * nx + ny * ny + nz * nz) * std::sqrt(x * x + y * y + 1));
}

// The plane around a pixel: of the largest square about it that is flat within the noise.
ImagePlane localPlane(const SumTable& table, int x, int y, double noise) {
  ImagePlane best;
  for (int r = 2; r <= 6; r += 2) {
    const Sums s =
        table.over(std::max(0, x - r), std::max(0, y - r), std::min(table.width(), x + r + 1),
                   std::min(table.height(), y + r + 1));
    if (s[kN] < 6) continue;
    double error = 0;
    const ImagePlane p = fitPlane(s, &error);
    const bool flat = error <= s[kN] * kNoiseSigmas * kNoiseSigmas * noise * noise;
    if (best.q0 > 0 && !flat) break;
    best = p;
  }
  return best;
}

// A pixel with hardly a neighbour at its depth is a speckle of the sensor.
void dropLonePixels(SeenImage* image) {
  const std::vector<float> q = image->q;
  tbb::parallel_for(0, image->height(), [&](int y) {
    for (int x = 0; x < image->width(); ++x) {
      const size_t i = image->pixel(x, y);
      if (!(q[i] > 0)) continue;
      int alike = 0;
      for (int ny = std::max(0, y - 1); ny <= std::min(y + 1, image->height() - 1); ++ny)
        for (int nx = std::max(0, x - 1); nx <= std::min(x + 1, image->width() - 1); ++nx)
          alike +=
              std::abs(q[image->pixel(nx, ny)] - q[i]) <= .05f * q[i] + 3 * float(image->noise);
      if (alike - 1 < kLeastAlike) image->q[i] = image->weight[i] = 0;
    }
  });
}

struct Front {
  float cost;
  int x, y;
  ImagePlane plane;
  int distance;
};

// Planes around holes of the depth go on into them, along like colours first.
void continuePlanes(const SumTable& table, SeenImage* image) {
  const int w = image->width(), h = image->height();
  const int reach = int(kHoleReach * w), frame = int(kBorder * w);
  const Image& colour = image->view.colour;
  const auto later = [](const Front& a, const Front& b) {
    return std::tie(a.cost, a.y, a.x) > std::tie(b.cost, b.y, b.x);
  };
  std::priority_queue<Front, std::vector<Front>, decltype(later)> fronts(later);
  constexpr int kStepX[] = {1, -1, 0, 0}, kStepY[] = {0, 0, 1, -1};
  const auto spread = [&](int x, int y, const ImagePlane& plane, float cost, int distance) {
    for (int k = 0; k < 4; ++k) {
      const int nx = x + kStepX[k], ny = y + kStepY[k];
      if (nx < frame || ny < frame || nx >= w - frame || ny >= h - frame) continue;
      if (image->q[image->pixel(nx, ny)] > 0) continue;
      float step = 0;
      for (int c = 0; c < 3; ++c) step += std::abs(colour.at(nx, ny, c) - colour.at(x, y, c));
      const float total = cost + step + kHoleColour / float(reach + 1);
      if (total <= 2 * kHoleColour && distance < reach)
        fronts.push({total, nx, ny, plane, distance + 1});
    }
  };
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x) {
      if (!(image->weight[image->pixel(x, y)] > 0)) continue;
      bool rim = false;
      for (int k = 0; k < 4; ++k) {
        const int nx = x + kStepX[k], ny = y + kStepY[k];
        rim |= nx >= 0 && ny >= 0 && nx < w && ny < h && !(image->q[image->pixel(nx, ny)] > 0);
      }
      if (!rim) continue;
      const ImagePlane plane = localPlane(table, x, y, image->noise);
      if (plane.q0 > 0) spread(x, y, plane, 0, 0);
    }
  while (!fronts.empty()) {
    const Front f = fronts.top();
    fronts.pop();
    const size_t i = image->pixel(f.x, f.y);
    const double q = f.plane.at(f.x + .5, f.y + .5);
    // A plane that is seen edge-on soon runs away to or beyond the camera.
    if (image->q[i] > 0 || q < .67 * f.plane.q0 || q > 1.5 * f.plane.q0) continue;
    image->q[i] = float(q), image->weight[i] = kHoleWeight;
    spread(f.x, f.y, f.plane, f.cost, f.distance);
  }
}

// Every so many-th pixel's depth, for means would lie between surfaces.
View reduced(const View& view) {
  int divisor = 1;
  while (int64_t(view.camera.width / divisor) * (view.camera.height / divisor) > kMostPixels)
    ++divisor;
  if (divisor == 1) return view;
  const int w = view.camera.width / divisor, h = view.camera.height / divisor;
  View small;
  small.name = view.name;
  small.camera = resized(view.camera, w, h);
  small.colour = resizeImage(view.colour, w, h);
  small.depth.reserve(size_t(w) * size_t(h));
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x)
      small.depth.push_back(
          view.depth[size_t(y * divisor + divisor / 2) * size_t(view.camera.width) +
                     size_t(x * divisor + divisor / 2)]);
  return small;
}

SeenImage seenImage(const View& given, const CarveSettings& carving) {
  require(given.camera.width > 0 && given.camera.height > 0 && given.colour.channels == 3 &&
              given.colour.width == given.camera.width &&
              given.colour.height == given.camera.height &&
              given.depth.size() == size_t(given.camera.width) * size_t(given.camera.height),
          "seenImages: ", given.name, ": expected colour and depth of ", given.camera.width, " x ",
          given.camera.height, " pixels");
  SeenImage image;
  image.view = reduced(given);
  const View& view = image.view;
  image.q = usableDepth(view.depthView(), carving);
  image.weight.resize(image.q.size());
  for (size_t i = 0; i < image.q.size(); ++i) {
    image.weight[i] = image.q[i] > 0;
    if (image.q[i] > 0) image.q[i] = 1 / image.q[i];
  }
  image.noise = depthNoise(SumTable(view.colour, image.q, image.weight));
  image.colour_noise = colourNoise(view.colour);
  dropLonePixels(&image);
  const SumTable table(view.colour, image.q, image.weight);
  continuePlanes(table, &image);
  image.footprint.resize(image.q.size());
  for (int y = 0; y < image.height(); ++y)
    for (int x = 0; x < image.width(); ++x) {
      const size_t i = image.pixel(x, y);
      if (!(image.q[i] > 0)) continue;
      const ImagePlane p = localPlane(table, x, y, image.noise);
      const double c = p.q0 > 0 ? cosine(view.camera, p, x + .5, y + .5) : kLeastCosine;
      image.footprint[i] =
          float(1 / (image.q[i] * view.camera.fx * std::sqrt(std::max(c, kLeastCosine))));
    }
  return image;
}

}  // namespace

Verdict verdictOf(const SeenImage& other, int x, int y, double q) {
  const double there = double(other.q[other.pixel(x, y)]);
  if (there > 0 && std::abs(there - q) <= std::max(3 * other.noise, .01 * q)) return Verdict::kSame;
  bool through = true;
  for (int dy = -1; dy <= 1; ++dy)
    for (int dx = -1; dx <= 1; ++dx) {
      const int nx = x + dx, ny = y + dy;
      if (nx < 0 || ny < 0 || nx >= other.width() || ny >= other.height()) return Verdict::kNothing;
      const size_t i = other.pixel(nx, ny);
      // Seen through where everything around is measured and clearly behind.
      through &= other.weight[i] == 1 && other.q[i] < q * .95 - 3 * other.noise;
    }
  return through ? Verdict::kThrough : Verdict::kNothing;
}

std::vector<size_t> neighboursOf(const std::vector<SeenImage>& images, size_t i) {
  const SeenImage& image = images[i];
  const int step = std::max(1, image.width() / 16);
  std::vector<std::pair<int, size_t>> shared;
  for (size_t j = 0; j < images.size(); ++j) {
    if (j == i) continue;
    const Camera& other = images[j].view.camera;
    int count = 0;
    for (int y = step / 2; y < image.height(); y += step)
      for (int x = step / 2; x < image.width(); x += step) {
        const float q = image.q[image.pixel(x, y)];
        if (q > 0) count += other.pixelAt(other.project(image.point(x, y))) >= 0;
      }
    if (count > 0) shared.emplace_back(-count, j);
  }
  std::sort(shared.begin(), shared.end());
  if (shared.size() > kMostNeighbours) shared.resize(kMostNeighbours);
  std::vector<size_t> views;
  for (const auto& s : shared) views.push_back(s.second);
  std::sort(views.begin(), views.end());
  return views;
}

std::vector<SeenImage> seenImages(const std::vector<View>& views, const CarveSettings& carving) {
  std::vector<SeenImage> images(views.size());
  tbb::parallel_for(size_t(0), views.size(),
                    [&](size_t i) { images[i] = seenImage(views[i], carving); });
  return images;
}

}  // namespace vdbc
