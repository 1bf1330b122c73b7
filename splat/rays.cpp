#include "splat/rays.h"

#include <embree3/rtcore.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "splat/embree_device.h"
#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {

RTCDevice embreeDevice() {
  static const struct Holder {
    RTCDevice device = rtcNewDevice(nullptr);
    ~Holder() { rtcReleaseDevice(device); }
  } holder;
  require(holder.device != nullptr, "Embree: cannot create a device");
  return holder.device;
}

namespace {

constexpr float kInfinity = std::numeric_limits<float>::infinity();

struct VoxelBox {
  Eigen::Vector3f min;  // index space; the box is [min, min + 1]
};

struct Ray {
  Eigen::Vector3d origin, direction;
};

// Entry distance of a ray into a closed box, 0 from inside, infinity for a miss.
double entry(const VoxelBox& box, const Ray& ray) {
  double near = 0, far = std::numeric_limits<double>::infinity();
  for (int a = 0; a < 3; ++a) {
    const double lo = box.min[a] - ray.origin[a], hi = lo + 1, d = ray.direction[a];
    if (d == 0) {
      if (lo > 0 || hi < 0) return far;
      continue;
    }
    near = std::max(near, std::min(lo / d, hi / d));
    far = std::min(far, std::max(lo / d, hi / d));
  }
  return near <= far ? near : std::numeric_limits<double>::infinity();
}

void boundsCallback(const RTCBoundsFunctionArguments* args) {
  const VoxelBox& box = static_cast<const VoxelBox*>(args->geometryUserPtr)[args->primID];
  RTCBounds* b = args->bounds_o;
  b->lower_x = box.min.x(), b->upper_x = box.min.x() + 1;
  b->lower_y = box.min.y(), b->upper_y = box.min.y() + 1;
  b->lower_z = box.min.z(), b->upper_z = box.min.z() + 1;
}

void intersectCallback(const RTCIntersectFunctionNArguments* args) {
  const VoxelBox& box = static_cast<const VoxelBox*>(args->geometryUserPtr)[args->primID];
  RTCRayN* rays = RTCRayHitN_RayN(args->rayhit, args->N);
  RTCHitN* hits = RTCRayHitN_HitN(args->rayhit, args->N);
  for (unsigned i = 0; i < args->N; ++i) {
    if (!args->valid[i]) continue;
    const Ray ray{{RTCRayN_org_x(rays, args->N, i), RTCRayN_org_y(rays, args->N, i),
                   RTCRayN_org_z(rays, args->N, i)},
                  {RTCRayN_dir_x(rays, args->N, i), RTCRayN_dir_y(rays, args->N, i),
                   RTCRayN_dir_z(rays, args->N, i)}};
    const float t = float(entry(box, ray));
    if (!(t >= RTCRayN_tnear(rays, args->N, i) && t < RTCRayN_tfar(rays, args->N, i))) continue;
    RTCRayN_tfar(rays, args->N, i) = t;
    RTCHitN_geomID(hits, args->N, i) = args->geomID;
    RTCHitN_primID(hits, args->N, i) = args->primID;
  }
}

struct RayBundle {
  std::vector<Eigen::Vector3f> origins, directions;
};

// Uniform directions, origins in turn.
RayBundle randomRays(const std::vector<Eigen::Vector3f>& origins, int count, uint64_t seed) {
  RayBundle rays;
  if (origins.empty()) return rays;
  std::mt19937_64 random(seed);
  rays.origins.reserve(size_t(std::max(count, 0)));
  rays.directions.reserve(size_t(std::max(count, 0)));
  for (int i = 0; i < count; ++i) {
    const double z = 2 * uniform(random) - 1, angle = 2 * M_PI * uniform(random);
    const double r = std::sqrt(std::max(0., 1 - z * z));
    rays.origins.push_back(origins[size_t(i) % origins.size()]);
    rays.directions.push_back(
        Eigen::Vector3d(r * std::cos(angle), r * std::sin(angle), z).cast<float>());
  }
  return rays;
}

}  // namespace

