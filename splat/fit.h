#pragma once
// Private: Gaussians fitted to the views that they were made of, by a few steps of Adam. See
// docs/method.md, section 6.3.
#include <vector>

#include "splat/gaussians.h"
#include "splat/seen_image.h"
#include "vdb/progress.h"

namespace vdbc {

constexpr int kCoarseFrom = 320;     // pixels of width: larger pictures are fitted reduced first
constexpr double kCoarseShare = .6;  // of the steps

struct FitSettings {
  int steps = 100;               // at most
  uint64_t seed = 1;             // of the order of views and the pixels held back
  Progress* progress = nullptr;  // may be null
};

/// Moves all parameters so that pictures of `gaussians` (SH degree 0) become those of the views: a
/// robust error of colour, opacity where there is a surface, a little of depth. Every view has a
/// gain and an offset of its own. Stops early where pixels that it holds back (a tenth) stop to get
/// better: input views would go on to, others would get worse. Returns the steps taken; their
/// number and the result depend on the arguments alone. Throws Cancelled.
int fitGaussians(const std::vector<SeenImage>& images, const FitSettings& settings,
                 Gaussians* gaussians);

/// Those of which some view shows at least `least_pixels` (sum of blending weights over its
/// pixels).
Gaussians withoutUnseen(const Gaussians& gaussians, const std::vector<SeenImage>& images,
                        float least_pixels);

}  // namespace vdbc
