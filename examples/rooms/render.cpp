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
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "examples/rooms/path_tracer.h"
#include "examples/rooms/sampling.h"
#include "splat/embree_device.h"
#include "splat/image.h"
#include "vdb/error.h"

namespace vdbc {

using Eigen::Vector2f;
using Eigen::Vector3f;

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

float displayFromLinear(float x) {
  // A slight toe, then linear, then a long shoulder: windows burn out softly.
  constexpr float kKnee = .35f, kToe = .02f;
  x = std::max(x, 0.f);
  x = x * (x + kToe * .5f) / (x + kToe);
  if (x > kKnee) x = kKnee + (1 - kKnee) * (1 - std::exp(-(x - kKnee) / (1 - kKnee)));
  return srgbFromLinear(std::min(x, 1.f));
}

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