struct RayTarget::Impl {
  RTCScene scene = nullptr;
  // Voxels are traced in index space, where their faces are exact integers; distances along the
  // transformed, unnormalised direction are still metres.
  bool is_indexed = false;
  VoxelFrame frame;
  std::vector<VoxelBox> boxes;

  Impl() : scene(rtcNewScene(embreeDevice())) {
    // Robust: rays must not slip through the edge shared by two triangles.
    rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
    rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_MEDIUM);
  }
  ~Impl() { rtcReleaseScene(scene); }
  Impl(const Impl&) = delete;
  Impl& operator=(const Impl&) = delete;

  void attach(RTCGeometry geometry) {
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene);
  }
};

RayTarget::RayTarget(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
RayTarget::RayTarget(RayTarget&&) noexcept = default;
RayTarget& RayTarget::operator=(RayTarget&&) noexcept = default;
RayTarget::~RayTarget() = default;

RayTarget RayTarget::fromMesh(const TriangleMesh& mesh) {
  const int vertex_count = int(mesh.vertices.size());
  for (const Eigen::Vector3i& t : mesh.triangles)
    require(t.minCoeff() >= 0 && t.maxCoeff() < vertex_count, "RayTarget: a triangle names vertex ",
            t.minCoeff() < 0 ? t.minCoeff() : t.maxCoeff(), ", expected 0 to ", vertex_count - 1);
  auto impl = std::make_unique<Impl>();
  RTCGeometry geometry = rtcNewGeometry(embreeDevice(), RTC_GEOMETRY_TYPE_TRIANGLE);
  // Embree's own buffers are padded for its vector loads; empty ones cannot be made.
  if (!mesh.triangles.empty()) {
    auto* vertices = static_cast<Eigen::Vector3f*>(
        rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                sizeof(Eigen::Vector3f), mesh.vertices.size()));
    auto* triangles = static_cast<Eigen::Vector3i*>(
        rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                sizeof(Eigen::Vector3i), mesh.triangles.size()));
    require(vertices && triangles, "RayTarget: no memory for ", mesh.triangles.size(),
            " triangles");
    std::copy(mesh.vertices.begin(), mesh.vertices.end(), vertices);
    std::copy(mesh.triangles.begin(), mesh.triangles.end(), triangles);
  }
  impl->attach(geometry);
  return RayTarget(std::move(impl));
}

RayTarget RayTarget::fromVoxels(const VoxelFrame& frame, const std::vector<Coord>& voxels) {
  auto impl = std::make_unique<Impl>();
  impl->is_indexed = true;
  impl->frame = frame;
  impl->boxes.reserve(voxels.size());
  for (const Coord& c : voxels)
    impl->boxes.push_back({Eigen::Vector3f(float(c.x()), float(c.y()), float(c.z()))});
  RTCGeometry geometry = rtcNewGeometry(embreeDevice(), RTC_GEOMETRY_TYPE_USER);
  rtcSetGeometryUserPrimitiveCount(geometry, unsigned(impl->boxes.size()));
  rtcSetGeometryUserData(geometry, impl->boxes.data());
  rtcSetGeometryBoundsFunction(geometry, boundsCallback, nullptr);
  rtcSetGeometryIntersectFunction(geometry, intersectCallback);
  impl->attach(geometry);
  return RayTarget(std::move(impl));
}

