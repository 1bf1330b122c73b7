// Pictures of rooms: a path tracer with final gathering. For every sample the eye's ray, its mirror
// image in gloss and one diffuse bounce are traced, and at their ends a light, the sun and a spot
// of bright reflected light are sampled. Where the bounce ends, the light of all further bounces is
// read from a cache, which is built once a room: it is the same for every view and number of
// samples. Near corners, where the cache is too coarse, paths go on instead of reading it.
//
// Most noise would come from bounces that chance upon what is lit far above the rest: the sun on
// the floor, the ceiling round a lamp. Such spots are sampled like lights from afar (instant
// radiosity, Keller 1997) and left out of what far bounces bring; nearer than kCacheReach it is the
// other way round, so that nothing is lost or counted twice, and nothing needs to be clamped.
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <map>
#include <mutex>

#include "examples/rooms/ray_log.h"
#include "examples/rooms/rooms.h"
#include "splat/embree_device.h"
#include "vdb/error.h"

namespace vdbc {

std::atomic<RayLog*> ray_log{nullptr};

namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

constexpr float kPi = float(M_PI);
constexpr int kPacket = 16;
constexpr float kOffset = 2e-4f;       // metres: from a surface to the rays that leave it
constexpr int kMaxDepth = 24;          // events of a path
constexpr float kGatherSpread = .15f;  // footprint of a diffuse bounce, metres a metre
constexpr float kCacheCell = .2f;      // metres
constexpr float kCacheReach = .3f;     // shorter bounces do not read the cache
constexpr size_t kSpots = 8192;        // of light that lights the room in turn
constexpr float kSharpGloss = .3f;     // what is seen in gloss less rough than this is shaded fully

// --- random numbers per pixel, independent of the order of work ----------------------------------

uint32_t hash(uint32_t x) {
  x ^= x >> 16, x *= 0x7feb352du;
  x ^= x >> 15, x *= 0x846ca68bu;
  return x ^ x >> 16;
}
uint32_t hash(uint32_t a, uint32_t b) { return hash(a ^ hash(b + 0x9e3779b9u)); }
float unit(uint32_t bits) { return float(bits >> 8) * 0x1p-24f; }

uint32_t reverseBits(uint32_t x) {
  x = (x >> 1 & 0x55555555u) | (x & 0x55555555u) << 1;
  x = (x >> 2 & 0x33333333u) | (x & 0x33333333u) << 2;
  x = (x >> 4 & 0x0f0f0f0fu) | (x & 0x0f0f0f0fu) << 4;
  x = (x >> 8 & 0x00ff00ffu) | (x & 0x00ff00ffu) << 8;
  return x >> 16 | x << 16;
}

/// Owen scrambling of a bit-reversed number (Laine & Karras 2011).
uint32_t scramble(uint32_t x, uint32_t key) {
  x += key;
  x ^= x * 0x6c50b47cu, x ^= x * 0xb82f1e52u;
  x ^= x * 0xc7afe638u, x ^= x * 0x8d22f6e6u;
  return x;
}

/// Point `i` of the first two dimensions of Sobol's sequence, shuffled and Owen-scrambled by `key`
/// (Burley 2020): every pair of dimensions of a pixel is well spread by itself.
Vector2f sample2(uint32_t key, uint32_t i) {
  const uint32_t index = reverseBits(scramble(reverseBits(i), hash(key)));
  // The second dimension's matrix is Pascal's triangle modulo 2: a sum over supersets of bits.
  uint32_t y = index;
  y ^= y >> 1 & 0x55555555u, y ^= y >> 2 & 0x33333333u, y ^= y >> 4 & 0x0f0f0f0fu;
  y ^= y >> 8 & 0x00ff00ffu, y ^= y >> 16;
  return {unit(reverseBits(scramble(index, hash(key, 1)))),
          unit(reverseBits(scramble(y, hash(key, 2))))};
}

// --- textures ------------------------------------------------------------------------------------

float cellNoise(int x, int y) { return unit(hash(uint32_t(x) * 0x8da6b343u, uint32_t(y))); }

float valueNoise(float x, float y) {
  const float fx = std::floor(x), fy = std::floor(y);
  const int ix = int(fx), iy = int(fy);
  float u = x - fx, v = y - fy;
  u = u * u * (3 - 2 * u), v = v * v * (3 - 2 * v);
  const float a = cellNoise(ix, iy), b = cellNoise(ix + 1, iy);
  const float c = cellNoise(ix, iy + 1), d = cellNoise(ix + 1, iy + 1);
  return a + (b - a) * u + (c - a) * v + (a - b - c + d) * u * v;
}

float fraction(float x) { return x - std::floor(x); }

/// Share of a line of `width` round whole numbers of x that a footprint of `blur` sees.
float lineCover(float x, float width, float blur) {
  const float d = std::abs(x - std::round(x));
  return std::clamp((width / 2 + blur / 2 - d) / blur, 0.f, 1.f) * std::min(1.f, width / blur);
}

/// Fraction of a square wave (low half 0, high half 1) that a footprint of `blur` sees.
float squareWave(float x, float blur) {
  if (blur > 1) return .5f;
  const float d = std::abs(fraction(x) - .5f);  // edges where d = 1/4
  return std::clamp(.5f + (.25f - d) / std::max(blur, 1e-4f), 0.f, 1.f);
}

/// Reflectance of a pattern at (u, v) metres, averaged roughly over `footprint` metres.
Vector3f pattern(const Material& m, float u, float v, float footprint) {
  const float x = u / m.period_m, y = v / m.period_m, blur = footprint / m.period_m + 1e-4f;
  const auto mix = [&](float t) { return Vector3f(m.colour_a + (m.colour_b - m.colour_a) * t); };
  switch (m.pattern) {
    case Pattern::kPlain:
      return m.colour_a;
    case Pattern::kStripes:
      return mix(squareWave(x, blur));
    case Pattern::kChecks: {
      const float a = squareWave(x, blur), b = squareWave(y, blur);
      return mix(a + b - 2 * a * b);
    }
    case Pattern::kTiles: {
      const float grout = std::max(lineCover(x, .015f, blur), lineCover(y, .015f, blur));
      const float tone = .92f + .08f * cellNoise(int(std::floor(x)), int(std::floor(y)));
      return mix(grout) * tone;
    }
    case Pattern::kPlanks: {
      // Boards along u, `period` wide and seven times as long, with grain and a dark joint.
      const int row = int(std::floor(y));
      const float along = x / 7 + cellNoise(row, 17);
      const int board = int(std::floor(along));
      const float tone = cellNoise(row, board * 31 + 5);
      const float grain_u = u * 3 + 100 * tone, grain_v = v * 45;
      const float fine = std::clamp(1.5f - footprint * 45, 0.f, 1.f);
      const float grain = fine > 0 ? .5f + fine * (valueNoise(grain_u, grain_v) - .5f) : .5f;
      const float joint = std::max(lineCover(y, .004f / m.period_m, blur),
                                   .7f * lineCover(along, .0006f, blur / 7));
      return mix(.45f * tone + .45f * grain) * (1 - .55f * joint);
    }
    case Pattern::kNoise: {
      const float fine = std::clamp(1.5f - 2 * blur, 0.f, 1.f),
                  middle = std::clamp(1.5f - blur, 0.f, 1.f);
      float t = .5f;
      if (middle > 0) t += .7f * middle * (valueNoise(x, y) - .5f);
      if (fine > 0) t += .5f * fine * (valueNoise(2.7f * x + 9, 2.7f * y) - .5f);
      return mix(std::clamp(t, 0.f, 1.f));
    }
  }
  return m.colour_a;
}

/// Linear values of the 256 codes.
const std::array<float, 256>& linearFromByte() {
  static const std::array<float, 256> table = [] {
    std::array<float, 256> t;
    for (int i = 0; i < 256; ++i) t[size_t(i)] = linearFromSrgb(float(i) / 255);
    return t;
  }();
  return table;
}

uint8_t byteFromLinear(float x) {
  static const std::array<uint8_t, 4096> table = [] {
    std::array<uint8_t, 4096> t;
    for (int i = 0; i < 4096; ++i)
      t[size_t(i)] = uint8_t(std::lround(255 * srgbFromLinear(float(i) / 4095)));
    return t;
  }();
  return table[size_t(std::clamp(int(x * 4095 + .5f), 0, 4095))];
}

/// A texture and its halvings, averaged in linear light.
class MipTexture {
 public:
  explicit MipTexture(std::shared_ptr<const Texture> base) : base_(std::move(base)) {
    levels_.push_back({base_->width, base_->height, base_->rgba.data()});
    std::vector<size_t> start;
    size_t bytes = 0;
    for (int w = base_->width, h = base_->height; w > 1 || h > 1;) {
      w = std::max(1, w / 2), h = std::max(1, h / 2);
      start.push_back(bytes), bytes += size_t(w) * size_t(h) * 4;
    }
    smaller_.resize(bytes);
    for (size_t at : start) {
      const Level big = levels_.back();
      const Level small{std::max(1, big.width / 2), std::max(1, big.height / 2), &smaller_[at]};
      halve(big, small, &smaller_[at]);
      levels_.push_back(small);
    }
  }

  Vector2f size() const { return {float(base_->width), float(base_->height)}; }

