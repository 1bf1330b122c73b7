// Pictures of rooms. Light is meant to look right and to be almost free of noise at four samples a
// pixel, not to be exact: the unoccluded part of each light is a closed form and only its
// visibility is sampled; indirect light comes from a coarse volume of irradiance probes (one traced
// bounce, the rest as a geometric series), darkened near corners by short occlusion rays.
#include <embree3/rtcore.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "examples/rooms/rooms.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

constexpr float kPi = float(M_PI);
constexpr float kOcclusionRange = .45f;  // metres
constexpr int kPacket = 16;

// --- random numbers per pixel, independent of the order of work ----------------------------------

uint32_t hash(uint32_t x) {
  x ^= x >> 16, x *= 0x7feb352du;
  x ^= x >> 15, x *= 0x846ca68bu;
  return x ^ x >> 16;
}
uint32_t hash(uint32_t a, uint32_t b) { return hash(a ^ hash(b + 0x9e3779b9u)); }
float unit(uint32_t bits) { return float(bits >> 8) * 0x1p-24f; }

/// Point `i` of a low-discrepancy sequence, shifted by `key` (Roberts 2018, R2): any number of
/// samples of a pixel is well spread, and pixels do not share their error.
Vector2f sample2(uint32_t key, int i) {
  const float x = unit(hash(key)) + .7548776662466927f * float(i);
  const float y = unit(hash(key ^ 0x68bc21ebu)) + .5698402909980532f * float(i);
  return {x - std::floor(x), y - std::floor(y)};
}

// --- textures
// -------------------------------------------------------------------------------------

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

/// Reflectance (or emitted colour) at (u, v) metres, averaged roughly over `footprint` metres.
Vector3f evaluate(const Material& m, float u, float v, float footprint) {
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
      const float grain = .5f + fine * (valueNoise(grain_u, grain_v) - .5f);
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

// --- lights
// ---------------------------------------------------------------------------------------

struct Light {
  RoomLight shape;
  Vector3f normal = Vector3f::Zero();  // of a rectangle
  float area = 0;                      // 0: a sphere
};

/// Irradiance at p (normal n) from an unoccluded light, as a factor of its radiance. Rectangles are
/// cut in four; the softened distance keeps the quarters finite next to the glass.
float irradiance(const Light& light, const Vector3f& p, const Vector3f& n) {
  if (light.area <= 0) {
    const Vector3f d = light.shape.centre - p;
    const float d2 = d.squaredNorm(), r = light.shape.radius_m;
    // A sphere that is half below the horizon still lights: wrap by its angular radius.
    const float distance = std::sqrt(d2), wrap = std::min(r / distance, 1.f);
    const float cosine = std::max(0.f, (n.dot(d) / distance + wrap) / (1 + wrap));
    return kPi * r * r * cosine / (d2 + r * r);
  }
  float sum = 0;
  for (int k = 0; k < 4; ++k) {
    const Vector3f q = light.shape.centre + light.shape.half_u * (k & 1 ? .5f : -.5f) +
                       light.shape.half_v * (k & 2 ? .5f : -.5f);
    const Vector3f d = q - p;
    const float d2 = d.squaredNorm();
    const float a = n.dot(d), b = -light.normal.dot(d);
    if (a > 0 && b > 0) sum += a * b / ((d2 + light.area * .03f) * (d2 + light.area * .03f));
  }
  return sum * light.area / 4;
}

/// A point of the light for the visibility ray.
Vector3f lightPoint(const Light& light, const Vector2f& s) {
  if (light.area > 0)
    return light.shape.centre + light.shape.half_u * (2 * s.x() - 1) +
           light.shape.half_v * (2 * s.y() - 1);
  const float z = 2 * s.x() - 1, r = std::sqrt(std::max(0.f, 1 - z * z)), a = 2 * kPi * s.y();
  return light.shape.centre + light.shape.radius_m * Vector3f(r * std::cos(a), r * std::sin(a), z);
}

float displayFromLinear(float x) {
  // Linear up to .6, then a shoulder that never clips: windows stay bright without burning out.
  constexpr float kKnee = .6f;
  if (x > kKnee) x = kKnee + (1 - kKnee) * (1 - std::exp(-(x - kKnee) / (1 - kKnee)));
  return srgbFromLinear(std::clamp(x, 0.f, 1.f));
}

struct Packet {
  alignas(64) RTCRayHit16 query;
  alignas(64) std::array<int, kPacket> valid;

  Packet() { valid.fill(0); }
  void set(int k, const Vector3f& o, const Vector3f& d, float tfar) {
    RTCRay16& r = query.ray;
    r.org_x[k] = o.x(), r.org_y[k] = o.y(), r.org_z[k] = o.z();
    r.dir_x[k] = d.x(), r.dir_y[k] = d.y(), r.dir_z[k] = d.z();
    r.tnear[k] = 0, r.tfar[k] = tfar, r.time[k] = 0;
    r.mask[k] = ~0u, r.id[k] = 0, r.flags[k] = 0;
    query.hit.geomID[k] = RTC_INVALID_GEOMETRY_ID;
    query.hit.instID[0][k] = RTC_INVALID_GEOMETRY_ID;
    valid[size_t(k)] = -1;
  }
  void intersect(RTCScene scene, bool coherent) {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    context.flags =
        coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
    rtcIntersect16(valid.data(), scene, &context, &query);
  }
  void occlude(RTCScene scene) {
    RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
    rtcOccluded16(valid.data(), scene, &context, &query.ray);
  }
  bool hit(int k) const {
    return valid[size_t(k)] && query.hit.geomID[k] != RTC_INVALID_GEOMETRY_ID;
  }
  bool occluded(int k) const { return query.ray.tfar[k] < 0; }
};

struct SurfacePoint {
  Vector3f position = Vector3f::Zero(), normal = Vector3f::Zero();
  Vector3f albedo = Vector3f::Zero(), emitted = Vector3f::Zero();  // emitted: in display units
};

}  // namespace

