#pragma once
// Private: flat Gaussians on what depth views saw: one disc per patch of about equal content. See
// docs/method.md, section 6.3.
#include <vector>

#include "splat/gaussians.h"
#include "splat/seen_image.h"

namespace vdbc {

struct DiscSettings {
  /// Squared error of colour (display sRGB, summed over pixels and channels) that parting a patch
  /// of a picture of 224 x 224 has to take away; grows with the pixels to the power of 1.5, which
  /// makes about as many discs of a picture at every resolution.
  double gain = .01;
  double noise_gain = 12;  // the same in units of the noise of a picture (variance of its values)
};

/// Opaque discs, SH degree 0, made for RasterSettings::antialias. Every image is parted into
/// patches (a k-d tree over its pixels, whose planes are affine in 1/z), until what another cut
/// takes away from the error of colour and depth is not worth a disc: plain walls get few, shelves
/// many. A point that several views see belongs to the one that sees it finest; a later view adds
/// only where the earlier ones left a gap. Holes of the depth continue the planes around them along
/// like colours. What another view looked through is left out. Means are in the cameras' world.
/// Parallel over views; the same bytes for any number of threads.
Gaussians placeDiscs(const std::vector<SeenImage>& images, const DiscSettings& settings);

}  // namespace vdbc