  /// Linear colour, with `texels` of the full size in the footprint.
  Vector3f colour(const Vector2f& uv, float texels) const {
    int exponent = 0;  // of sqrt(2) * texels: the level whose texels are nearest in size
    if (texels > .7f) std::frexp(texels * 1.414f, &exponent);
    const Level& l = levels_[size_t(std::clamp(exponent - 1, 0, int(levels_.size()) - 1))];
    const std::array<float, 256>& linear = linearFromByte();
    Vector3f sum = Vector3f::Zero();
    visit(l, uv, [&](const uint8_t* p, float weight) {
      sum += weight * Vector3f(linear[p[0]], linear[p[1]], linear[p[2]]);
    });
    return sum;
  }

  float coverage(const Vector2f& uv) const {
    float sum = 0;
    visit(levels_[0], uv, [&](const uint8_t* p, float weight) { sum += weight * float(p[3]); });
    return sum / 255;
  }
  bool hasAlpha() const { return base_->has_alpha; }

 private:
  struct Level {
    int width, height;
    const uint8_t* data;
  };

  static void halve(const Level& big, const Level& small, uint8_t* out) {
    const std::array<float, 256>& linear = linearFromByte();
    for (int y = 0; y < small.height; ++y)
      for (int x = 0; x < small.width; ++x, out += 4) {
        std::array<float, 4> sum = {};
        for (int k = 0; k < 4; ++k) {
          const int bx = std::min(2 * x + (k & 1), big.width - 1);
          const int by = std::min(2 * y + (k >> 1), big.height - 1);
          const uint8_t* p = big.data + (size_t(by) * size_t(big.width) + size_t(bx)) * 4;
          for (size_t c = 0; c < 3; ++c) sum[c] += linear[p[c]];
          sum[3] += float(p[3]);
        }
        for (size_t c = 0; c < 3; ++c) out[c] = byteFromLinear(sum[c] / 4);
        out[3] = uint8_t(sum[3] / 4 + .5f);
      }
  }

  /// The four texels round uv with their bilinear weights; repeats, v up.
  template <typename Visit>
  static void visit(const Level& l, const Vector2f& uv, Visit take) {
    const float x = fraction(uv.x()) * float(l.width) - .5f;
    const float y = (1 - fraction(uv.y())) * float(l.height) - .5f;
    const float fx = std::floor(x), fy = std::floor(y), u = x - fx, v = y - fy;
    const auto wrap = [](int i, int n) { return i < 0 ? i + n : i >= n ? i - n : i; };
    const int x0 = wrap(int(fx), l.width), x1 = wrap(int(fx) + 1, l.width);
    const int y0 = wrap(int(fy), l.height), y1 = wrap(int(fy) + 1, l.height);
    const auto texel = [&](int i, int j) {
      return l.data + (size_t(j) * size_t(l.width) + size_t(i)) * 4;
    };
    take(texel(x0, y0), (1 - u) * (1 - v));
    take(texel(x1, y0), u * (1 - v));
    take(texel(x0, y1), (1 - u) * v);
    take(texel(x1, y1), u * v);
  }

  std::shared_ptr<const Texture> base_;
  std::vector<uint8_t> smaller_;
  std::vector<Level> levels_;
};

// --- directions ----------------------------------------------------------------------------------

/// Columns x, y, n: right-handed and orthonormal (Duff et al. 2017).
Eigen::Matrix3f basis(const Vector3f& n) {
  const float sign = std::copysign(1.f, n.z()), a = -1 / (sign + n.z()), b = n.x() * n.y() * a;
  Eigen::Matrix3f m;
  m.col(0) = Vector3f(1 + sign * n.x() * n.x() * a, sign * b, -sign * n.x());
  m.col(1) = Vector3f(b, sign + n.y() * n.y() * a, -n.y());
  m.col(2) = n;
  return m;
}

Vector3f cosineDirection(const Vector3f& n, const Vector2f& s) {
  const float r = std::sqrt(s.x()), a = 2 * kPi * s.y();
  return (basis(n) * Vector3f(r * std::cos(a), r * std::sin(a), std::sqrt(1 - s.x()))).normalized();
}

Vector3f uniformDirection(const Vector2f& s) {
  const float z = 1 - 2 * s.x(), r = std::sqrt(std::max(0.f, 1 - z * z)), a = 2 * kPi * s.y();
  return {r * std::cos(a), r * std::sin(a), z};
}

float fresnel(float f0, float cosine) {
  const float a = 1 - std::clamp(cosine, 0.f, 1.f), a2 = a * a;
  return f0 + (1 - f0) * a2 * a2 * a;
}

/// A reflection of the unit vector `to_eye` by GGX facets that are seen from there (Heitz 2018) and
/// what it carries apart from Fresnel's factor: the share of facets that are not masked.
Vector3f glossDirection(const Vector3f& n, const Vector3f& to_eye, float roughness,
                        const Vector2f& s, float* weight, float* facet_cosine) {
  const float alpha = std::max(roughness * roughness, 1e-3f);
  const Eigen::Matrix3f frame = basis(n);
  const Vector3f v = frame.transpose() * to_eye;
  const Vector3f vh = Vector3f(alpha * v.x(), alpha * v.y(), v.z()).normalized();
  const float flat = vh.x() * vh.x() + vh.y() * vh.y();
  const Vector3f t1 =
      flat > 1e-9f ? Vector3f(Vector3f(-vh.y(), vh.x(), 0) / std::sqrt(flat)) : Vector3f::UnitX();
  const Vector3f t2 = vh.cross(t1);
  const float r = std::sqrt(s.x()), a = 2 * kPi * s.y(), p1 = r * std::cos(a);
  const float half = .5f * (1 + vh.z());
  const float p2 = (1 - half) * std::sqrt(std::max(0.f, 1 - p1 * p1)) + half * r * std::sin(a);
  const Vector3f nh = p1 * t1 + p2 * t2 + std::sqrt(std::max(0.f, 1 - p1 * p1 - p2 * p2)) * vh;
  const Vector3f h = Vector3f(alpha * nh.x(), alpha * nh.y(), std::max(1e-6f, nh.z())).normalized();
  const Vector3f out = 2 * v.dot(h) * h - v;
  const float a2 = alpha * alpha;
  const auto lambda = [&](const Vector3f& w) {
    return .5f * (std::sqrt(1 + a2 * (1 / std::max(w.z() * w.z(), 1e-9f) - 1)) - 1);
  };
  *weight = out.z() <= 0 ? 0.f : (1 + lambda(v)) / (1 + lambda(v) + lambda(out));
  *facet_cosine = v.dot(h);
  return frame * out;
}

// --- lights --------------------------------------------------------------------------------------

/// A direction towards the light, where the shadow ray ends, and the light's irradiance on a plane
/// across the direction divided by the density of choosing it, as a factor of its radiance.
struct LightSample {
  Vector3f direction;
  float reach = 0, weight = 0;
};

struct Light {
  RoomLight shape;
  Vector3f normal = Vector3f::Zero();  // of a rectangle
  float area = 0;                      // 0: a sphere

  LightSample sample(const Vector3f& p, const Vector2f& s) const;
};

/// About the irradiance at p (normal n) from an unoccluded light, as a factor of its radiance; more
/// than zero wherever any part of it shines. Rectangles are cut in four; the softened distance
/// keeps the quarters finite next to the glass.
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

LightSample Light::sample(const Vector3f& p, const Vector2f& s) const {
  return area > 0 ? sampleRectangle(*this, p, s) : sampleSphere(shape, p, s);
}

/// Which points can be lit by the sun at all: the shadow of the panes along its direction, as a
/// bitmap.
class SunMask {
 public:
  SunMask() = default;
  SunMask(const Vector3f& towards, const std::vector<std::array<Vector3f, 3>>& panes)
      : frame_(basis(towards).transpose()), bits_(size_t(kSide * kSide)) {
    Eigen::AlignedBox2f bounds;
    for (const auto& pane : panes)
      for (const Vector3f& v : pane) bounds.extend(Vector2f((frame_ * v).head<2>()));
    low_ = bounds.min();
    scale_ = (bounds.sizes().array() + 1e-6f).inverse() * float(kSide);
    for (const auto& pane : panes) {
      Eigen::AlignedBox2f box;
      for (const Vector3f& v : pane) box.extend(cell(v));
      const Eigen::Vector2i a =
          (box.min().array() - .01f).floor().cast<int>().max(0).min(kSide - 1);
      const Eigen::Vector2i b =
          (box.max().array() + .01f).floor().cast<int>().max(0).min(kSide - 1);
      for (int y = a.y(); y <= b.y(); ++y)
        for (int x = a.x(); x <= b.x(); ++x) bits_[size_t(y * kSide + x)] = 1;
    }
  }

  bool mayShineOn(const Vector3f& p) const {
    if (bits_.empty()) return false;
    const Vector2f c = cell(p);
    if (!(c.x() >= 0 && c.y() >= 0 && c.x() < kSide && c.y() < kSide)) return false;
    return bits_[size_t(int(c.y()) * kSide + int(c.x()))];
  }