struct RoomRenderer::Impl {
  RayTarget target;
  std::vector<Material> materials;
  struct Face {
    Vector3f normal, u, v;
    int material;
  };
  std::vector<Face> faces;
  std::vector<Light> lights;

  // Probes: irradiance for the normals -x +x -y +y -z +z of the room frame, on a regular grid of
  // cell centres.
  using Probe = std::array<Eigen::Array4f, 6>;
  Eigen::Isometry3f room_from_world;
  Eigen::Vector3i grid_size;
  Vector3f grid_step;
  std::vector<Probe> probes;
  float exposure = 1;

  explicit Impl(const Room& room);
  void bakeProbes(const Room& room);
  Vector3f ambient(const Vector3f& p, const Vector3f& n) const;
  SurfacePoint surface(const Packet& packet, int k, float footprint_per_metre) const;
  /// Visibility 0-1 of each light from the valid lanes; unlit lanes are not traced.
  void addDirect(const std::array<SurfacePoint, kPacket>& points,
                 const std::array<bool, kPacket>& is_hit, const std::array<uint32_t, kPacket>& keys,
                 const std::array<int, kPacket>& samples,
                 std::array<Vector3f, kPacket>* irradiances) const;
};

RoomRenderer::Impl::Impl(const Room& room)
    : target(RayTarget::fromMesh(room.mesh)),
      materials(room.materials),
      room_from_world(room.world_from_room.inverse()) {
  const size_t count = room.mesh.triangles.size();
  require(room.material.size() == count && room.tangent_u.size() == count &&
              room.tangent_v.size() == count,
          "RoomRenderer: expected a material and tangents for each of ", count, " triangles");
  faces.reserve(count);
  for (size_t i = 0; i < count; ++i) {
    const Eigen::Vector3i& t = room.mesh.triangles[i];
    const Vector3f &a = room.mesh.vertices[size_t(t[0])], &b = room.mesh.vertices[size_t(t[1])],
                   &c = room.mesh.vertices[size_t(t[2])];
    require(room.material[i] >= 0 && size_t(room.material[i]) < materials.size(),
            "RoomRenderer: triangle ", i, " has material ", room.material[i], " of ",
            materials.size());
    faces.push_back({(b - a).cross(c - a).normalized(), room.tangent_u[i], room.tangent_v[i],
                     room.material[i]});
  }
  for (const RoomLight& l : room.lights) {
    Light light{l, Vector3f::Zero(), 0};
    const Vector3f n = l.half_u.cross(l.half_v);
    light.area = 4 * n.norm();
    if (light.area > 0) light.normal = n.normalized();
    if (l.radiance.maxCoeff() > 0) lights.push_back(light);
  }
  bakeProbes(room);
}

