// Rendering a furnished room against Embree's own rate for the very same rays: rooms/render/N draws
// a view of 224 x 224 at N samples; rooms/raw/N traces the rays that this took, recorded before,
// and does nothing else. Compare the rates of one run.
#include <benchmark/benchmark.h>
#include <embree3/rtcore.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <optional>

#include "examples/rooms/ray_log.h"
#include "examples/rooms/rooms.h"
#include "splat/embree_device.h"

namespace vdbc {
namespace {

/// The triangles as one geometry, for the life of the process.
RTCScene embreeScene(const TriangleMesh& mesh) {
  RTCScene scene = rtcNewScene(embreeDevice());
  rtcSetSceneFlags(scene, RTC_SCENE_FLAG_ROBUST);
  RTCGeometry geometry = rtcNewGeometry(embreeDevice(), RTC_GEOMETRY_TYPE_TRIANGLE);
  std::copy(mesh.vertices.begin(), mesh.vertices.end(),
            static_cast<Eigen::Vector3f*>(
                rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3,
                                        sizeof(Eigen::Vector3f), mesh.vertices.size())));
  std::copy(mesh.triangles.begin(), mesh.triangles.end(),
            static_cast<Eigen::Vector3i*>(
                rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3,
                                        sizeof(Eigen::Vector3i), mesh.triangles.size())));
  rtcCommitGeometry(geometry);
  rtcAttachGeometry(scene, geometry);
  rtcReleaseGeometry(geometry);
  rtcCommitScene(scene);
  return scene;
}

struct Scene {
  Room room;
  RoomRenderer renderer;
  RTCScene all;  // every triangle, glass as well
  std::vector<Camera> cameras;

  explicit Scene(Room r) : room(std::move(r)), renderer(room), all(embreeScene(room.surface.mesh)) {
    std::mt19937_64 random(1);
    cameras = randomCameras(room, renderer.rayTarget(), 4, 224, 224, random);
    renderer.render(cameras[0], 1, 1);  // the light of the room, once
  }
};

Scene* scene() {
  static std::optional<Scene> instance;
  if (!instance && AssetLibrary::isInstalled())
    instance.emplace(makeRoom(AssetLibrary::open(), kFirstTrainingSeed + 3));
  return instance ? &*instance : nullptr;
}

void render(benchmark::State& state) {
  Scene* s = scene();
  if (!s) return state.SkipWithError("the catalogues are not installed");
  const int64_t before = s->renderer.raysTraced();
  size_t i = 0;
  for (auto _ : state)
    benchmark::DoNotOptimize(
        s->renderer.render(s->cameras[i++ % s->cameras.size()], int(state.range(0)), 1));
  state.counters["Mrays/s"] = benchmark::Counter(double(s->renderer.raysTraced() - before) * 1e-6,
                                                 benchmark::Counter::kIsRate);
  state.counters["triangles"] = double(s->room.surface.mesh.triangles.size());
}

void raw(benchmark::State& state) {
  Scene* s = scene();
  if (!s) return state.SkipWithError("the catalogues are not installed");
  RayLog log;
  ray_log = &log;
  s->renderer.render(s->cameras[0], int(state.range(0)), 1);
  ray_log = nullptr;
  const std::vector<RayLog::Packet>& packets = log.packets();
  int64_t rays = 0;
  for (const RayLog::Packet& p : packets)
    for (int lane : p.valid) rays += lane != 0;
  for (auto _ : state)
    tbb::parallel_for(tbb::blocked_range<size_t>(0, packets.size(), 256), [&](const auto& range) {
      for (size_t i = range.begin(); i < range.end(); ++i) {
        const RayLog::Packet& p = packets[i];
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        context.flags = p.is_coherent ? RTC_INTERSECT_CONTEXT_FLAG_COHERENT
                                      : RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
        alignas(64) RTCRayHit16 query;
        query.ray = p.ray;
        for (unsigned& id : query.hit.geomID) id = RTC_INVALID_GEOMETRY_ID;
        if (p.is_shadow) {
          rtcOccluded16(p.valid, s->all, &context, &query.ray);
        } else {
          rtcIntersect16(p.valid, s->all, &context, &query);
        }
        benchmark::DoNotOptimize(query);
      }
    });
  state.counters["Mrays/s"] = benchmark::Counter(double(rays) * double(state.iterations()) * 1e-6,
                                                 benchmark::Counter::kIsRate);
}

void construct(benchmark::State& state) {
  Scene* s = scene();
  if (!s) return state.SkipWithError("the catalogues are not installed");
  for (auto _ : state) {
    const RoomRenderer renderer(s->room);
    if (state.range(0)) renderer.render(s->cameras[0], 1, 1);
  }
}

BENCHMARK(render)
    ->Name("rooms/render")
    ->Arg(4)
    ->Arg(8)
    ->Unit(benchmark::kMillisecond)
    ->UseRealTime();
BENCHMARK(raw)->Name("rooms/raw")->Arg(4)->Arg(8)->Unit(benchmark::kMillisecond)->UseRealTime();
// 0: the renderer alone; 1: and a first picture of one sample, which brings the room's light.
BENCHMARK(construct)
    ->Name("rooms/construct")
    ->Arg(0)
    ->Arg(1)
    ->Unit(benchmark::kMillisecond)
    ->UseRealTime();

}  // namespace
}  // namespace vdbc