 private:
  static constexpr int kSide = 256;
  Vector2f cell(const Vector3f& p) const {
    return ((frame_ * p).head<2>() - low_).cwiseProduct(scale_);
  }
  Eigen::Matrix3f frame_ = Eigen::Matrix3f::Identity();
  Vector2f low_, scale_;
  std::vector<uint8_t> bits_;
};

// --- tone ----------------------------------------------------------------------------------------

float displayFromLinear(float x) {
  // A slight toe, then linear, then a long shoulder: windows burn out softly.
  constexpr float kKnee = .35f, kToe = .02f;
  x = std::max(x, 0.f);
  x = x * (x + kToe * .5f) / (x + kToe);
  if (x > kKnee) x = kKnee + (1 - kKnee) * (1 - std::exp(-(x - kKnee) / (1 - kKnee)));
  return srgbFromLinear(std::min(x, 1.f));
}

// --- the cache of light --------------------------------------------------------------------------

/// Irradiance in cells of space by the side a surface faces, coarser where there is little known.
/// Room frame, so that the cells lie along the walls.
class LightCache {
 public:
  struct Sample {
    Vector3f position = Vector3f::Zero(), normal = Vector3f::Zero();  // room frame
    Vector3f direct = Vector3f::Zero();  // irradiance, without what comes straight from the sun
    Vector3f sun = Vector3f::Zero();     // irradiance straight from the sun
    Vector3f albedo = Vector3f::Zero();  // of the surface here
    // The next sample along a cosine-distributed path from here, what the path carries on the way,
    // and whether it also brings the sun that shines there.
    int32_t link = kUnknown;
    Vector3f link_weight = Vector3f::Zero();
    bool link_sees_spots = false;
  };
  static constexpr int32_t kUnknown = -1, kDark = -2;

  LightCache() = default;
  explicit LightCache(const std::vector<Sample>& samples);

  /// Irradiance, without what comes straight from the sun; room frame. `capped`: without the
  /// excess.
  Vector3f at(const Vector3f& position, const Vector3f& normal, bool capped) const {
    for (int level = 0; level < kLevels; ++level) {
      const int32_t cell = find(cellKey(position, normal, level));
      if (cell < 0) continue;
      const Vector3f& e = irradiance_[size_t(cell)];
      return capped && level == 0 ? Vector3f(e * keptShare(e)) : e;
    }
    return mean_;
  }

  /// What at() leaves out when capped: irradiance far above the room's mean, near lamps and
  /// windows.
  Vector3f excess(const Vector3f& position, const Vector3f& normal) const {
    const int32_t cell = find(cellKey(position, normal, 0));
    if (cell < 0) return Vector3f::Zero();
    const Vector3f& e = irradiance_[size_t(cell)];
    return e * (1 - keptShare(e));
  }
  const Vector3f& mean() const { return mean_; }

 private:
  static constexpr int kLevels = 5;
  static constexpr float kCap = 1;    // irradiance that is not excess, of the mean
  static constexpr float kPrior = 6;  // samples that the next coarser cell counts for

  static uint64_t cellKey(const Vector3f& p, const Vector3f& n, int level) {
    int axis = 0;
    n.cwiseAbs().maxCoeff(&axis);
    const uint64_t side = uint64_t(2 * axis + (n[axis] > 0));
    // Half a cell off the surface: both faces of a thin board are apart, and surfaces that lie in a
    // boundary of cells stay on one side of it.
    const float edge = kCacheCell * float(1 << level);
    const Vector3f q = p / edge + .5f * n;
    uint64_t key = uint64_t(level + 1) << 3 | side;
    for (int a = 0; a < 3; ++a)
      key = key << 18 | (uint64_t(int64_t(std::floor(q[a])) + (1 << 17)) & 0x3ffffu);
    return key;
  }
  float keptShare(const Vector3f& irradiance) const {
    return std::min(1.f, kCap * mean_.sum() / std::max(irradiance.sum(), 1e-12f));
  }
  size_t slot(uint64_t key) const { return size_t(key * 0x9e3779b97f4a7c15ull >> shift_); }
  int32_t find(uint64_t key) const {
    for (size_t i = slot(key); table_[i].cell >= 0; i = (i + 1) & (table_.size() - 1))
      if (table_[i].key == key) return table_[i].cell;
    return -1;
  }

  struct Entry {
    uint64_t key = 0;
    int32_t cell = -1;
  };
  std::vector<Entry> table_;
  int shift_ = 63;
  std::vector<Vector3f> irradiance_;
  Vector3f mean_ = Vector3f::Zero();
};

LightCache::LightCache(const std::vector<Sample>& samples) {
  const size_t count = samples.size();
  int bits = 4;
  while (size_t(1) << bits < count * 3) ++bits;
  table_.resize(size_t(1) << bits);
  shift_ = 64 - bits;
  // Cells are numbered in the order of samples, each after those of its coarser levels.
  std::vector<std::array<int32_t, kLevels>> cells(count);
  std::vector<int32_t> parent;
  for (size_t s = 0; s < count; ++s)
    for (int level = kLevels - 1; level >= 0; --level) {
      const uint64_t key = cellKey(samples[s].position, samples[s].normal, level);
      size_t i = slot(key);
      while (table_[i].cell >= 0 && table_[i].key != key) i = (i + 1) & (table_.size() - 1);
      if (table_[i].cell < 0) {
        table_[i] = {key, int32_t(parent.size())};
        parent.push_back(level + 1 < kLevels ? cells[s][size_t(level + 1)] : -1);
      }
      cells[s][size_t(level)] = table_[i].cell;
    }
  const size_t cell_count = parent.size();
  std::vector<Vector3f> direct(cell_count, Vector3f::Zero()), bounced(cell_count);
  std::vector<float> weight(cell_count, 0), links(cell_count, 0);
  Vector3f direct_mean = Vector3f::Zero();
  float link_count = 0;
  for (size_t s = 0; s < count; ++s) {
    direct_mean += samples[s].direct;
    link_count += samples[s].link != kUnknown;
    for (int32_t c : cells[s]) {
      direct[size_t(c)] += samples[s].direct, weight[size_t(c)] += 1;
      links[size_t(c)] += samples[s].link != kUnknown;
    }
  }
  direct_mean /= std::max(1.f, float(count));
  for (size_t c = 0; c < cell_count; ++c) {
    const Vector3f& prior = parent[c] < 0 ? direct_mean : direct[size_t(parent[c])];
    direct[c] = (direct[c] + kPrior * prior) / (weight[c] + kPrior);
  }
  // Each round adds a bounce to what the links bring.
  irradiance_ = direct;
  for (int bounce = 0; bounce < 24; ++bounce) {
    std::fill(bounced.begin(), bounced.end(), Vector3f::Zero());
    Vector3f bounced_mean = Vector3f::Zero();
    for (size_t s = 0; s < count; ++s) {
      if (samples[s].link < 0) continue;
      const Sample& next = samples[size_t(samples[s].link)];
      Vector3f light = irradiance_[size_t(cells[size_t(samples[s].link)][0])];
      if (samples[s].link_sees_spots) light += next.sun;
      light = light.cwiseProduct(samples[s].link_weight).cwiseProduct(next.albedo);
      bounced_mean += light;
      for (int32_t c : cells[s]) bounced[size_t(c)] += light;
    }
    bounced_mean /= std::max(1.f, link_count);
    float change = 0, total = 0;
    for (size_t c = 0; c < cell_count; ++c) {
      const Vector3f& prior = parent[c] < 0 ? bounced_mean : bounced[size_t(parent[c])];
      bounced[c] = (bounced[c] + kPrior * prior) / (links[c] + kPrior);
      const Vector3f next = direct[c] + bounced[c];
      change += (next - irradiance_[c]).sum(), total += next.sum();
      irradiance_[c] = next;
    }
    mean_ = direct_mean + bounced_mean;
    if (change <= 1e-3f * total) break;
  }
}

// --- rays ----------------------------------------------------------------------------------------

struct Packet {
  alignas(64) RTCRayHit16 query;
  alignas(64) std::array<int, kPacket> valid;
  std::array<Vector3f, kPacket> passed;  // by a shadow ray through glass

  Packet() { valid.fill(0); }
  void set(int k, const Vector3f& o, const Vector3f& d, float tfar) {
    RTCRay16& r = query.ray;
    r.org_x[k] = o.x(), r.org_y[k] = o.y(), r.org_z[k] = o.z();
    r.dir_x[k] = d.x(), r.dir_y[k] = d.y(), r.dir_z[k] = d.z();
    r.tnear[k] = 0, r.tfar[k] = tfar, r.time[k] = 0;
    r.mask[k] = ~0u, r.id[k] = unsigned(k), r.flags[k] = 0;
    query.hit.geomID[k] = RTC_INVALID_GEOMETRY_ID;
    query.hit.instID[0][k] = RTC_INVALID_GEOMETRY_ID;
    passed[size_t(k)].setOnes();
    valid[size_t(k)] = -1;
  }
  bool hit(int k) const {
    return valid[size_t(k)] && query.hit.geomID[k] != RTC_INVALID_GEOMETRY_ID;
  }
  bool occluded(int k) const { return query.ray.tfar[k] < 0; }
};

/// A ray on its way, with what it will bring to `slot`.
struct Path {
  Vector3f origin, direction, throughput;
  uint32_t slot = 0, key = 0, sample = 0;
  float width = 0, spread = 0;  // footprint: metres, metres a metre
  float travelled = 0;          // metres since its last diffuse bounce
  bool sees_spots = true;       // brings the light of spots at any distance
  int16_t depth = 0;
  bool sees_emission = true;  // the eye's ray and its mirror images
  bool may_gather = false;    // reads the cache where it ends
};

struct Shadow {
  Vector3f origin, direction, value;
  float reach = 0;
  uint32_t slot = 0;
};

/// A spot of sunlight or of other light far above the room's mean, which lights the room in turn:
/// all those farther off than kCacheReach are sampled as lights, as chance would seldom find them.
/// Nearer ones are left to the bounces.
struct Spot {
  Vector3f position, normal, power;  // power: what it reflects, over pi
  float specular = 0;
};

struct Hit {
  Vector3f position, normal, shading_normal;  // both face the ray's origin
  Vector3f colour;
  const Material* material = nullptr;
  float distance = 0, width = 0;
};

/// Light that passes a translucent surface of this colour: clear glass does not darken, whatever
/// its colour's brightness.
Vector3f tint(const Vector3f& colour, float opacity) {
  const float top = colour.maxCoeff();
  return top > 0 ? Vector3f((1 - opacity) / top * colour) : Vector3f::Constant(1 - opacity);
}

}  // namespace