SurfacePoint RoomRenderer::Impl::surface(const Packet& packet, int k,
                                         float footprint_per_metre) const {
  const RTCRay16& r = packet.query.ray;
  const Vector3f d(r.dir_x[k], r.dir_y[k], r.dir_z[k]);
  const float t = r.tfar[k];
  const Face& face = faces[packet.query.hit.primID[k]];
  SurfacePoint s;
  s.position = Vector3f(r.org_x[k], r.org_y[k], r.org_z[k]) + t * d;
  const float cosine = face.normal.dot(d);
  s.normal = cosine > 0 ? Vector3f(-face.normal) : face.normal;
  const Material& m = materials[size_t(face.material)];
  const float footprint = footprint_per_metre * t / std::sqrt(std::max(std::abs(cosine), .05f));
  const Vector3f c = evaluate(m, s.position.dot(face.u), s.position.dot(face.v), footprint);
  s.albedo = m.emission > 0 ? Vector3f::Zero() : c;
  s.emitted = c * m.emission;
  s.position += s.normal * 1e-3f;
  return s;
}

void RoomRenderer::Impl::addDirect(const std::array<SurfacePoint, kPacket>& points,
                                   const std::array<bool, kPacket>& is_hit,
                                   const std::array<uint32_t, kPacket>& keys,
                                   const std::array<int, kPacket>& samples,
                                   std::array<Vector3f, kPacket>* irradiances) const {
  for (size_t l = 0; l < lights.size(); ++l) {
    const Light& light = lights[l];
    Packet shadow;
    std::array<float, kPacket> factor;
    bool any = false;
    for (int k = 0; k < kPacket; ++k) {
      const size_t i = size_t(k);
      factor[i] = is_hit[i] ? irradiance(light, points[i].position, points[i].normal) : 0;
      // Too little to be seen: no ray, and no light either, so that nothing shines through walls.
      if (factor[i] * light.shape.radiance.maxCoeff() * exposure < .02f) continue;
      const Vector3f to = lightPoint(light, sample2(hash(keys[i], uint32_t(l) + 11), samples[i])) -
                          points[i].position;
      const float distance = to.norm(),
                  reach = distance - light.shape.radius_m - light.shape.bound_m;
      if (light.area > 0 && points[i].normal.dot(to) <= 0) continue;  // below the horizon
      (*irradiances)[i] += factor[i] * light.shape.radiance;
      if (reach <= 1e-3f) continue;
      shadow.set(k, points[i].position, to / distance, reach);
      any = true;
    }
    if (!any) continue;
    shadow.occlude(target.embreeScene());
    for (int k = 0; k < kPacket; ++k)
      if (shadow.valid[size_t(k)] && shadow.occluded(k))
        (*irradiances)[size_t(k)] -= factor[size_t(k)] * light.shape.radiance;
  }
}

Vector3f RoomRenderer::Impl::ambient(const Vector3f& p, const Vector3f& n) const {
  const Vector3f q = (room_from_world * p).cwiseQuotient(grid_step).array() - .5f;
  const Vector3f m = room_from_world.linear() * n;
  const float wx = m.x() * m.x(), wy = m.y() * m.y(), wz = m.z() * m.z();
  const size_t sx = m.x() > 0, sy = 2 + (m.y() > 0), sz = 4 + (m.z() > 0);
  int lo[3];
  float f[3];
  for (int a = 0; a < 3; ++a) {
    const float c = std::clamp(q[a], 0.f, float(grid_size[a] - 1));
    lo[a] = std::min(int(c), std::max(grid_size[a] - 2, 0));
    f[a] = c - float(lo[a]);
  }
  Eigen::Array4f sum = Eigen::Array4f::Zero();  // rgb and the weight of usable probes
  for (int k = 0; k < 8; ++k) {
    const int i = std::min(lo[0] + (k & 1), grid_size[0] - 1);
    const int j = std::min(lo[1] + (k >> 1 & 1), grid_size[1] - 1);
    const int h = std::min(lo[2] + (k >> 2 & 1), grid_size[2] - 1);
    const float w =
        (k & 1 ? f[0] : 1 - f[0]) * (k & 2 ? f[1] : 1 - f[1]) * (k & 4 ? f[2] : 1 - f[2]);
    const Probe& probe = probes[size_t((i * grid_size[1] + j) * grid_size[2] + h)];
    sum += w * (wx * probe[sx] + wy * probe[sy] + wz * probe[sz]);
  }
  return sum.head<3>() / std::max(sum[3], 1e-4f);
}

