#pragma once
// Float images, their files (PNG, JPEG, EXR) and the metrics PSNR and SSIM.
#include <cstdint>
#include <string>
#include <vector>

namespace vdbc {

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

/// IEC 61966-2-1 transfer, per value; linear 0-1 <-> display 0-1 (extended linearly below 0).
float srgbFromLinear(float linear);
float linearFromSrgb(float srgb);

/// 8- or 16-bit PNG or 8-bit JPEG as values 0-1 (no transfer applied): 1, 3 channels (alpha
/// dropped). Throws Error on missing, corrupt or oversized files (more than 2^28 pixels).
Image readImage(const std::string& path);
/// 16-bit greyscale PNG as raw integers (depth in millimetres, say). Throws Error.
std::vector<uint16_t> readPng16(const std::string& path, int* width, int* height);
/// Clamps to 0-1 and rounds to 8 bits; 1 or 3 channels. Temporary name, then rename. Throws Error.
void writePng(const Image& image, const std::string& path);
/// 16-bit greyscale PNG of raw integers, [height * width].
void writePng16(const std::vector<uint16_t>& data, int width, int height, const std::string& path);

/// Area-averaging when shrinking, bilinear when growing.
Image resizeImage(const Image& image, int width, int height);

/// Writes `from` over the pixels of `to` from (x, y) on; it must fit and have as many channels.
void pasteImage(const Image& from, int x, int y, Image* to);

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