std::vector<float> RayTarget::trace(const std::vector<Eigen::Vector3f>& origins,
                                    const std::vector<Eigen::Vector3f>& directions) const {
  require(origins.size() == directions.size(), "RayTarget: ", origins.size(), " origins but ",
          directions.size(), " directions");
  std::vector<float> distance(origins.size());
  const Eigen::Isometry3d grid_from_world = impl_->frame.world_from_grid.inverse();
  const double per_voxel = 1 / double(impl_->frame.voxel_m);
  tbb::parallel_for(tbb::blocked_range<size_t>(0, origins.size(), 1024), [&](const auto& range) {
    for (size_t i = range.begin(); i < range.end(); ++i) {
      Eigen::Vector3f o = origins[i], d = directions[i];
      if (impl_->is_indexed) {
        o = (grid_from_world * o.cast<double>() * per_voxel).cast<float>();
        d = (grid_from_world.linear() * d.cast<double>() * per_voxel).cast<float>();
      }
      RTCIntersectContext context;
      rtcInitIntersectContext(&context);
      RTCRayHit query = {};
      query.ray.org_x = o.x(), query.ray.org_y = o.y(), query.ray.org_z = o.z();
      query.ray.dir_x = d.x(), query.ray.dir_y = d.y(), query.ray.dir_z = d.z();
      query.ray.tfar = kInfinity;
      query.ray.mask = ~0u;
      query.hit.geomID = RTC_INVALID_GEOMETRY_ID;
      rtcIntersect1(impl_->scene, &context, &query);
      distance[i] = query.hit.geomID == RTC_INVALID_GEOMETRY_ID ? kInfinity : query.ray.tfar;
    }
  });
  return distance;
}

DepthAgreement depthAgreement(const RayTarget& target, const std::vector<View>& views,
                              float tolerance_m) {
  DepthAgreement result;
  std::vector<float> errors;
  int64_t within = 0;
  for (const View& view : views) {
    const Camera& c = view.camera;
    require(view.depth.size() == size_t(c.width) * size_t(c.height), "depthAgreement: ", view.name,
            ": expected ", size_t(c.width) * size_t(c.height), " depths, found ",
            view.depth.size());
    std::vector<Eigen::Vector3f> origins, directions;
    std::vector<float> given, z_per_metre;
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        const float z = view.depth[size_t(y) * size_t(c.width) + size_t(x)];
        if (!(z > 0) || !std::isfinite(z)) continue;
        const Eigen::Vector3d d =
            Eigen::Vector3d((x + .5 - c.cx) / c.fx, (y + .5 - c.cy) / c.fy, 1).normalized();
        origins.push_back(c.world_from_camera.translation().cast<float>());
        directions.push_back((c.world_from_camera.linear() * d).cast<float>());
        given.push_back(z);
        z_per_metre.push_back(float(d.z()));
      }
    const std::vector<float> traced = target.trace(origins, directions);
    for (size_t i = 0; i < traced.size(); ++i) {
      if (!std::isfinite(traced[i])) continue;
      errors.push_back(std::abs(traced[i] * z_per_metre[i] - given[i]));
      within += errors.back() <= tolerance_m;
    }
    result.rays += int64_t(traced.size());
  }
  if (result.rays == 0) return result;
  result.within_share = double(within) / double(result.rays);
  result.miss_share = 1 - double(errors.size()) / double(result.rays);
  if (!errors.empty()) {
    std::nth_element(errors.begin(), errors.begin() + ptrdiff_t(errors.size() / 2), errors.end());
    result.median_error_m = errors[errors.size() / 2];
  }
  return result;
}

double leakRate(const RayTarget& truth, const RayTarget& output,
                const std::vector<Eigen::Vector3f>& origins, int rays, float tolerance_m,
                uint64_t seed) {
  const RayBundle bundle = randomRays(origins, rays, seed);
  const std::vector<float> expected = truth.trace(bundle.origins, bundle.directions);
  const std::vector<float> found = output.trace(bundle.origins, bundle.directions);
  int64_t met = 0, leaked = 0;
  for (size_t i = 0; i < expected.size(); ++i) {
    if (!std::isfinite(expected[i])) continue;
    ++met;
    leaked += !(found[i] < expected[i] + tolerance_m);
  }
  return met ? double(leaked) / double(met) : std::numeric_limits<double>::quiet_NaN();
}

double openShare(const RayTarget& output, const std::vector<Eigen::Vector3f>& origins, int rays,
                 uint64_t seed) {
  const RayBundle bundle = randomRays(origins, rays, seed);
  const std::vector<float> found = output.trace(bundle.origins, bundle.directions);
  const auto open =
      std::count_if(found.begin(), found.end(), [](float t) { return !std::isfinite(t); });
  return found.empty() ? std::numeric_limits<double>::quiet_NaN()
                       : double(open) / double(found.size());
}

}  // namespace vdbc
