#pragma once
// Private to the renderer: colours of patterns and of texture images, averaged over a footprint.
#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <vector>

#include "examples/rooms/surface.h"

namespace vdbc {

/// Reflectance of a pattern at (u, v) metres, averaged roughly over `footprint` metres.
Eigen::Vector3f pattern(const Material& m, float u, float v, float footprint);

/// A texture and its halvings, averaged in linear light.
class MipTexture {
 public:
  explicit MipTexture(std::shared_ptr<const Texture> base);

  Eigen::Vector2f size() const { return {float(base_->width), float(base_->height)}; }

  /// Linear colour, with `texels` of the full size in the footprint.
  Eigen::Vector3f colour(const Eigen::Vector2f& uv, float texels) const;
  float coverage(const Eigen::Vector2f& uv) const;
  bool hasAlpha() const { return base_->has_alpha; }

 private:
  struct Level {
    int width, height;
    const uint8_t* data;
  };

  static void halve(const Level& big, const Level& small, uint8_t* out);
  /// The four texels round uv with their bilinear weights; repeats, v up.
  template <typename Visit>
  static void visit(const Level& l, const Eigen::Vector2f& uv, Visit take);

  std::shared_ptr<const Texture> base_;
  std::vector<uint8_t> smaller_;
  std::vector<Level> levels_;
};

}  // namespace vdbc