// --- the renderer --------------------------------------------------------------------------------

struct RoomRenderer::Impl {
  /// What Embree hands to our filters.
  struct Query {
    RTCIntersectContext context;
    const Impl* renderer;
    Packet* packet;
    bool only_solid;  // glass is seen through
  };
  /// What Embree asks its filters about.
  struct Candidate {
    int32_t triangle;
    size_t material;
    float u, v;
    unsigned ray;  // in the packet
  };

  SurfaceMesh surface;
  std::vector<std::unique_ptr<MipTexture>> textures;
  std::vector<const MipTexture*> texture_of;            // [materials], null: a pattern
  std::array<std::vector<Eigen::Vector3i>, 2> corners;  // opaque; with holes or translucent
  std::array<std::vector<int32_t>, 2> triangle;         // of a geometry's primitive
  std::vector<float> texels_per_metre;                  // [T]
  RTCScene scene = nullptr;
  std::vector<Light> lights;
  Sun sun;
  std::vector<uint8_t> is_pane;  // [T] the sun comes in here
  std::vector<std::array<Vector3f, 3>> panes;
  SunMask sun_mask;
  Eigen::Isometry3f room_from_world;
  std::vector<Vector3f> origins;  // in the air: where the cache's paths begin

  // Made on first use: depth alone needs neither.
  mutable std::once_flag light_once, target_once;
  mutable LightCache cache;
  mutable std::vector<Spot> spots;  // of the same power each; neighbours are near each other
  mutable float exposure = 1;
  mutable std::unique_ptr<RayTarget> target;
  mutable std::atomic<int64_t> rays{0};

  explicit Impl(const Room& room);
  ~Impl() { rtcReleaseScene(scene); }
  void prepareTextures();
  void buildScene();
  void prepareSun(const Room& room);
  void addSunlitSpots() const;
  void addBrightSpots() const;
  void spreadSpots() const;

  void intersect(Packet* packet, bool coherent, bool only_solid) const;
  void occlude(Packet* packet) const;
  /// Takes those hits away that `rejects(query, hit)`.
  template <typename Rejects>
  static void filterHits(const RTCFilterFunctionNArguments* args, const Rejects& rejects);
  /// The texture has a hole there.
  bool isCutOut(const Candidate& hit) const;
  static void intersectFilter(const RTCFilterFunctionNArguments* args);
  static void occlusionFilter(const RTCFilterFunctionNArguments* args);

  int32_t triangleOf(unsigned geometry, unsigned primitive) const {
    return triangle[geometry][primitive];
  }
  Vector2f uvAt(int32_t t, float u, float v) const {
    const auto& uv = surface.uv[size_t(t)];
    return (1 - u - v) * uv[0] + u * uv[1] + v * uv[2];
  }
  Vector3f colourAt(int32_t t, float u, float v, float footprint) const;
  Hit hitAt(const Packet& packet, int k, float width, float spread) const;

  /// Traces the paths and calls body(index, hit) in their order; hit is null where nothing is met.
  template <typename Body>
  void forHits(const std::vector<Path>& paths, bool coherent, Body body) const {
    for (size_t first = 0; first < paths.size(); first += kPacket) {
      const int lanes = int(std::min(size_t(kPacket), paths.size() - first));
      Packet packet;
      for (int k = 0; k < lanes; ++k) {
        const Path& p = paths[first + size_t(k)];
        packet.set(k, p.origin, p.direction, INFINITY);
      }
      intersect(&packet, coherent, false);
      for (int k = 0; k < lanes; ++k) {
        const size_t i = first + size_t(k);
        if (packet.hit(k)) {
          const Hit hit = hitAt(packet, k, paths[i].width, paths[i].spread);
          body(i, &hit);
        } else {
          body(i, static_cast<const Hit*>(nullptr));
        }
      }
    }
    rays += int64_t(paths.size());
  }

  enum class Event { kEnd, kContinue, kDiffuse };
  Event scatter(const Hit& hit, const Vector2f& choice, const Vector2f& direction,
                Path* path) const;
  static bool bounce(const Hit& hit, uint32_t key, Path* path);
  void addSun(const Hit& hit, const Vector3f& reflectance, uint32_t slot,
              std::vector<Shadow>* suns) const;
  void addSpot(const Hit& hit, const Vector3f& reflectance, uint32_t key, uint32_t sample,
               uint32_t slot, std::vector<Shadow>* shadows) const;
  void addLight(const Hit& hit, const Vector3f& reflectance, uint32_t key, uint32_t sample,
                uint32_t slot, std::vector<Shadow>* shadows) const;
  void traceShadows(const std::vector<Shadow>& shadows, Vector3f* sums) const;
  void traceSun(std::vector<Shadow>* suns, Vector3f* sums) const;

  struct Work;
  void tracePaths(Work* work, bool coherent) const;
  void shade(const Hit& hit, const Path& path, Work* work) const;
  void startGloss(const Hit& hit, const Path& path, Work* work) const;

  std::vector<LightCache::Sample> traceChains(uint32_t block) const;
  void lightRoom() const;
  void setExposure(const std::vector<LightCache::Sample>& samples) const;
  void prepareLight() const {
    // Isolated: a thread that waits in here must not take up another picture that waits for this.
    std::call_once(light_once, [&] { tbb::this_task_arena::isolate([&] { lightRoom(); }); });
  }
};

struct RoomRenderer::Impl::Work {
  std::vector<Path> now, next;
  std::vector<Shadow> shadows, suns;
  std::vector<Vector3f> sums;
};

RoomRenderer::Impl::Impl(const Room& room)
    : surface(room.surface),
      sun(room.sun),
      room_from_world(room.world_from_room.inverse()),
      origins(freePoints(room, 512, 1)) {
  const size_t count = surface.mesh.triangles.size(), vertex_count = surface.mesh.vertices.size();
  require(surface.material.size() == count && surface.uv.size() == count &&
              surface.normal.size() == count,
          "RoomRenderer: ", room.name, ": expected material, uv and normals of each of ", count,
          " triangles, found ", surface.material.size(), ", ", surface.uv.size(), " and ",
          surface.normal.size());
  for (size_t i = 0; i < vertex_count; ++i)
    require(surface.mesh.vertices[i].allFinite(), "RoomRenderer: ", room.name, ": vertex ", i,
            " is not finite");
  for (size_t i = 0; i < count; ++i) {
    const Eigen::Vector3i& t = surface.mesh.triangles[i];
    require(t.minCoeff() >= 0 && size_t(t.maxCoeff()) < vertex_count, "RoomRenderer: ", room.name,
            ": triangle ", i, ": expected corners below ", vertex_count, ", found ", t.transpose());
    require(surface.material[i] >= 0 && size_t(surface.material[i]) < surface.materials.size(),
            "RoomRenderer: ", room.name, ": triangle ", i, ": expected a material below ",
            surface.materials.size(), ", found ", surface.material[i]);
  }
  for (const RoomLight& l : room.lights) {
    Light light{l, Vector3f::Zero(), 0};
    const Vector3f n = l.half_u.cross(l.half_v);
    light.area = 4 * n.norm();
    if (light.area > 0) light.normal = n.normalized();
    require(std::abs(l.half_u.dot(l.half_v)) <= .01f * l.half_u.norm() * l.half_v.norm(),
            "RoomRenderer: ", room.name, ": light: expected a rectangle, found a parallelogram");
    if (l.radiance.maxCoeff() > 0) lights.push_back(light);
  }
  prepareTextures();
  buildScene();
  prepareSun(room);
}

void RoomRenderer::Impl::prepareTextures() {
  std::map<const Texture*, size_t> index;
  std::vector<std::shared_ptr<const Texture>> unique;
  for (const Material& m : surface.materials)
    if (m.texture && index.emplace(m.texture.get(), unique.size()).second) {
      require(
          m.texture->width > 0 && m.texture->height > 0 &&
              m.texture->rgba.size() == size_t(m.texture->width) * size_t(m.texture->height) * 4,
          "RoomRenderer: texture: expected ", m.texture->width, " x ", m.texture->height,
          " x 4 bytes, found ", m.texture->rgba.size());
      unique.push_back(m.texture);
    }
  textures.resize(unique.size());
  tbb::parallel_for(size_t(0), unique.size(),
                    [&](size_t i) { textures[i] = std::make_unique<MipTexture>(unique[i]); });
  for (const Material& m : surface.materials)
    texture_of.push_back(m.texture ? textures[index.at(m.texture.get())].get() : nullptr);
}

