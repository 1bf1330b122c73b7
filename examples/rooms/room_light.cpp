// What is found out once a room, before its pictures: where the sun and other bright spots are, the
// light of many bounces, and the exposure.
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>

#include "examples/rooms/path_tracer.h"
#include "examples/rooms/sampling.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;

constexpr size_t kSpots = 8192;  // of light that lights the room in turn

}  // namespace

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

}  // namespace vdbc
