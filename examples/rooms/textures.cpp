#include "examples/rooms/textures.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "examples/rooms/sampling.h"
#include "splat/image.h"

namespace vdbc {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

namespace {

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

}  // namespace

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

MipTexture::MipTexture(std::shared_ptr<const Texture> base) : base_(std::move(base)) {
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

template <typename Visit>
void MipTexture::visit(const Level& l, const Vector2f& uv, Visit take) {
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

Vector3f MipTexture::colour(const Vector2f& uv, float texels) const {
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

float MipTexture::coverage(const Vector2f& uv) const {
  float sum = 0;
  visit(levels_[0], uv, [&](const uint8_t* p, float weight) { sum += weight * float(p[3]); });
  return sum / 255;
}

void MipTexture::halve(const Level& big, const Level& small, uint8_t* out) {
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

}  // namespace vdbc