void RoomRenderer::Impl::buildScene() {
  std::vector<Vector3f>& vertices = surface.mesh.vertices;
  const size_t vertex_count = vertices.size(), count = surface.mesh.triangles.size();
  vertices.reserve(vertex_count + 2);  // Embree reads 16 bytes a vertex
  texels_per_metre.resize(count);
  for (size_t i = 0; i < count; ++i) {
    const size_t m = size_t(surface.material[i]);
    const bool filtered =
        surface.materials[m].opacity < 1 || (texture_of[m] && texture_of[m]->hasAlpha());
    const Eigen::Vector3i& t = surface.mesh.triangles[i];
    corners[filtered].push_back(t);
    triangle[filtered].push_back(int32_t(i));
    if (!texture_of[m]) continue;
    const Vector3f &a = vertices[size_t(t[0])], &b = vertices[size_t(t[1])],
                   &c = vertices[size_t(t[2])];
    const auto& uv = surface.uv[i];
    const Vector2f p = (uv[1] - uv[0]).cwiseProduct(texture_of[m]->size());
    const Vector2f q = (uv[2] - uv[0]).cwiseProduct(texture_of[m]->size());
    texels_per_metre[i] = std::sqrt(std::abs(p.x() * q.y() - p.y() * q.x()) /
                                    std::max((b - a).cross(c - a).norm(), 1e-12f));
  }
  scene = rtcNewScene(embreeDevice());
  for (unsigned g = 0; g < 2; ++g) {
    RTCGeometry geometry = rtcNewGeometry(embreeDevice(), RTC_GEOMETRY_TYPE_TRIANGLE);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                               vertices.data(), 0, sizeof(Vector3f), vertex_count);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                               corners[g].data(), 0, sizeof(Eigen::Vector3i), corners[g].size());
    if (g == 1) {
      rtcSetGeometryIntersectFilterFunction(geometry, intersectFilter);
      rtcSetGeometryOccludedFilterFunction(geometry, occlusionFilter);
    }
    rtcCommitGeometry(geometry);
    rtcAttachGeometryByID(scene, geometry, g);
    rtcReleaseGeometry(geometry);
  }
  rtcCommitScene(scene);
  const RTCError error = rtcGetDeviceError(embreeDevice());
  require(error == RTC_ERROR_NONE, "RoomRenderer: Embree: error ", int(error));
}

/// Panes are emissive triangles in a rectangular light that is no ceiling panel; a lamp's shade
/// glows too, but the sun does not come in through it.
void RoomRenderer::Impl::prepareSun(const Room& room) {
  const size_t count = surface.mesh.triangles.size();
  is_pane.assign(count, 0);
  if (room.sun.irradiance.maxCoeff() <= 0) return;
  for (size_t i = 0; i < count; ++i) {
    if (surface.materials[size_t(surface.material[i])].emission <= 0) continue;
    std::array<Vector3f, 3> c;
    for (int k = 0; k < 3; ++k)
      c[size_t(k)] = surface.mesh.vertices[size_t(surface.mesh.triangles[i][k])];
    const Vector3f middle = (c[0] + c[1] + c[2]) / 3;
    for (const Light& light : lights) {
      if (light.area <= 0 || light.normal.z() < -.95f || light.normal.dot(sun.towards) >= 0)
        continue;
      const Vector3f d = middle - light.shape.centre;
      const auto along = [&](const Vector3f& half) {
        return std::abs(d.dot(half)) / half.squaredNorm();
      };
      if (std::abs(d.dot(light.normal)) < .3f && along(light.shape.half_u) < 1.2f &&
          along(light.shape.half_v) < 1.2f)
        is_pane[i] = 1;
    }
    if (is_pane[i]) panes.push_back(c);
  }
  if (!panes.empty()) sun_mask = SunMask(sun.towards, panes);
}

/// Follows the sun from points of the panes to what it shines on.
void RoomRenderer::Impl::addSunlitSpots() const {
  std::vector<float> end;  // of each pane in the running total of area across the sun
  float area = 0;
  for (const auto& p : panes)
    end.push_back(area += .5f * std::abs((p[1] - p[0]).cross(p[2] - p[0]).dot(sun.towards)));
  if (area <= 0) return;
  std::vector<Path> paths;
  for (size_t i = 0; i < kSpots; ++i) {
    const float at = area * (float(i) + .5f) / float(kSpots);
    const auto& p = panes[std::min(
        size_t(std::upper_bound(end.begin(), end.end(), at) - end.begin()), panes.size() - 1)];
    const Vector2f s = sample2(5, uint32_t(i));
    const float root = std::sqrt(s.x());
    Path path;
    path.origin =
        (1 - root) * p[0] + root * (1 - s.y()) * p[1] + root * s.y() * p[2] - kOffset * sun.towards;
    path.direction = -sun.towards;
    path.throughput = area / (float(kSpots) * kPi) * sun.irradiance;
    path.width = .01f;
    paths.push_back(path);
  }
  for (std::vector<Path> next; !paths.empty(); std::swap(paths, next), next.clear()) {
    forHits(paths, true, [&](size_t i, const Hit* hit) {
      if (!hit || hit->material->emission > 0) return;
      const Material& m = *hit->material;
      Path path = paths[i];
      // The area lit is that across the sun over the cosine, which the shading normal may change.
      const float bend = hit->shading_normal.dot(sun.towards) / hit->normal.dot(sun.towards);
      const Vector3f power =
          std::max(0.f, bend) * m.opacity * path.throughput.cwiseProduct(hit->colour);
      if (power.maxCoeff() > 0)
        spots.push_back({hit->position + kOffset * hit->normal, hit->normal, power, m.specular});
      if (m.opacity >= kSolidOpacity) return;
      path.throughput = path.throughput.cwiseProduct(tint(hit->colour, m.opacity));
      path.origin = hit->position - kOffset * hit->normal;
      next.push_back(path);
    });
  }
}

/// Samples the surface for the cache's excess, more densely where triangles lie in it.
void RoomRenderer::Impl::addBrightSpots() const {
  const size_t count = surface.mesh.triangles.size();
  const float scale = 1 / std::max(cache.mean().sum(), 1e-12f);
  const auto excess = [&](const Vector3f& p, const Vector3f& n) {
    return cache.excess(room_from_world * p, room_from_world.linear() * n);
  };
  struct Triangle {
    Vector3f a, u, v, normal;
    float area;
  };
  const auto triangleAt = [&](size_t i) {
    const Eigen::Vector3i& t = surface.mesh.triangles[i];
    Triangle out;
    out.a = surface.mesh.vertices[size_t(t[0])];
    out.u = surface.mesh.vertices[size_t(t[1])] - out.a;
    out.v = surface.mesh.vertices[size_t(t[2])] - out.a;
    out.normal = out.u.cross(out.v);
    out.area = out.normal.norm() / 2;
    out.normal /= std::max(2 * out.area, 1e-20f);
    return out;
  };
  std::vector<float> end(count);  // running total of what triangles weigh
  tbb::parallel_for(tbb::blocked_range<size_t>(0, count, 1024), [&](const auto& range) {
    for (size_t i = range.begin(); i < range.end(); ++i) {
      const Triangle t = triangleAt(i);
      const Vector3f middle = t.a + (t.u + t.v) / 3;
      const float seen = (excess(middle, t.normal) + excess(middle, -t.normal)).sum();
      end[i] = t.area * (std::min(seen * scale, 8.f) + .15f);
    }
  });
  double total = 0;
  for (float& e : end) total += double(e), e = float(total);
  if (!(total > 0)) return;
  constexpr size_t kPoints = 1 << 16;
  std::vector<Spot> found(2 * kPoints);
  tbb::parallel_for(tbb::blocked_range<size_t>(0, kPoints, 1024), [&](const auto& range) {
    for (size_t k = range.begin(); k < range.end(); ++k) {
      const float at = float(total * (double(k) + .5) / double(kPoints));
      const size_t i =
          std::min(size_t(std::upper_bound(end.begin(), end.end(), at) - end.begin()), count - 1);
      const Triangle t = triangleAt(i);
      const Material& m = surface.materials[size_t(surface.material[i])];
      if (m.emission > 0 || t.area <= 0) continue;
      const Vector2f s = sample2(6, uint32_t(k));
      const float root = std::sqrt(s.x()), u = root * (1 - s.y()), v = root * s.y();
      const MipTexture* texture = texture_of[size_t(surface.material[i])];
      if (texture && texture->hasAlpha() && texture->coverage(uvAt(int32_t(i), u, v)) < .5f)
        continue;
      const Vector3f p = t.a + u * t.u + v * t.v;
      const auto& n = surface.normal[i];
      Vector3f shading = (1 - u - v) * n[0] + u * n[1] + v * n[2];
      if (shading.dot(t.normal) < 0) shading = -shading;
      shading = shading.norm() > 1e-3f ? Vector3f(shading.normalized()) : t.normal;
      const float weight = end[i] - (i > 0 ? end[i - 1] : 0.f);
      if (weight <= 0) continue;
      const float area = float(total) / float(kPoints) * t.area / weight;
      for (size_t side = 0; side < 2; ++side) {
        const float sign = side ? -1.f : 1.f;
        const Vector3f e = excess(p, sign * shading);
        if (e.isZero()) continue;
        const Vector3f power =
            area * m.opacity / kPi * e.cwiseProduct(colourAt(int32_t(i), u, v, .05f));
        found[2 * k + side] = {p + sign * kOffset * t.normal, sign * t.normal, power, m.specular};
      }
    }
  });
  for (const Spot& spot : found)
    if (spot.power.sum() > 0) spots.push_back(spot);
}

/// Brings the spots to a fixed number of equal power, and in an order that keeps neighbours
/// together, so that well-spread numbers choose well-spread spots.
void RoomRenderer::Impl::spreadSpots() const {
  std::vector<std::pair<uint64_t, size_t>> order;
  double total = 0;
  for (size_t i = 0; i < spots.size(); ++i) {
    const Vector3f p = room_from_world * spots[i].position;
    uint64_t code = 0;  // Morton's
    for (int bit = 15; bit >= 0; --bit)
      for (int a = 0; a < 3; ++a)
        code = code << 1 | (uint64_t(int64_t(p[a] * 64) + (1 << 15)) >> bit & 1);
    order.emplace_back(code, i);
    total += double(spots[i].power.sum());
  }
  std::sort(order.begin(), order.end());
  std::vector<Spot> spread;
  double passed = 0;
  for (const auto& [code, i] : order) {
    const double power = double(spots[i].power.sum());
    passed += power;
    while ((double(spread.size()) + .5) * total < passed * double(kSpots)) {
      spread.push_back(spots[i]);
      spread.back().power *= float(total / (double(kSpots) * power));
    }
  }
  spots = spread;
}