void RoomRenderer::Impl::bakeProbes(const Room& room) {
  constexpr int kRays = 64;  // a probe
  constexpr float kSpacing = .9f;
  const Vector3f size = room.inside.sizes();
  for (int a = 0; a < 3; ++a) {
    grid_size[a] = std::max(2, int(std::lround(size[a] / kSpacing)));
    grid_step[a] = size[a] / float(grid_size[a]);
  }
  const size_t count = size_t(grid_size.prod());
  probes.resize(count);
  struct Gathered {
    Vector3f albedo = Vector3f::Zero();
    float rays = 0;
    std::array<SurfacePoint, kRays> points;
    std::array<Vector3f, kRays> direct;  // irradiance at the points
    bool is_usable = false;
  };
  std::vector<Gathered> gathered(count);
  std::array<Vector3f, kRays> directions;  // Fibonacci sphere
  for (int i = 0; i < kRays; ++i) {
    const float z = 1 - (2 * float(i) + 1) / kRays, r = std::sqrt(1 - z * z),
                a = 2.39996323f * float(i);
    directions[size_t(i)] = {r * std::cos(a), r * std::sin(a), z};
  }
  tbb::parallel_for(tbb::blocked_range<size_t>(0, count, 8), [&](const auto& range) {
    for (size_t index = range.begin(); index < range.end(); ++index) {
      const Eigen::Vector3i cell(int(index) / (grid_size[1] * grid_size[2]),
                                 int(index) / grid_size[2] % grid_size[1],
                                 int(index) % grid_size[2]);
      const Vector3f p_room = (cell.cast<float>().array() + .5f).matrix().cwiseProduct(grid_step);
      for (auto& value : probes[index]) value.setZero();
      bool inside_solid = false;
      for (const auto& box : room.solids) inside_solid |= box.contains(p_room);
      if (inside_solid) continue;
      Gathered& g = gathered[index];
      g.is_usable = true;
      const Vector3f p = room.world_from_room * p_room;
      for (int first = 0; first < kRays; first += kPacket) {
        Packet packet;
        for (int k = 0; k < kPacket; ++k)
          packet.set(k, p, room.world_from_room.linear() * directions[size_t(first + k)], 1e9f);
        packet.intersect(target.embreeScene(), false);
        std::array<SurfacePoint, kPacket> points;
        std::array<bool, kPacket> is_hit;
        std::array<uint32_t, kPacket> keys;
        std::array<int, kPacket> samples;
        std::array<Vector3f, kPacket> lit;
        for (int k = 0; k < kPacket; ++k) {
          const size_t i = size_t(k);
          is_hit[i] = packet.hit(k);
          if (is_hit[i]) points[i] = surface(packet, k, .3f);
          keys[i] = hash(uint32_t(index), uint32_t(first + k)), samples[i] = 0;
          lit[i].setZero();
        }
        addDirect(points, is_hit, keys, samples, &lit);
        for (int k = 0; k < kPacket; ++k) {
          const size_t i = size_t(k), ray = size_t(first + k);
          g.direct[ray] = lit[i];
          if (is_hit[i]) g.points[ray] = points[i];
          g.albedo += g.points[ray].albedo;
        }
      }
    }
  });
  // Later bounces: what the first one brings, times 1 + rho + rho^2 + ...
  Vector3f albedo = Vector3f::Zero();
  double usable = 0;
  for (const Gathered& g : gathered)
    if (g.is_usable) albedo += g.albedo, ++usable;
  require(usable > 0, "RoomRenderer: room ", room.seed, " has no air to put light into");
  albedo /= float(usable * kRays);
  const Vector3f series = (1 - albedo.array().min(.85f)).inverse();
  for (size_t index = 0; index < count; ++index) {
    const Gathered& g = gathered[index];
    if (!g.is_usable) continue;
    std::array<float, 6> weight = {};
    for (int i = 0; i < kRays; ++i) {
      const Vector3f& d = directions[size_t(i)];
      const Vector3f radiance = g.points[size_t(i)].albedo.cwiseProduct(g.direct[size_t(i)]) / kPi;
      for (int face = 0; face < 6; ++face) {
        const float cosine = face & 1 ? d[face / 2] : -d[face / 2];
        if (cosine <= 0) continue;
        probes[index][size_t(face)].head<3>() += cosine * radiance.array();
        weight[size_t(face)] += cosine;
      }
    }
    for (size_t face = 0; face < 6; ++face) {
      auto& value = probes[index][face];
      value.head<3>() *= kPi / weight[face] * series.array();
      value[3] = 1;
    }
  }

  // Probes inside furniture take what their neighbours have, at a low weight: where nothing else is
  // near, in a narrow gap say, it is not pitch dark.
  std::vector<uint8_t> is_filled(count);
  for (size_t i = 0; i < count; ++i) is_filled[i] = gathered[i].is_usable;
  for (bool is_done = false; !is_done;) {
    is_done = true;
    const std::vector<uint8_t> before = is_filled;
    for (size_t i = 0; i < count; ++i) {
      if (before[i]) continue;
      is_done = false;
      int cell[3] = {int(i) / (grid_size[1] * grid_size[2]), int(i) / grid_size[2] % grid_size[1],
                     int(i) % grid_size[2]};
      for (int a = 0; a < 3; ++a)
        for (int step : {-1, 1}) {
          int next[3] = {cell[0], cell[1], cell[2]};
          next[a] += step;
          if (next[a] < 0 || next[a] >= grid_size[a]) continue;
          const size_t j = size_t((next[0] * grid_size[1] + next[1]) * grid_size[2] + next[2]);
          if (!before[j]) continue;
          is_filled[i] = 1;
          for (size_t face = 0; face < 6; ++face)
            probes[i][face] += probes[j][face] / std::max(probes[j][face][3], 1e-6f);
        }
      for (size_t face = 0; face < 6 && is_filled[i]; ++face)
        probes[i][face] *= .02f / probes[i][face][3];
    }
  }

  // Exposure: the mean display value over all directions from all probes meets the room's own
  // target, near the middle.
  const float goal = .46f + .08f * unit(hash(uint32_t(room.seed), uint32_t(room.seed >> 32)));
  std::vector<std::pair<float, float>> values;  // radiance before exposure; emission, added after
  for (const Gathered& g : gathered)
    for (size_t i = 0; g.is_usable && i < size_t(kRays); i += 3) {
      if (directions[i].z() > .75f) continue;  // cameras seldom look straight up
      const SurfacePoint& p = g.points[i];
      const Vector3f light = g.direct[i] + .9f * ambient(p.position, p.normal);
      const Vector3f radiance = light.cwiseProduct(p.albedo) / kPi;
      for (int c = 0; c < 3; ++c) values.emplace_back(radiance[c], p.emitted[c]);
    }
  float lo = 1e-4f, hi = 1e4f;
  for (int step = 0; step < 24; ++step) {
    const float middle = std::sqrt(lo * hi);
    double sum = 0;
    for (size_t i = 0; i < values.size(); i += 4)
      sum += displayFromLinear(middle * values[i].first + values[i].second);
    (sum > goal * double((values.size() + 3) / 4) ? hi : lo) = middle;
  }
  exposure = std::sqrt(lo * hi);
}

