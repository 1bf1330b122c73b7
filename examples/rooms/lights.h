#pragma once
// Private to the renderer: lights and how they are sampled.
#include <Eigen/Core>
#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <vector>

#include "examples/rooms/rooms.h"

namespace vdbc {

/// A direction towards the light, where the shadow ray ends, and the light's irradiance on a plane
/// across the direction divided by the density of choosing it, as a factor of its radiance.
struct LightSample {
  Eigen::Vector3f direction;
  float reach = 0, weight = 0;
};

struct Light {
  RoomLight shape;
  Eigen::Vector3f normal = Eigen::Vector3f::Zero();  // of a rectangle
  float area = 0;                                    // 0: a sphere

  LightSample sample(const Eigen::Vector3f& p, const Eigen::Vector2f& s) const;
};

/// About the irradiance at p (normal n) from an unoccluded light, as a factor of its radiance; more
/// than zero wherever any part of it shines. Rectangles are cut in four; the softened distance
/// keeps the quarters finite next to the glass.
float irradianceEstimate(const Light& light, const Eigen::Vector3f& p, const Eigen::Vector3f& n);

/// Which points can be lit by the sun at all: the shadow of the panes along its direction, as a
/// bitmap.
class SunMask {
 public:
  SunMask() = default;
  SunMask(const Eigen::Vector3f& towards, const std::vector<std::array<Eigen::Vector3f, 3>>& panes);

  bool mayShineOn(const Eigen::Vector3f& p) const {
    if (bits_.empty()) return false;
    const Eigen::Vector2f c = cell(p);
    if (!(c.x() >= 0 && c.y() >= 0 && c.x() < kSide && c.y() < kSide)) return false;
    return bits_[size_t(int(c.y()) * kSide + int(c.x()))];
  }

 private:
  static constexpr int kSide = 256;
  Eigen::Vector2f cell(const Eigen::Vector3f& p) const {
    return ((frame_ * p).head<2>() - low_).cwiseProduct(scale_);
  }
  Eigen::Matrix3f frame_ = Eigen::Matrix3f::Identity();
  Eigen::Vector2f low_, scale_;
  std::vector<uint8_t> bits_;
};

}  // namespace vdbc