void RoomRenderer::Impl::intersect(Packet* packet, bool coherent, bool only_solid) const {
  Query query{{}, this, packet, only_solid};
  rtcInitIntersectContext(&query.context);
  query.context.flags =
      coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
  if (RayLog* log = ray_log.load(std::memory_order_relaxed))
    log->add(packet->valid.data(), packet->query.ray, coherent, false);
  rtcIntersect16(packet->valid.data(), scene, &query.context, &packet->query);
}

void RoomRenderer::Impl::occlude(Packet* packet) const {
  Query query{{}, this, packet, false};
  rtcInitIntersectContext(&query.context);
  // Of coherent packets Embree tells the filter of the same triangle several times, and glass would
  // darken several times.
  query.context.flags = RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
  if (RayLog* log = ray_log.load(std::memory_order_relaxed))
    log->add(packet->valid.data(), packet->query.ray, false, true);
  rtcOccluded16(packet->valid.data(), scene, &query.context, &packet->query.ray);
}

template <typename Rejects>
void RoomRenderer::Impl::filterHits(const RTCFilterFunctionNArguments* args,
                                    const Rejects& rejects) {
  const Query& query = *reinterpret_cast<const Query*>(args->context);
  const Impl& self = *query.renderer;
  for (unsigned i = 0; i < args->N; ++i) {
    if (args->valid[i] != -1) continue;
    Candidate hit;
    hit.triangle = self.triangle[1][RTCHitN_primID(args->hit, args->N, i)];
    hit.material = size_t(self.surface.material[size_t(hit.triangle)]);
    hit.u = RTCHitN_u(args->hit, args->N, i), hit.v = RTCHitN_v(args->hit, args->N, i);
    hit.ray = RTCRayN_id(args->ray, args->N, i);
    if (rejects(query, hit)) args->valid[i] = 0;
  }
}

bool RoomRenderer::Impl::isCutOut(const Candidate& hit) const {
  const MipTexture* texture = texture_of[hit.material];
  return texture && texture->hasAlpha() &&
         texture->coverage(uvAt(hit.triangle, hit.u, hit.v)) < .5f;
}

void RoomRenderer::Impl::intersectFilter(const RTCFilterFunctionNArguments* args) {
  filterHits(args, [](const Query& query, const Candidate& hit) {
    const Impl& self = *query.renderer;
    return (query.only_solid && self.surface.materials[hit.material].opacity < kSolidOpacity) ||
           self.isCutOut(hit);
  });
}

void RoomRenderer::Impl::occlusionFilter(const RTCFilterFunctionNArguments* args) {
  filterHits(args, [](const Query& query, const Candidate& hit) {
    const Impl& self = *query.renderer;
    if (self.isCutOut(hit)) return true;
    const float opacity = self.surface.materials[hit.material].opacity;
    if (!(opacity < 1)) return false;
    Vector3f& passed = query.packet->passed[hit.ray];
    passed = passed.cwiseProduct(tint(self.colourAt(hit.triangle, hit.u, hit.v, .01f), opacity));
    return true;
  });
}

Vector3f RoomRenderer::Impl::colourAt(int32_t t, float u, float v, float footprint) const {
  const size_t i = size_t(t), m = size_t(surface.material[i]);
  const Material& material = surface.materials[m];
  if (const MipTexture* texture = texture_of[m])
    return material.colour_a.cwiseProduct(
        texture->colour(uvAt(t, u, v), footprint * texels_per_metre[i]));
  if (material.pattern == Pattern::kPlain) return material.colour_a;
  const Vector2f at = uvAt(t, u, v);
  return pattern(material, at.x(), at.y(), footprint);
}

Hit RoomRenderer::Impl::hitAt(const Packet& packet, int k, float width, float spread) const {
  const RTCRay16& r = packet.query.ray;
  const RTCHit16& h = packet.query.hit;
  const int32_t t = triangleOf(h.geomID[k], h.primID[k]);
  const Vector3f d(r.dir_x[k], r.dir_y[k], r.dir_z[k]);
  const float u = h.u[k], v = h.v[k], w = 1 - u - v;
  const Eigen::Vector3i& c = surface.mesh.triangles[size_t(t)];
  const std::vector<Vector3f>& vertices = surface.mesh.vertices;
  Hit hit;
  hit.distance = r.tfar[k];
  hit.position =
      w * vertices[size_t(c[0])] + u * vertices[size_t(c[1])] + v * vertices[size_t(c[2])];
  hit.normal = Vector3f(h.Ng_x[k], h.Ng_y[k], h.Ng_z[k]).normalized();
  if (hit.normal.dot(d) > 0) hit.normal = -hit.normal;
  const auto& n = surface.normal[size_t(t)];
  hit.shading_normal = w * n[0] + u * n[1] + v * n[2];
  const float length = hit.shading_normal.norm();
  if (length > 1e-3f) {
    hit.shading_normal /= hit.shading_normal.dot(hit.normal) < 0 ? -length : length;
    if (hit.shading_normal.dot(d) > -.02f) hit.shading_normal = hit.normal;
  } else {
    hit.shading_normal = hit.normal;
  }
  hit.width = width + spread * hit.distance;
  const float cosine = std::max(std::abs(hit.normal.dot(d)), .05f);
  hit.colour = colourAt(t, u, v, hit.width / std::sqrt(cosine));
  hit.material = &surface.materials[size_t(surface.material[size_t(t)])];
  return hit;
}

/// What becomes of light that arrives, followed backwards: gloss and glass carry on, `path` is set
/// to that; emission ends it.
RoomRenderer::Impl::Event RoomRenderer::Impl::scatter(const Hit& hit, const Vector2f& choice,
                                                      const Vector2f& direction, Path* path) const {
  const Material& m = *hit.material;
  if (m.emission > 0 || ++path->depth > kMaxDepth) return Event::kEnd;
  if (m.specular > 0) {
    const float reflected = fresnel(m.specular, -hit.shading_normal.dot(path->direction));
    if (choice.x() < reflected) {
      float weight, cosine;
      const Vector3f d = glossDirection(hit.shading_normal, -path->direction, m.roughness,
                                        direction, &weight, &cosine);
      if (weight <= 0 || d.dot(hit.normal) <= 0) return Event::kEnd;
      path->throughput *= weight * fresnel(m.specular, cosine) / reflected;
      path->origin = hit.position + kOffset * hit.normal;
      path->direction = d;
      path->width = hit.width, path->spread += .5f * m.roughness * m.roughness;
      path->sees_spots = true;
      return path->throughput.maxCoeff() > 0 ? Event::kContinue : Event::kEnd;
    }
  }
  if (choice.y() >= m.opacity) {
    path->throughput = path->throughput.cwiseProduct(tint(hit.colour, m.opacity) / (1 - m.opacity));
    path->origin = hit.position - kOffset * hit.normal;
    path->width = hit.width;
    return Event::kContinue;
  }
  return Event::kDiffuse;
}

/// Sends the path on from a diffuse surface; false where it would go below the surface.
bool RoomRenderer::Impl::bounce(const Hit& hit, uint32_t key, Path* path) {
  path->direction = cosineDirection(hit.shading_normal, sample2(hash(key, 5), path->sample));
  if (path->direction.dot(hit.normal) <= 0) return false;
  path->origin = hit.position + kOffset * hit.normal;
  path->width = hit.width, path->spread = kGatherSpread;
  path->travelled = 0;
  path->sees_emission = path->sees_spots = false, path->may_gather = true;
  return true;
}

/// Queues a ray to the sun where it may shine.
void RoomRenderer::Impl::addSun(const Hit& hit, const Vector3f& reflectance, uint32_t slot,
                                std::vector<Shadow>* suns) const {
  const Vector3f origin = hit.position + kOffset * hit.normal;
  const float cosine = hit.shading_normal.dot(sun.towards);
  if (cosine > 0 && hit.normal.dot(sun.towards) > 0 && sun_mask.mayShineOn(origin))
    suns->push_back(
        {origin, sun.towards, cosine / kPi * reflectance.cwiseProduct(sun.irradiance), 0, slot});
}

/// Queues a shadow ray to a spot of sunlight: of a few that are spread over all of them, one is
/// chosen by what it would give (resampling, Talbot et al. 2005).
void RoomRenderer::Impl::addSpot(const Hit& hit, const Vector3f& reflectance, uint32_t key,
                                 uint32_t sample, uint32_t slot,
                                 std::vector<Shadow>* shadows) const {
  if (spots.empty()) return;
  constexpr size_t kCandidates = 8;
  const Vector3f origin = hit.position + kOffset * hit.normal;
  const Vector2f random = sample2(hash(key, 6), sample);
  std::array<float, kCandidates> gain;
  std::array<size_t, kCandidates> index;
  float total = 0;
  for (size_t k = 0; k < kCandidates; ++k) {
    const float at = (float(k) + random.x()) / float(kCandidates);
    index[k] = std::min(size_t(at * float(spots.size())), spots.size() - 1);
    const Spot& spot = spots[index[k]];
    const Vector3f to = spot.position - origin;
    const float d2 = to.squaredNorm(), here = hit.shading_normal.dot(to),
                there = -spot.normal.dot(to);
    gain[k] = 0;
    if (here <= 0 || there <= 0 || d2 <= kCacheReach * kCacheReach || hit.normal.dot(to) <= 0)
      continue;
    gain[k] = here * there / (d2 * d2);
    if (spot.specular > 0) gain[k] *= 1 - fresnel(spot.specular, there / std::sqrt(d2));
    gain[k] *= spot.power.sum();
    total += gain[k];
  }
  if (total <= 0) return;
  float pick = random.y() * total;
  size_t k = 0;
  while (k + 1 < kCandidates && pick >= gain[k]) pick -= gain[k++];
  if (gain[k] <= 0) return;
  const Spot& spot = spots[index[k]];
  const Vector3f to = spot.position - origin;
  const float distance = to.norm();
  const float weight = total * float(spots.size()) / (float(kCandidates) * spot.power.sum() * kPi);
  shadows->push_back({origin, to / distance, weight * reflectance.cwiseProduct(spot.power),
                      distance - 2 * kOffset, slot});
}