RoomRenderer::RoomRenderer(const Room& room) : impl_(std::make_unique<Impl>(room)) {}
RoomRenderer::~RoomRenderer() = default;
RoomRenderer::RoomRenderer(RoomRenderer&&) noexcept = default;
const RayTarget& RoomRenderer::rayTarget() const { return impl_->target; }

View RoomRenderer::render(const Camera& camera, int samples, uint64_t seed) const {
  require(camera.width > 0 && camera.height > 0 && camera.fx > 0 && camera.fy > 0 && samples > 0,
          "RoomRenderer: expected a camera with pixels and at least one sample, found ",
          camera.width, " x ", camera.height, ", ", samples, " samples");
  View view;
  view.name = joinText("room view ", seed);
  view.camera = camera;
  view.colour = Image(camera.width, camera.height, 3);
  view.depth.assign(size_t(camera.width) * size_t(camera.height), 0.f);

  const Vector3f origin = camera.world_from_camera.translation().cast<float>();
  const Eigen::Matrix3f turn = camera.world_from_camera.linear().cast<float>();
  const RTCScene scene = impl_->target.embreeScene();
  const float footprint = float(1 / camera.fy);
  const uint32_t seed_key = hash(uint32_t(seed), uint32_t(seed >> 32));
  constexpr int kTile = 4;  // pixels: one packet of centre rays, `samples` packets of shaded ones
  const int tiles_x = (camera.width + kTile - 1) / kTile,
            tiles_y = (camera.height + kTile - 1) / kTile;
  // Planar: z of the direction is 1, so a distance along the ray is z.
  const auto direction = [&](float x, float y) {
    return Vector3f(turn * Vector3f((x - float(camera.cx)) / float(camera.fx),
                                    (y - float(camera.cy)) / float(camera.fy), 1.f));
  };

  const auto renderTile = [&](int x0, int y0) {
    std::array<Vector3f, kPacket> sum;
    std::array<int, kPacket> px, py;
    std::array<bool, kPacket> is_pixel;
    Packet centre;
    for (int k = 0; k < kPacket; ++k) {
      const size_t i = size_t(k);
      // 2 x 2 blocks keep the packet's rays together.
      px[i] = x0 + (k & 1) + (k >> 1 & 2), py[i] = y0 + (k >> 1 & 1) + (k >> 2 & 2);
      is_pixel[i] = px[i] < camera.width && py[i] < camera.height;
      sum[i].setZero();
      if (is_pixel[i])
        centre.set(k, origin, direction(float(px[i]) + .5f, float(py[i]) + .5f), 1e9f);
    }
    centre.intersect(scene, true);
    for (int k = 0; k < kPacket; ++k)
      if (centre.hit(k))
        view.depth[size_t(py[size_t(k)]) * size_t(camera.width) + size_t(px[size_t(k)])] =
            centre.query.ray.tfar[k];

    for (int s = 0; s < samples; ++s) {
      Packet packet;
      std::array<uint32_t, kPacket> keys;
      std::array<int, kPacket> sample_index;
      for (int k = 0; k < kPacket; ++k) {
        const size_t i = size_t(k);
        keys[i] = hash(uint32_t(py[i] * camera.width + px[i]), seed_key);
        sample_index[i] = s;
        if (!is_pixel[i]) continue;
        const Vector2f jitter = sample2(keys[i], s);
        packet.set(k, origin,
                   direction(float(px[i]) + jitter.x(), float(py[i]) + jitter.y()).normalized(),
                   1e9f);
      }
      packet.intersect(scene, true);
      std::array<SurfacePoint, kPacket> points;
      std::array<bool, kPacket> is_hit;
      std::array<Vector3f, kPacket> lit;
      Packet near;
      for (int k = 0; k < kPacket; ++k) {
        const size_t i = size_t(k);
        lit[i].setZero();
        is_hit[i] = packet.hit(k);
        if (!is_hit[i]) continue;
        points[i] = impl_->surface(packet, k, footprint);
        // Cosine-weighted: the normal plus a point of the unit sphere.
        const Vector2f u = sample2(hash(keys[i], 7), s);
        const float z = 2 * u.x() - 1, r = std::sqrt(std::max(0.f, 1 - z * z)), a = 2 * kPi * u.y();
        const Vector3f d =
            points[i].normal * 1.001f + Vector3f(r * std::cos(a), r * std::sin(a), z);
        near.set(k, points[i].position, d.normalized(), kOcclusionRange);
      }
      near.intersect(scene, false);
      impl_->addDirect(points, is_hit, keys, sample_index, &lit);
      for (int k = 0; k < kPacket; ++k) {
        const size_t i = size_t(k);
        if (!is_hit[i]) continue;
        const SurfacePoint& p = points[i];
        Vector3f seen = Vector3f::Ones();
        if (near.hit(k)) {
          // What blocks the view reflects light itself, about as much as this surface does.
          const float open = near.query.ray.tfar[k] / kOcclusionRange;
          seen = (open + (1 - open) * .6f * p.albedo.array()).matrix();
        }
        lit[i] += impl_->ambient(p.position, p.normal).cwiseProduct(seen);
        sum[i] += impl_->exposure * p.albedo.cwiseProduct(lit[i]) / kPi + p.emitted;
      }
    }
    for (int k = 0; k < kPacket; ++k) {
      const size_t i = size_t(k);
      if (!is_pixel[i]) continue;
      for (int c = 0; c < 3; ++c)
        view.colour.at(px[i], py[i], c) = displayFromLinear(sum[i][c] / float(samples));
    }
  };
  tbb::parallel_for(tbb::blocked_range<int>(0, tiles_x * tiles_y, 16), [&](const auto& range) {
    for (int t = range.begin(); t < range.end(); ++t)
      renderTile(t % tiles_x * kTile, t / tiles_x * kTile);
  });
  return view;
}

