#pragma once
// Float images and the metrics PSNR and SSIM.
#include <cstddef>
#include <cstdint>
#include <vector>

namespace vdbc {

/// Pictures beyond these are refused before they are read.
constexpr uint64_t kMaxImagePixels = uint64_t(1) << 28, kMaxImageBytes = uint64_t(1) << 32;

/// Interleaved float image, row-major, [height, width, channels].
struct Image {
  int width = 0, height = 0, channels = 0;
  std::vector<float> data;

  Image() = default;
  Image(int w, int h, int c, float value = 0.f)
      : width(w), height(h), channels(c), data(size_t(w) * size_t(h) * size_t(c), value) {}
  float& at(int x, int y, int c) {
    return data[(size_t(y) * size_t(width) + size_t(x)) * size_t(channels) + size_t(c)];
  }
  float at(int x, int y, int c) const {
    return data[(size_t(y) * size_t(width) + size_t(x)) * size_t(channels) + size_t(c)];
  }
};

/// Throws Error, opened by `operation`, unless the image has pixels and as many values as they
/// need.
void requireImage(const char* operation, const Image& image);

/// IEC 61966-2-1 transfer, per value; linear 0-1 <-> display 0-1 (extended linearly below 0).
float srgbFromLinear(float linear);
float linearFromSrgb(float srgb);

/// Area-averaging when shrinking, bilinear when growing.
Image resizeImage(const Image& image, int width, int height);

/// Pictures of 3 channels in rows of `columns`, or of all where there are fewer, each at the upper
/// left of a cell in the size of the largest; an empty one leaves its cell dark.
Image tileImages(const std::vector<Image>& pictures, int columns);

/// 10 log10(1 / mean squared error) over all values; infinity for equal images. Values are 0-1.
double psnr(const Image& a, const Image& b);
/// SSIM of each window and channel (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5, K1 .01,
/// K2 .03, range 1, windows inside the image only: [H - 10, W - 10, C], the first one's centre is
/// pixel (kSsimBorder, kSsimBorder).
constexpr int kSsimBorder = 5;
Image ssimMap(const Image& a, const Image& b);
/// Mean of ssimMap().
double ssim(const Image& a, const Image& b);

}  // namespace vdbc