/// Queues a shadow ray to one light, chosen by what it would give.
void RoomRenderer::Impl::addLight(const Hit& hit, const Vector3f& reflectance, uint32_t key,
                                  uint32_t sample, uint32_t slot,
                                  std::vector<Shadow>* shadows) const {
  const Vector3f origin = hit.position + kOffset * hit.normal;
  constexpr size_t kMany = 64;
  std::array<float, kMany> few;
  std::vector<float> many(lights.size() > kMany ? lights.size() : 0);
  float* estimate = many.empty() ? few.data() : many.data();
  float total = 0;
  for (size_t i = 0; i < lights.size(); ++i) {
    estimate[i] =
        irradianceEstimate(lights[i], origin, hit.shading_normal) * lights[i].shape.radiance.sum();
    total += estimate[i];
  }
  if (total <= 0) return;
  float pick = sample2(hash(key, 3), sample).x() * total;
  size_t i = 0;
  while (i + 1 < lights.size() && pick >= estimate[i]) pick -= estimate[i++];
  if (estimate[i] <= 0) return;
  const Light& light = lights[i];
  const Vector2f s = sample2(hash(key, 4), sample);
  const LightSample to = light.sample(origin, s);
  const float cosine = hit.shading_normal.dot(to.direction);
  if (!(to.weight > 0) || cosine <= 0 || hit.normal.dot(to.direction) <= 0) return;
  const float weight = to.weight * cosine * total / (estimate[i] * kPi);
  shadows->push_back({origin, to.direction, weight * reflectance.cwiseProduct(light.shape.radiance),
                      to.reach, slot});
}

void RoomRenderer::Impl::traceShadows(const std::vector<Shadow>& shadows, Vector3f* sums) const {
  for (size_t first = 0; first < shadows.size(); first += kPacket) {
    const int lanes = int(std::min(size_t(kPacket), shadows.size() - first));
    Packet packet;
    for (int k = 0; k < lanes; ++k) {
      const Shadow& s = shadows[first + size_t(k)];
      packet.set(k, s.origin, s.direction, std::max(s.reach, 0.f));
    }
    occlude(&packet);
    for (int k = 0; k < lanes; ++k) {
      const Shadow& s = shadows[first + size_t(k)];
      if (!packet.occluded(k)) sums[s.slot] += s.value.cwiseProduct(packet.passed[size_t(k)]);
    }
  }
  rays += int64_t(shadows.size());
}

void RoomRenderer::Impl::traceSun(std::vector<Shadow>* suns, Vector3f* sums) const {
  while (!suns->empty()) {
    rays += int64_t(suns->size());
    size_t kept = 0;
    for (size_t first = 0; first < suns->size(); first += kPacket) {
      const int lanes = int(std::min(size_t(kPacket), suns->size() - first));
      Packet packet;
      for (int k = 0; k < lanes; ++k) {
        const Shadow& s = (*suns)[first + size_t(k)];
        packet.set(k, s.origin, s.direction, INFINITY);
      }
      intersect(&packet, true, false);
      for (int k = 0; k < lanes; ++k) {
        if (!packet.hit(k)) continue;
        Shadow s = (*suns)[first + size_t(k)];
        const RTCHit16& h = packet.query.hit;
        const int32_t t = triangleOf(h.geomID[k], h.primID[k]);
        const Material& m = surface.materials[size_t(surface.material[size_t(t)])];
        if (is_pane[size_t(t)]) {
          sums[s.slot] += s.value;
        } else if (m.opacity < kSolidOpacity) {
          s.value = s.value.cwiseProduct(tint(colourAt(t, h.u[k], h.v[k], .01f), m.opacity));
          s.origin += (packet.query.ray.tfar[k] + kOffset) * s.direction;
          (*suns)[kept++] = s;
        }
      }
    }
    suns->resize(kept);
  }
}

/// The mirror image seen from the eye: always traced, as chance would leave it noisy.
void RoomRenderer::Impl::startGloss(const Hit& hit, const Path& path, Work* work) const {
  Path gloss = path;
  const Material& m = *hit.material;
  float weight, cosine;
  gloss.direction = glossDirection(hit.shading_normal, -path.direction, m.roughness,
                                   sample2(hash(path.key, 7), path.sample), &weight, &cosine);
  if (weight <= 0 || gloss.direction.dot(hit.normal) <= 0) return;
  gloss.throughput *= weight * fresnel(m.specular, cosine);
  gloss.origin = hit.position + kOffset * hit.normal;
  gloss.width = hit.width, gloss.spread += .5f * m.roughness * m.roughness;
  gloss.may_gather = m.roughness > kSharpGloss;
  gloss.key = hash(path.key, 0x51ed270bu);
  ++gloss.depth;
  work->next.push_back(gloss);
}

void RoomRenderer::Impl::shade(const Hit& hit, const Path& arrived, Work* work) const {
  const Material& m = *hit.material;
  if (m.emission > 0) {
    if (arrived.sees_emission)
      work->sums[arrived.slot] += m.emission * arrived.throughput.cwiseProduct(hit.colour);
    return;
  }
  Path path = arrived;
  const uint32_t key = hash(path.key, uint32_t(path.depth));
  Vector2f choice = Vector2f::Zero();
  if (m.specular > 0 || m.opacity < 1) choice = sample2(hash(key, 1), path.sample);
  if (path.depth == 0 && m.specular > 0) {
    const float reflected = fresnel(m.specular, -hit.shading_normal.dot(path.direction));
    startGloss(hit, path, work);
    path.throughput *= 1 - reflected;
    choice.x() = 1;
  }
  const Event event = scatter(hit, choice, sample2(hash(key, 2), path.sample), &path);
  if (event == Event::kEnd) return;
  if (event == Event::kContinue) {
    path.travelled += hit.distance;
    work->next.push_back(path);
    return;
  }
  path.throughput = path.throughput.cwiseProduct(hit.colour);
  path.travelled += hit.distance;
  if (path.sees_spots || path.travelled <= kCacheReach)
    addSun(hit, path.throughput, path.slot, &work->suns);
  if (path.may_gather && path.travelled > kCacheReach) {
    const Vector3f e = cache.at(room_from_world * hit.position,
                                room_from_world.linear() * hit.shading_normal, !path.sees_spots);
    work->sums[path.slot] += path.throughput.cwiseProduct(e) / kPi;
    return;
  }
  addLight(hit, path.throughput, key, path.sample, path.slot, &work->shadows);
  addSpot(hit, path.throughput, key, path.sample, path.slot, &work->shadows);
  if (bounce(hit, key, &path)) work->next.push_back(path);
}

/// Follows the paths in work->now to their ends.
void RoomRenderer::Impl::tracePaths(Work* work, bool coherent) const {
  while (!work->now.empty()) {
    work->next.clear(), work->shadows.clear(), work->suns.clear();
    forHits(work->now, coherent, [&](size_t i, const Hit* hit) {
      if (hit) shade(*hit, work->now[i], work);
    });
    traceShadows(work->shadows, work->sums.data());
    traceSun(&work->suns, work->sums.data());
    std::swap(work->now, work->next);
    coherent = false;
  }
}