// --- cameras, free space, surface
// -----------------------------------------------------------------

namespace {

double uniform(std::mt19937_64& random, double a, double b) {
  return a + (b - a) * (double(random() >> 11) * 0x1p-53);
}

bool isFree(const Room& room, const Vector3f& p_room, float margin) {
  for (const Eigen::AlignedBox3f& box : room.solids)
    if (box.squaredExteriorDistance(p_room) < margin * margin || box.contains(p_room)) return false;
  return true;
}

}  // namespace

std::vector<Camera> randomCameras(const Room& room, int count, int width, int height,
                                  std::mt19937_64& random) {
  constexpr double kFieldOfView = 70 * M_PI / 180;  // vertical
  constexpr float kNearest = .4f, kFromWalls = .3f, kFromThings = .2f;
  constexpr int kProbes = 12;  // rays a side that look for something too near
  require(width > 0 && height > 0, "randomCameras: expected a size in pixels, found ", width, " x ",
          height);
  const RayTarget target = RayTarget::fromMesh(room.mesh);
  const Vector3f size = room.inside.sizes();
  std::vector<Camera> cameras;
  for (int tries = 0; int(cameras.size()) < count; ++tries) {
    require(tries < 2000 + 200 * count, "randomCameras: room ", room.seed,
            " has no free place for a camera");
    const double x = uniform(random, kFromWalls, size.x() - kFromWalls);
    const double y = uniform(random, kFromWalls, size.y() - kFromWalls);
    const double z = uniform(random, 1.1, std::min(1.9, double(size.z()) - .3));
    // Looks at a random place of the room, so that corners look inward.
    const double tx = uniform(random, 0, size.x()), ty = uniform(random, 0, size.y());
    const double pitch = uniform(random, -.35, .12), roll = uniform(random, -.03, .03);
    const Eigen::Vector3d eye(x, y, z);
    const Eigen::Vector2d level(tx - x, ty - y);
    if (level.norm() < .7 || !isFree(room, eye.cast<float>(), kFromThings)) continue;
    const Eigen::Vector3d forward =
        Eigen::Vector3d(level.x() / level.norm(), level.y() / level.norm(), std::tan(pitch))
            .normalized();
    const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitZ()).normalized();
    Camera camera;
    camera.width = width, camera.height = height;
    camera.fx = camera.fy = height / (2 * std::tan(kFieldOfView / 2));
    camera.cx = width / 2., camera.cy = height / 2.;
    Eigen::Isometry3d room_from_camera = Eigen::Isometry3d::Identity();
    room_from_camera.linear() << right, forward.cross(right), forward;
    room_from_camera.linear() *=
        Eigen::AngleAxisd(roll, Eigen::Vector3d::UnitZ()).toRotationMatrix();
    room_from_camera.translation() = eye;
    // Rebuilt in double: the float pose of the room is orthonormal to 1e-7 only.
    const Eigen::Matrix3d yaw = Eigen::Quaterniond(room.world_from_room.linear().cast<double>())
                                    .normalized()
                                    .toRotationMatrix();
    camera.world_from_camera.linear() = yaw * room_from_camera.linear();
    camera.world_from_camera.translation() =
        room.world_from_room.cast<double>() * room_from_camera.translation();

    std::vector<Vector3f> origins, directions;
    for (int j = 0; j < kProbes; ++j)
      for (int i = 0; i < kProbes; ++i) {
        const Eigen::Vector3d p =
            camera.unproject(width * (i + .5) / kProbes, height * (j + .5) / kProbes, 1);
        origins.push_back(camera.world_from_camera.translation().cast<float>());
        directions.push_back(
            (p - camera.world_from_camera.translation()).normalized().cast<float>());
      }
    std::vector<float> hits = target.trace(origins, directions);
    std::nth_element(hits.begin(), hits.begin() + kProbes * kProbes / 2, hits.end());
    const float median = hits[kProbes * kProbes / 2];
    // A view of nothing but a near wall teaches nothing.
    if (*std::min_element(hits.begin(), hits.end()) < kNearest || median < 1.1f) continue;
    cameras.push_back(camera);
  }
  return cameras;
}

