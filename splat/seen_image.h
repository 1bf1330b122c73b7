#pragma once
// Private: what a view saw, pixel by pixel, and sums over rectangles of it: planes are affine in
// 1/z.
#include <array>
#include <vector>

#include "splat/view.h"

namespace vdbc {

/// A plane in the image: 1/z = q0 + a (u - u0) + b (v - v0), u and v in pixels.
struct ImagePlane {
  double u0 = 0, v0 = 0, q0 = 0, a = 0, b = 0;
  double at(double u, double v) const { return q0 + a * (u - u0) + b * (v - v0); }
};

/// Of q = 1/z, pixel centres u, v and display sRGB over some pixels.
enum Sum { kN, kU, kV, kUU, kUV, kVV, kQ, kUQ, kVQ, kQQ, kR, kG, kB, kCC, kSums };
using Sums = std::array<double, kSums>;

/// Least squares; `error` gets the sum of squared residuals of 1/z.
ImagePlane fitPlane(const Sums& sums, double* error);
/// Sum of squared differences from the mean colour.
double colourError(const Sums& sums);

/// Summed-area table; pixels with weight 0 are not there.
class SumTable {
 public:
  SumTable(const Image& colour, const std::vector<float>& q, const std::vector<float>& weight);
  int width() const { return width_; }
  int height() const { return height_; }
  /// Ends are exclusive.
  Sums over(int x0, int y0, int x1, int y1) const;

 private:
  Sums& at(int x, int y) { return sums_[size_t(y) * size_t(width_ + 1) + size_t(x)]; }
  const Sums& at(int x, int y) const { return sums_[size_t(y) * size_t(width_ + 1) + size_t(x)]; }
  int width_ = 0, height_ = 0;
  std::vector<Sums> sums_;  // [H + 1, W + 1]
};

constexpr double kNoiseSigmas = 2.5;  // residuals of planes within are noise
constexpr double kLeastCosine = .3;   // surfaces seen at a flatter angle count as seen at this one
constexpr int64_t kMostPixels = 1 << 20;  // of a view; larger ones are looked at reduced
constexpr float kHoleWeight = .3f;        // of a pixel whose depth was continued

struct SeenImage {
  View view;                     // at most kMostPixels, else reduced
  std::vector<float> q;          // [H * W] 1/z, metres^-1; 0 where there is none
  std::vector<float> weight;     // [H * W] 1 measured, kHoleWeight continued, 0 neither
  std::vector<float> footprint;  // [H * W] metres on the surface that a pixel covers
  double noise = 0;              // sigma of a measured 1/z
  double colour_noise = 0;       // variance of a pixel and channel

  int width() const { return view.camera.width; }
  int height() const { return view.camera.height; }
  size_t pixel(int x, int y) const { return size_t(y) * size_t(width()) + size_t(x); }
  /// The world point of a pixel with a depth.
  Eigen::Vector3d point(int x, int y) const {
    return view.camera.unproject(x + .5, y + .5, 1 / double(q[pixel(x, y)]));
  }
};

/// What a view says of a point that lies 1/q deep at its pixel (x, y).
enum class Verdict { kNothing, kSame, kThrough };
Verdict verdictOf(const SeenImage& image, int x, int y, double q);

/// The views that see most of what view `i` sees, at most 16, by number.
std::vector<size_t> neighboursOf(const std::vector<SeenImage>& images, size_t i);

/// Parallel over views.
/// Throws Error for views without colour or depth of the camera's size.
std::vector<SeenImage> seenImages(const std::vector<View>& views, const CarveSettings& carving);

}  // namespace vdbc
