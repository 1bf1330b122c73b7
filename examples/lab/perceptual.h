#pragma once
// A user's own networks as measures of images: none is shipped.
#include <memory>
#include <string>
#include <vector>

#include "splat/image.h"

namespace vdbc {

/// A TorchScript network of two pictures [1, 3, H, W] in -1 to 1 (display sRGB), reference first,
/// to one number, 0 for equal ones: LPIPS (Zhang et al. 2018) as its authors' package traces or
/// scripts it.
class PerceptualNet {
 public:
  /// Throws Error where there is no such file or no such network in it.
  explicit PerceptualNet(const std::string& path);
  ~PerceptualNet();
  /// [H, W, 3] display sRGB, clamped to 0-1. Throws Error if the network fails or gives no number.
  double distance(const Image& reference, const Image& test) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// A TorchScript network of one picture [1, 3, H, W] in -1 to 1 (display sRGB) to features, of
/// which frechetDistance() and kernelDistance() make FID and KID. It resizes by itself what it
/// needs in another size.
class FeatureNet {
 public:
  /// Throws Error where there is no such file or no such network in it.
  explicit FeatureNet(const std::string& path);
  ~FeatureNet();
  /// [H, W, 3] display sRGB, clamped to 0-1. Throws Error if the network fails or gives no numbers.
  std::vector<float> features(const Image& image) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vdbc
