#pragma once
// Private to the renderer: random numbers that do not depend on the order of work, and directions
// made of them.
#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdint>

namespace vdbc {

constexpr float kPi = float(M_PI);

inline uint32_t hash(uint32_t x) {
  x ^= x >> 16, x *= 0x7feb352du;
  x ^= x >> 15, x *= 0x846ca68bu;
  return x ^ x >> 16;
}
inline uint32_t hash(uint32_t a, uint32_t b) { return hash(a ^ hash(b + 0x9e3779b9u)); }
inline float unit(uint32_t bits) { return float(bits >> 8) * 0x1p-24f; }

inline uint32_t reverseBits(uint32_t x) {
  x = (x >> 1 & 0x55555555u) | (x & 0x55555555u) << 1;
  x = (x >> 2 & 0x33333333u) | (x & 0x33333333u) << 2;
  x = (x >> 4 & 0x0f0f0f0fu) | (x & 0x0f0f0f0fu) << 4;
  x = (x >> 8 & 0x00ff00ffu) | (x & 0x00ff00ffu) << 8;
  return x >> 16 | x << 16;
}

/// Owen scrambling of a bit-reversed number (Laine & Karras 2011).
inline uint32_t scramble(uint32_t x, uint32_t key) {
  x += key;
  x ^= x * 0x6c50b47cu, x ^= x * 0xb82f1e52u;
  x ^= x * 0xc7afe638u, x ^= x * 0x8d22f6e6u;
  return x;
}

/// Point `i` of the first two dimensions of Sobol's sequence, shuffled and Owen-scrambled by `key`
/// (Burley 2020): every pair of dimensions of a pixel is well spread by itself.
inline Eigen::Vector2f sample2(uint32_t key, uint32_t i) {
  const uint32_t index = reverseBits(scramble(reverseBits(i), hash(key)));
  // The second dimension's matrix is Pascal's triangle modulo 2: a sum over supersets of bits.
  uint32_t y = index;
  y ^= y >> 1 & 0x55555555u, y ^= y >> 2 & 0x33333333u, y ^= y >> 4 & 0x0f0f0f0fu;
  y ^= y >> 8 & 0x00ff00ffu, y ^= y >> 16;
  return {unit(reverseBits(scramble(index, hash(key, 1)))),
          unit(reverseBits(scramble(y, hash(key, 2))))};
}

/// Columns x, y, n: right-handed and orthonormal (Duff et al. 2017).
inline Eigen::Matrix3f basis(const Eigen::Vector3f& n) {
  const float sign = std::copysign(1.f, n.z()), a = -1 / (sign + n.z()), b = n.x() * n.y() * a;
  Eigen::Matrix3f m;
  m.col(0) = Eigen::Vector3f(1 + sign * n.x() * n.x() * a, sign * b, -sign * n.x());
  m.col(1) = Eigen::Vector3f(b, sign + n.y() * n.y() * a, -n.y());
  m.col(2) = n;
  return m;
}

inline Eigen::Vector3f cosineDirection(const Eigen::Vector3f& n, const Eigen::Vector2f& s) {
  const float r = std::sqrt(s.x()), a = 2 * kPi * s.y();
  return (basis(n) * Eigen::Vector3f(r * std::cos(a), r * std::sin(a), std::sqrt(1 - s.x())))
      .normalized();
}

inline Eigen::Vector3f uniformDirection(const Eigen::Vector2f& s) {
  const float z = 1 - 2 * s.x(), r = std::sqrt(std::max(0.f, 1 - z * z)), a = 2 * kPi * s.y();
  return {r * std::cos(a), r * std::sin(a), z};
}

inline float fresnel(float f0, float cosine) {
  const float a = 1 - std::clamp(cosine, 0.f, 1.f), a2 = a * a;
  return f0 + (1 - f0) * a2 * a2 * a;
}

/// A reflection of the unit vector `to_eye` by GGX facets that are seen from there (Heitz 2018) and
/// what it carries apart from Fresnel's factor: the share of facets that are not masked.
inline Eigen::Vector3f glossDirection(const Eigen::Vector3f& n, const Eigen::Vector3f& to_eye,
                                      float roughness, const Eigen::Vector2f& s, float* weight,
                                      float* facet_cosine) {
  const float alpha = std::max(roughness * roughness, 1e-3f);
  const Eigen::Matrix3f frame = basis(n);
  const Eigen::Vector3f v = frame.transpose() * to_eye;
  const Eigen::Vector3f vh = Eigen::Vector3f(alpha * v.x(), alpha * v.y(), v.z()).normalized();
  const float flat = vh.x() * vh.x() + vh.y() * vh.y();
  const Eigen::Vector3f t1 =
      flat > 1e-9f ? Eigen::Vector3f(Eigen::Vector3f(-vh.y(), vh.x(), 0) / std::sqrt(flat))
                   : Eigen::Vector3f::UnitX();
  const Eigen::Vector3f t2 = vh.cross(t1);
  const float r = std::sqrt(s.x()), a = 2 * kPi * s.y(), p1 = r * std::cos(a);
  const float half = .5f * (1 + vh.z());
  const float p2 = (1 - half) * std::sqrt(std::max(0.f, 1 - p1 * p1)) + half * r * std::sin(a);
  const Eigen::Vector3f nh =
      p1 * t1 + p2 * t2 + std::sqrt(std::max(0.f, 1 - p1 * p1 - p2 * p2)) * vh;
  const Eigen::Vector3f h =
      Eigen::Vector3f(alpha * nh.x(), alpha * nh.y(), std::max(1e-6f, nh.z())).normalized();
  const Eigen::Vector3f out = 2 * v.dot(h) * h - v;
  const float a2 = alpha * alpha;
  const auto lambda = [&](const Eigen::Vector3f& w) {
    return .5f * (std::sqrt(1 + a2 * (1 / std::max(w.z() * w.z(), 1e-9f) - 1)) - 1);
  };
  *weight = out.z() <= 0 ? 0.f : (1 + lambda(v)) / (1 + lambda(v) + lambda(out));
  *facet_cosine = v.dot(h);
  return frame * out;
}

}  // namespace vdbc