std::vector<Vector3f> freePoints(const Room& room, int count, uint64_t seed) {
  constexpr float kMargin = .03f;  // metres from walls (skirting, frames) and furniture
  std::mt19937_64 random(seed);
  const Vector3f size = room.inside.sizes();
  std::vector<Vector3f> points;
  for (int tries = 0; int(points.size()) < count; ++tries) {
    require(tries < 10000 + 1000 * count, "freePoints: room ", room.seed, " has no air");
    Vector3f p;
    for (int a = 0; a < 3; ++a) p[a] = float(uniform(random, kMargin, size[a] - kMargin));
    if (isFree(room, p, kMargin)) points.push_back(room.world_from_room * p);
  }
  return points;
}

namespace {

/// Whether a triangle meets the box [lo, lo + 1): separating axes (Akenine-Moller 2001). Half-open
/// like the voxels themselves, so that a wall in a face of the grid belongs to one side of it.
bool meets(const std::array<Eigen::Vector3d, 3>& t, const Eigen::Vector3d& lo) {
  for (int a = 0; a < 3; ++a)
    if (!(std::min({t[0][a], t[1][a], t[2][a]}) < lo[a] + 1 &&
          std::max({t[0][a], t[1][a], t[2][a]}) >= lo[a]))
      return false;
  const Eigen::Vector3d centre = lo.array() + .5;
  const std::array<Eigen::Vector3d, 3> v = {t[0] - centre, t[1] - centre, t[2] - centre};
  const std::array<Eigen::Vector3d, 3> edges = {v[1] - v[0], v[2] - v[1], v[0] - v[2]};
  const auto separates = [&](const Eigen::Vector3d& axis) {
    const double p0 = axis.dot(v[0]), p1 = axis.dot(v[1]), p2 = axis.dot(v[2]);
    const double r = .5 * axis.cwiseAbs().sum() + 1e-12;
    return std::min({p0, p1, p2}) > r || std::max({p0, p1, p2}) < -r;
  };
  if (separates(edges[0].cross(edges[1]))) return false;
  for (const Eigen::Vector3d& e : edges)
    for (int a = 0; a < 3; ++a)
      if (separates(e.cross(Eigen::Vector3d::Unit(a)))) return false;
  return true;
}

/// Position in the order in which ComputeTree is iterated: root nodes of 128 voxels by coordinate,
/// then x, y, z within each node's table.
std::array<int64_t, 6> treeKey(const Coord& c, int level) {
  const Coord v(c.x() * (1 << level), c.y() * (1 << level), c.z() * (1 << level));
  const auto slot = [&](int shift, int bits) {
    const int m = (1 << bits) - 1;
    return int64_t(v.x() >> shift & m) << 2 * bits | int64_t(v.y() >> shift & m) << bits |
           int64_t(v.z() >> shift & m);
  };
  return {v.x() >> 7, v.y() >> 7, v.z() >> 7, slot(2, 5), slot(1, 1), slot(0, 1)};
}

}  // namespace

