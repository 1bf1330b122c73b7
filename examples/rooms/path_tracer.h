#pragma once
// Private: what a RoomRenderer keeps of a room, and the paths that light takes in it.
#include <embree3/rtcore.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <memory>
#include <mutex>
#include <vector>

#include "examples/rooms/light_cache.h"
#include "examples/rooms/lights.h"
#include "examples/rooms/rooms.h"
#include "examples/rooms/textures.h"

namespace vdbc {

constexpr int kPacket = 16;
constexpr float kOffset = 2e-4f;    // metres: from a surface to the rays that leave it
constexpr float kCacheReach = .3f;  // metres: shorter bounces do not read the cache

struct Packet {
  alignas(64) RTCRayHit16 query;
  alignas(64) std::array<int, kPacket> valid;
  std::array<Eigen::Vector3f, kPacket> passed;  // by a shadow ray through glass

  // Where Embree splits packets into smaller ones it takes rays for unset by tnear > tfar alone.
  Packet() {
    valid.fill(0);
    query.ray = {};
    std::fill_n(query.ray.tfar, kPacket, -1.f);
  }
  void set(int k, const Eigen::Vector3f& o, const Eigen::Vector3f& d, float tfar) {
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
  Eigen::Vector3f origin, direction, throughput;
  uint32_t slot = 0, key = 0, sample = 0;
  float width = 0, spread = 0;  // footprint: metres, metres a metre
  float travelled = 0;          // metres since its last diffuse bounce
  bool sees_spots = true;       // brings the light of spots at any distance
  int16_t depth = 0;
  bool sees_emission = true;  // the eye's ray and its mirror images
  bool may_gather = false;    // reads the cache where it ends
};

struct Shadow {
  Eigen::Vector3f origin, direction, value;
  float reach = 0;
  uint32_t slot = 0;
};

/// A spot of sunlight or of other light far above the room's mean, which lights the room in turn:
/// all those farther off than kCacheReach are sampled as lights, as chance would seldom find them.
/// Nearer ones are left to the bounces.
struct Spot {
  Eigen::Vector3f position, normal, power;  // power: what it reflects, over pi
  float specular = 0;
};

struct Hit {
  Eigen::Vector3f position, normal, shading_normal;  // both face the ray's origin
  Eigen::Vector3f colour;
  const Material* material = nullptr;
  float distance = 0, width = 0;
};

/// Light that passes a translucent surface of this colour: clear glass does not darken, whatever
/// its colour's brightness.
Eigen::Vector3f tint(const Eigen::Vector3f& colour, float opacity);

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
  std::vector<std::array<Eigen::Vector3f, 3>> panes;
  SunMask sun_mask;
  Eigen::Isometry3f room_from_world;
  std::vector<Eigen::Vector3f> origins;  // in the air: where the cache's paths begin

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
  Eigen::Vector2f uvAt(int32_t t, float u, float v) const {
    const auto& uv = surface.uv[size_t(t)];
    return (1 - u - v) * uv[0] + u * uv[1] + v * uv[2];
  }
  Eigen::Vector3f colourAt(int32_t t, float u, float v, float footprint) const;
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
  Event scatter(const Hit& hit, const Eigen::Vector2f& choice, const Eigen::Vector2f& direction,
                Path* path) const;
  static bool bounce(const Hit& hit, uint32_t key, Path* path);
  void addSun(const Hit& hit, const Eigen::Vector3f& reflectance, uint32_t slot,
              std::vector<Shadow>* suns) const;
  void addSpot(const Hit& hit, const Eigen::Vector3f& reflectance, uint32_t key, uint32_t sample,
               uint32_t slot, std::vector<Shadow>* shadows) const;
  void addLight(const Hit& hit, const Eigen::Vector3f& reflectance, uint32_t key, uint32_t sample,
                uint32_t slot, std::vector<Shadow>* shadows) const;
  void traceShadows(const std::vector<Shadow>& shadows, Eigen::Vector3f* sums) const;
  void traceSun(std::vector<Shadow>* suns, Eigen::Vector3f* sums) const;

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
  std::vector<Eigen::Vector3f> sums;
};

}  // namespace vdbc
