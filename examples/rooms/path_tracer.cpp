#include "examples/rooms/path_tracer.h"

#include <algorithm>

#include "examples/rooms/ray_log.h"
#include "examples/rooms/sampling.h"

namespace vdbc {

std::atomic<RayLog*> ray_log{nullptr};

namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

constexpr int kMaxDepth = 24;          // events of a path
constexpr float kGatherSpread = .15f;  // footprint of a diffuse bounce, metres a metre
constexpr float kSharpGloss = .3f;     // what is seen in gloss less rough than this is shaded fully

}  // namespace

Vector3f tint(const Vector3f& colour, float opacity) {
  const float top = colour.maxCoeff();
  return top > 0 ? Vector3f((1 - opacity) / top * colour) : Vector3f::Constant(1 - opacity);
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

}  // namespace vdbc