std::vector<Coord> surfaceNodes(const TriangleMesh& mesh, const VoxelFrame& frame, int level) {
  require(level >= 0 && level < kTokenLevels, "surfaceNodes: expected a level 0 to ",
          kTokenLevels - 1, ", found ", level);
  const double per_node = 1. / (1 << level);
  std::vector<std::array<int32_t, 3>> nodes;
  std::vector<Eigen::Vector3d> vertices;
  vertices.reserve(mesh.vertices.size());
  for (const Vector3f& v : mesh.vertices) {
    vertices.push_back(frame.toIndex(v.cast<double>()) * per_node);
    require(vertices.back().cwiseAbs().maxCoeff() < 1e6, "surfaceNodes: a vertex at ",
            v.transpose(), " m is not finite or too far from the grid");
  }
  for (const Eigen::Vector3i& f : mesh.triangles) {
    const std::array<Eigen::Vector3d, 3> t = {vertices[size_t(f[0])], vertices[size_t(f[1])],
                                              vertices[size_t(f[2])]};
    Eigen::Vector3i lo, hi;
    for (int a = 0; a < 3; ++a) {
      lo[a] = int(std::floor(std::min({t[0][a], t[1][a], t[2][a]})));
      hi[a] = int(std::floor(std::max({t[0][a], t[1][a], t[2][a]})));
    }
    for (int x = lo.x(); x <= hi.x(); ++x)
      for (int y = lo.y(); y <= hi.y(); ++y)
        for (int z = lo.z(); z <= hi.z(); ++z)
          if (lo == hi || meets(t, Eigen::Vector3d(x, y, z))) nodes.push_back({x, y, z});
  }
  std::sort(nodes.begin(), nodes.end());
  nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
  std::vector<std::pair<std::array<int64_t, 6>, Coord>> keyed;
  keyed.reserve(nodes.size());
  for (const auto& n : nodes) {
    const Coord c(n[0], n[1], n[2]);
    keyed.emplace_back(treeKey(c, level), c);
  }
  std::sort(keyed.begin(), keyed.end(),
            [](const auto& a, const auto& b) { return a.first < b.first; });
  std::vector<Coord> coords;
  coords.reserve(keyed.size());
  for (const auto& k : keyed) coords.push_back(k.second);
  return coords;
}

}  // namespace vdbc
