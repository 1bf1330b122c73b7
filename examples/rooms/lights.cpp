#include "examples/rooms/lights.h"

#include <algorithm>
#include <cmath>

#include "examples/rooms/sampling.h"

namespace vdbc {

using Eigen::Vector2f;
using Eigen::Vector3f;

namespace {

/// A rectangle as a spherical rectangle seen from a point, sampled evenly by solid angle (Urena et
/// al. 2013).
class SphericalRectangle {
 public:
  SphericalRectangle(const RoomLight& l, const Vector3f& from) {
    const float half_x = l.half_u.norm(), half_y = l.half_v.norm();
    x_ = l.half_u / half_x, y_ = l.half_v / half_y, z_ = x_.cross(y_);
    const Vector3f d = l.centre - from;
    z0_ = d.dot(z_);
    if (z0_ > 0) z_ = -z_, z0_ = -z0_;
    x0_ = d.dot(x_) - half_x, x1_ = d.dot(x_) + half_x;
    y0_ = d.dot(y_) - half_y, y1_ = d.dot(y_) + half_y;
    // Normals of the planes through the edges; each has one coordinate that is zero.
    const auto ratio = [&](float c) { return 1 / std::sqrt(z0_ * z0_ + c * c); };
    const float r0 = ratio(y0_), r1 = ratio(x1_), r2 = ratio(y1_), r3 = ratio(x0_);
    const float n0 = -y0_ * r0, n1 = x1_ * r1, n2 = y1_ * r2, n3 = -x0_ * r3;  // their z
    b0_ = n0, b1_ = n2;
    const auto angle = [](float c) { return std::acos(std::clamp(-c, -1.f, 1.f)); };
    k_ = 2 * kPi - angle(n2 * n3) - angle(n3 * n0);
    solid_angle_ = angle(n0 * n1) + angle(n1 * n2) - k_;
  }

  float solidAngle() const { return solid_angle_; }

  /// A point of it, relative to where it is seen from.
  Vector3f point(const Vector2f& s) const {
    const float au = s.x() * solid_angle_ + k_, sine = std::sin(au);
    const float fu = (std::cos(au) * b0_ - b1_) / sine;
    const float cu = std::clamp(std::copysign(1 / std::sqrt(fu * fu + b0_ * b0_), fu), -1.f, 1.f);
    const float x = std::clamp(-cu * z0_ / std::max(std::sqrt(1 - cu * cu), 1e-7f), x0_, x1_);
    const float d2 = x * x + z0_ * z0_, d = std::sqrt(d2);
    const float h0 = y0_ / std::sqrt(d2 + y0_ * y0_), h1 = y1_ / std::sqrt(d2 + y1_ * y1_);
    const float h = h0 + s.y() * (h1 - h0);
    const float y = h * h < 1 - 1e-6f ? h * d / std::sqrt(1 - h * h) : y1_;
    return x * x_ + y * y_ + z0_ * z_;
  }

 private:
  Vector3f x_, y_, z_;
  float x0_, x1_, y0_, y1_, z0_, b0_, b1_, k_, solid_angle_;
};

LightSample sampleSphere(const RoomLight& l, const Vector3f& p, const Vector2f& s) {
  const Vector3f d = l.centre - p;
  const float distance = d.norm();
  if (distance <= l.radius_m) return {};
  const float sine2 = l.radius_m * l.radius_m / (distance * distance);
  const float one_minus_cosine = sine2 / (1 + std::sqrt(1 - sine2));  // of the cone
  const float c = 1 - s.x() * one_minus_cosine, r = std::sqrt(std::max(0.f, 1 - c * c)),
              a = 2 * kPi * s.y();
  LightSample out;
  out.direction =
      (basis(d / distance) * Vector3f(r * std::cos(a), r * std::sin(a), c)).normalized();
  const float middle = distance * c;
  const float chord2 = l.radius_m * l.radius_m - distance * distance * r * r;
  out.reach = middle - std::sqrt(std::max(0.f, chord2)) - l.bound_m;
  out.weight = 2 * kPi * one_minus_cosine;
  return out;
}

LightSample sampleRectangle(const Light& light, const Vector3f& p, const Vector2f& s) {
  const RoomLight& l = light.shape;
  LightSample out;
  Vector3f to;
  // Far away the angles cancel and area is as good a measure.
  if (light.area < .02f * (l.centre - p).squaredNorm()) {
    to = l.centre + l.half_u * (2 * s.x() - 1) + l.half_v * (2 * s.y() - 1) - p;
    const float d2 = to.squaredNorm();
    out.weight = -light.normal.dot(to) * light.area / (d2 * std::sqrt(d2));
  } else {
    const SphericalRectangle seen(l, p);
    to = seen.point(s);
    out.weight = seen.solidAngle();
  }
  const float distance = to.norm();
  out.direction = to / distance;
  out.reach = distance - l.bound_m;
  return out;
}

}  // namespace

LightSample Light::sample(const Vector3f& p, const Vector2f& s) const {
  return area > 0 ? sampleRectangle(*this, p, s) : sampleSphere(shape, p, s);
}

float irradianceEstimate(const Light& light, const Vector3f& p, const Vector3f& n) {
  if (light.area <= 0) {
    const Vector3f d = light.shape.centre - p;
    const float d2 = d.squaredNorm(), r = light.shape.radius_m;
    // A sphere that is half below the horizon still lights: wrap by its angular radius.
    const float distance = std::sqrt(d2), wrap = std::min(r / distance, 1.f);
    const float cosine = std::max(0.f, (n.dot(d) / distance + wrap) / (1 + wrap));
    return kPi * r * r * cosine / (d2 + r * r);
  }
  const Vector3f to = light.shape.centre - p;
  const float behind = -light.normal.dot(to);
  const float top = n.dot(to) + std::abs(n.dot(light.shape.half_u)) +
                    std::abs(n.dot(light.shape.half_v));  // highest corner above the horizon
  if (behind <= 0 || top <= 0) return 0;
  float sum = .02f * behind * top / std::pow(to.squaredNorm() + light.area * .25f, 2.f);
  for (int k = 0; k < 4; ++k) {
    const Vector3f d =
        to + light.shape.half_u * (k & 1 ? .5f : -.5f) + light.shape.half_v * (k & 2 ? .5f : -.5f);
    const float d2 = d.squaredNorm(), a = n.dot(d), soft = d2 + light.area * .03f;
    if (a > 0) sum += a * behind / (soft * soft);
  }
  return sum * light.area / 4;
}

SunMask::SunMask(const Vector3f& towards, const std::vector<std::array<Vector3f, 3>>& panes)
    : frame_(basis(towards).transpose()), bits_(size_t(kSide * kSide)) {
  Eigen::AlignedBox2f bounds;
  for (const auto& pane : panes)
    for (const Vector3f& v : pane) bounds.extend(Vector2f((frame_ * v).head<2>()));
  low_ = bounds.min();
  scale_ = (bounds.sizes().array() + 1e-6f).inverse() * float(kSide);
  for (const auto& pane : panes) {
    Eigen::AlignedBox2f box;
    for (const Vector3f& v : pane) box.extend(cell(v));
    const Eigen::Vector2i a = (box.min().array() - .01f).floor().cast<int>().max(0).min(kSide - 1);
    const Eigen::Vector2i b = (box.max().array() + .01f).floor().cast<int>().max(0).min(kSide - 1);
    for (int y = a.y(); y <= b.y(); ++y)
      for (int x = a.x(); x <= b.x(); ++x) bits_[size_t(y * kSide + x)] = 1;
  }
}

}  // namespace vdbc
