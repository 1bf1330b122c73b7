#pragma once
// How far images or their depth are from the true ones: FLIP, errors over some pixels, depth error
// (PSNR and SSIM of whole images: image.h).
#include <cstdint>
#include <vector>

#include "splat/image.h"

namespace vdbc {

/// FLIP's default viewer: 0.7 m from a monitor with 3840 pixels on 0.7 m.
constexpr double kFlipPixelsPerDegree = 3840 * 3.14159265358979323846 / 180;

/// The FLIP error of each pixel, [H, W, 1] in 0-1 (Andersson et al. 2020, for low dynamic range):
/// what a viewer notices who alternates between the two. Both are [H, W, 3] display sRGB, clamped
/// to 0-1; NaN counts as 0. Symmetric; 0 for equal images.
Image flipMap(const Image& reference, const Image& test,
              double pixels_per_degree = kFlipPixelsPerDegree);
/// Mean of flipMap().
double flip(const Image& reference, const Image& test,
            double pixels_per_degree = kFlipPixelsPerDegree);

/// PSNR, SSIM and FLIP over some of the pixels; NaN where there are none.
struct PictureError {
  double psnr = 0, ssim = 0, flip = 0;
  int64_t pixels = 0;
};
/// Over the pixels with a nonzero `mask`, [H * W]. PSNR: of their mean squared error. SSIM (windows
/// inside the image only, as ssim() has them) and FLIP: means of the maps there, where the other
/// pixels of `test` take the reference's colour before any filter: nothing outside the mask is held
/// against the picture, and what is outside in the reference stays the same surroundings in both.
/// Images as flipMap() wants them, at least 11 x 11 pixels.
PictureError pictureError(const Image& reference, const Image& test,
                          const std::vector<uint8_t>& mask);

/// Over the pixels where both depths are positive and finite; NaN where there are none.
struct DepthError {
  double median_abs_m = 0;  // lower median of |depth - truth|, metres
  double rmse_m = 0;        // root of the mean square, metres
  double share = 0;         // of the pixels with a true depth: those that have one here too
};
/// Planar depths of the same pixels, metres; 0 where there is none.
DepthError depthError(const std::vector<float>& depth, const std::vector<float>& truth);

}  // namespace vdbc