/// Light at the vertices of chains of diffuse bounces that start in the air; `block` names the
/// chains.
std::vector<LightCache::Sample> RoomRenderer::Impl::traceChains(uint32_t block) const {
  constexpr uint32_t kChains = 256;
  constexpr int kLength = 4;
  std::vector<LightCache::Sample> samples;
  std::vector<int32_t> last(kChains, LightCache::kUnknown);  // of each chain
  std::vector<int> length(kChains, 0);
  Work work;
  for (uint32_t i = 0; i < kChains; ++i) {
    const uint32_t chain = block * kChains + i, origin = chain % uint32_t(origins.size());
    Path path;
    path.key = hash(chain, 77), path.slot = i;
    path.origin = origins[origin];
    path.direction = uniformDirection(sample2(origin, chain / uint32_t(origins.size())));
    path.throughput.setOnes();
    path.spread = .05f;
    work.now.push_back(path);
  }
  const auto follow = [&](Path path, const Hit* hit) {
    int32_t& before = last[path.slot];
    const auto endDark = [&] {
      if (before >= 0) samples[size_t(before)].link = LightCache::kDark;
    };
    if (!hit) return endDark();
    const uint32_t key = hash(path.key, uint32_t(path.depth));
    const Event event = scatter(*hit, sample2(hash(key, 1), 0), sample2(hash(key, 2), 0), &path);
    path.travelled += hit->distance;
    if (event == Event::kContinue) return work.next.push_back(path);
    if (event == Event::kEnd) return endDark();
    const int32_t index = int32_t(samples.size());
    if (before >= 0) {
      samples[size_t(before)].link = index;
      samples[size_t(before)].link_weight = path.throughput;
      samples[size_t(before)].link_sees_spots = path.sees_spots || path.travelled <= kCacheReach;
    }
    before = index;
    LightCache::Sample sample;
    sample.position = room_from_world * hit->position;
    sample.normal = room_from_world.linear() * hit->shading_normal;
    sample.albedo = hit->colour;
    samples.push_back(sample);
    const Vector3f white = Vector3f::Constant(kPi);
    addLight(*hit, white, key, 0, uint32_t(index), &work.shadows);
    addSpot(*hit, white, key, 0, uint32_t(index), &work.shadows);
    addSun(*hit, white, uint32_t(index), &work.suns);
    if (++length[path.slot] == kLength) return;
    path.throughput.setOnes();
    if (!bounce(*hit, key, &path)) return endDark();
    work.next.push_back(path);
  };
  while (!work.now.empty()) {
    work.next.clear();
    forHits(work.now, false, [&](size_t i, const Hit* hit) { follow(work.now[i], hit); });
    std::swap(work.now, work.next);
  }
  std::vector<Vector3f> direct(samples.size(), Vector3f::Zero()), sunlight = direct;
  traceShadows(work.shadows, direct.data());
  traceSun(&work.suns, sunlight.data());
  for (size_t i = 0; i < samples.size(); ++i)
    samples[i].direct = direct[i], samples[i].sun = sunlight[i];
  return samples;
}

/// Fills the cache, finds the spots and sets the exposure.
void RoomRenderer::Impl::lightRoom() const {
  constexpr size_t kBlocks = 128;
  addSunlitSpots();
  spreadSpots();
  std::vector<std::vector<LightCache::Sample>> parts(kBlocks);
  tbb::parallel_for(size_t(0), kBlocks, [&](size_t i) { parts[i] = traceChains(uint32_t(i)); });
  std::vector<LightCache::Sample> samples;
  for (const auto& part : parts) {
    const int32_t first = int32_t(samples.size());
    for (LightCache::Sample s : part) {
      if (s.link >= 0) s.link += first;
      samples.push_back(s);
    }
  }
  if (samples.empty()) return;
  cache = LightCache(samples);
  addBrightSpots();
  spreadSpots();
  setExposure(samples);
}

/// The room's log-average at middle grey, unless that burns out what is merely bright.
void RoomRenderer::Impl::setExposure(const std::vector<LightCache::Sample>& samples) const {
  std::vector<float> luminance;
  double log_sum = 0;
  for (const LightCache::Sample& s : samples) {
    const Vector3f l = s.albedo.cwiseProduct(cache.at(s.position, s.normal, false) + s.sun) / kPi;
    luminance.push_back(l.dot(Vector3f(.2126f, .7152f, .0722f)));
    log_sum += std::log(std::max(luminance.back(), 1e-6f));
  }
  const size_t bright = luminance.size() * 95 / 100;
  std::nth_element(luminance.begin(), luminance.begin() + ptrdiff_t(bright), luminance.end());
  const float middle = float(std::exp(log_sum / double(luminance.size())));
  exposure = std::min(.2f / std::max(middle, 1e-6f), 1.1f / std::max(luminance[bright], 1e-6f));
}

RoomRenderer::RoomRenderer(const Room& room) : impl_(std::make_unique<Impl>(room)) {}
RoomRenderer::~RoomRenderer() = default;
RoomRenderer::RoomRenderer(RoomRenderer&&) noexcept = default;

const RayTarget& RoomRenderer::rayTarget() const {
  std::call_once(impl_->target_once, [&] {
    tbb::this_task_arena::isolate([&] {
      impl_->target = std::make_unique<RayTarget>(RayTarget::fromMesh(solidMesh(impl_->surface)));
    });
  });
  return *impl_->target;
}

int64_t RoomRenderer::raysTraced() const { return impl_->rays; }

namespace {

constexpr int kTile = 16;

/// Calls body(x, y) with the corner of each tile, in parallel.
template <typename Body>
void forTiles(const Camera& camera, Body body) {
  const int across = (camera.width + kTile - 1) / kTile, down = (camera.height + kTile - 1) / kTile;
  tbb::parallel_for(0, across * down, [&](int t) { body(t % across * kTile, t / across * kTile); });
}

/// Rays through pixel positions whose z along the camera's axis is 1, so that t is planar depth.
class PixelRays {
 public:
  explicit PixelRays(const Camera& c)
      : eye_(c.world_from_camera.translation().cast<float>()), camera_(c) {}
  Vector3f eye() const { return eye_; }
  Vector3f through(float x, float y) const {
    return (camera_.world_from_camera.linear() *
            Eigen::Vector3d((x - camera_.cx) / camera_.fx, (y - camera_.cy) / camera_.fy, 1))
        .cast<float>();
  }

 private:
  Vector3f eye_;
  const Camera& camera_;
};

void requireCamera(const Camera& c) {
  require(c.width > 0 && c.height > 0 && c.fx > 0 && c.fy > 0,
          "RoomRenderer: camera: expected a size and focal length, found ", c.width, " x ",
          c.height, ", ", c.fx, ", ", c.fy);
}

}  // namespace

View RoomRenderer::renderDepth(const Camera& camera) const {
  requireCamera(camera);
  View view;
  view.camera = camera;
  view.colour = Image(camera.width, camera.height, 3);
  view.depth.assign(size_t(camera.width) * size_t(camera.height), 0.f);
  const PixelRays pixel(camera);
  forTiles(camera, [&](int left, int top) {
    const int right = std::min(left + kTile, camera.width);
    for (int y = top; y < std::min(top + kTile, camera.height); ++y) {
      Packet packet;
      for (int x = left; x < right; ++x)
        packet.set(x - left, pixel.eye(), pixel.through(float(x) + .5f, float(y) + .5f), INFINITY);
      impl_->intersect(&packet, true, true);
      for (int x = left; x < right; ++x)
        if (packet.hit(x - left))
          view.depth[size_t(y) * size_t(camera.width) + size_t(x)] =
              packet.query.ray.tfar[x - left];
      impl_->rays += right - left;
    }
  });
  return view;
}

View RoomRenderer::render(const Camera& camera, int samples, uint64_t seed) const {
  return picture(camera, samples, seed).view;
}

RoomPicture RoomRenderer::picture(const Camera& camera, int samples, uint64_t seed) const {
  requireCamera(camera);
  require(samples > 0, "RoomRenderer: expected samples, found ", samples);
  const Impl& impl = *impl_;
  impl.prepareLight();
  RoomPicture out;
  const size_t pixels = size_t(camera.width) * size_t(camera.height);
  out.view.camera = camera;
  out.view.colour = Image(camera.width, camera.height, 3);
  out.view.depth.assign(pixels, 0.f);
  out.radiance = out.normal = Image(camera.width, camera.height, 3);
  out.material.assign(pixels, -1);
  const PixelRays pixel(camera);
  const float footprint = .7f / float(camera.fy);
  const uint32_t view_key = hash(uint32_t(seed), uint32_t(seed >> 32));
  forTiles(camera, [&](int left, int top) {
    const int right = std::min(left + kTile, camera.width),
              bottom = std::min(top + kTile, camera.height), width = right - left;
    for (int y = top; y < bottom; ++y) {
      Packet packet;
      for (int x = left; x < right; ++x)
        packet.set(x - left, pixel.eye(), pixel.through(float(x) + .5f, float(y) + .5f), INFINITY);
      impl.intersect(&packet, true, true);
      for (int x = left; x < right; ++x) {
        if (!packet.hit(x - left)) continue;
        const size_t i = size_t(y) * size_t(camera.width) + size_t(x);
        const Hit hit = impl.hitAt(packet, x - left, 0, footprint);
        out.view.depth[i] = hit.distance;
        out.material[i] = int32_t(hit.material - impl.surface.materials.data());
        for (int c = 0; c < 3; ++c) out.normal.at(x, y, c) = hit.shading_normal[c];
      }
      impl.rays += width;
    }
    Impl::Work work;
    work.sums.assign(size_t(width * (bottom - top)), Vector3f::Zero());
    constexpr int kBatch = 8;  // samples: enough rays to fill packets, few enough to stay in cache
    for (int first = 0; first < samples; first += kBatch) {
      work.now.clear();
      for (int s = first; s < std::min(first + kBatch, samples); ++s)
        for (int y = top; y < bottom; ++y)
          for (int x = left; x < right; ++x) {
            Path path;
            path.slot = uint32_t((y - top) * width + x - left);
            path.key = hash(view_key, uint32_t(y * camera.width + x));
            path.sample = uint32_t(s);
            const Vector2f at = sample2(hash(path.key, 1000), path.sample);
            path.origin = pixel.eye();
            path.direction = pixel.through(float(x) + at.x(), float(y) + at.y()).normalized();
            path.throughput.setOnes();
            path.spread = footprint;
            work.now.push_back(path);
          }
      impl.tracePaths(&work, true);
    }
    for (int y = top; y < bottom; ++y)
      for (int x = left; x < right; ++x)
        for (int c = 0; c < 3; ++c) {
          const float l =
              work.sums[size_t((y - top) * width + x - left)][c] * impl.exposure / float(samples);
          out.radiance.at(x, y, c) = l;
          out.view.colour.at(x, y, c) = displayFromLinear(l);
        }
  });
  return out;
}

}  // namespace vdbc
