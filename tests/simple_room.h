#pragma once
// A small room of boxes, for tests that need a place to look at but no catalogue of furniture.
#include <random>

#include "examples/rooms/rooms.h"
#include "vdb/uniform.h"

namespace vdbc {

/// Adds the box [lo, hi] (room frame), its faces outward, or inward for the shell of a room.
inline void addBox(const Eigen::Vector3f& lo, const Eigen::Vector3f& hi, const Material& material,
                   bool inward, SurfaceMesh* s) {
  using Eigen::Vector3f;
  s->materials.push_back(material);
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      const int u = (axis + 1) % 3, v = (axis + 2) % 3, first = int(s->mesh.vertices.size());
      for (int k = 0; k < 4; ++k) {
        Vector3f p = lo;
        p[axis] = side ? hi[axis] : lo[axis];
        p[u] = (k == 1 || k == 2) ? hi[u] : lo[u];
        p[v] = k >= 2 ? hi[v] : lo[v];
        s->mesh.vertices.push_back(p);
      }
      const bool flip = (side == 0) != inward;
      for (int k : {1, 2}) {
        const int a = flip ? k + 1 : k, b = flip ? k : k + 1;
        s->mesh.triangles.emplace_back(first, first + a, first + b);
        s->material.push_back(int32_t(s->materials.size()) - 1);
        std::array<Eigen::Vector2f, 3> uv;
        const int corners[3] = {first, first + a, first + b};
        for (int c = 0; c < 3; ++c)
          uv[size_t(c)] = {s->mesh.vertices[size_t(corners[c])][u],
                           s->mesh.vertices[size_t(corners[c])][v]};
        s->uv.push_back(uv);
        s->normal.push_back({Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()});
      }
    }
}

/// Metres; no multiples of the voxel, so that no wall of a room's own grid lies in a face of it.
inline const Eigen::Vector3f kSimpleRoomSize(4.23f, 3.37f, 2.62f);

/// A patterned room with a wardrobe, a bed and a table-high block, lit by one lamp; the
/// seed turns and moves it in the world and chooses colours.
inline Room simpleRoom(uint64_t seed) {
  using Eigen::Vector3f;
  using Pattern = Material::Pattern;
  std::mt19937_64 random(seed);
  const auto unit = [&] { return float(uniform(random)); };
  const auto material = [&](Pattern pattern, float period) {
    Material m;
    m.pattern = pattern, m.period_m = period;
    for (int c = 0; c < 3; ++c) m.colour_a[c] = .3f + .5f * unit();
    for (int c = 0; c < 3; ++c) m.colour_b[c] = .1f + .5f * unit();
    return m;
  };
  const Vector3f size = kSimpleRoomSize;
  Room room;
  room.name = "simple:" + std::to_string(seed);
  SurfaceMesh local;
  addBox(Vector3f::Zero(), size, material(Pattern::kTiles, .4f), true, &local);
  const std::array<std::pair<Vector3f, Vector3f>, 3> things = {{
      {{.04f, .04f, 0}, {.66f, 1.72f, 2.03f}},
      {{2.13f, 2.36f, 0}, {4.14f, 3.33f, .52f}},
      {{2.62f, .04f, 0}, {3.81f, .76f, .74f}},
  }};
  for (size_t i = 0; i < things.size(); ++i) {
    const auto& [lo, hi] = things[i];
    addBox(lo, hi, material(i == 1 ? Pattern::kStripes : Pattern::kPlanks, .25f), false, &local);
    room.solids.emplace_back(lo, hi);
    room.pieces.push_back({"", Eigen::Affine3f::Identity(), room.solids.back()});
  }
  room.floor = {{0, 0}, {size.x(), 0}, {size.x(), size.y()}, {0, size.y()}};
  room.ceilings = {{0, 0, size.z()}};
  room.world_from_room = Eigen::Translation3f(4 * unit() - 2, 4 * unit() - 2, 0) *
                         Eigen::AngleAxisf(6.28f * unit(), Vector3f::UnitZ());
  room.surface.append(local, Eigen::Affine3f(room.world_from_room));
  RoomLight lamp;
  lamp.centre = room.world_from_room * Vector3f(2, 1.8f, 2.3f);
  lamp.radius_m = .15f, lamp.radiance = Vector3f::Constant(20);
  room.lights.push_back(lamp);
  return room;
}

/// Views of simpleRoom(seed); the first n are the same for any count.
inline std::vector<View> simpleRoomViews(int count, int width, int height, uint64_t seed) {
  const Room room = simpleRoom(seed);
  const RoomRenderer renderer(room);
  std::mt19937_64 random(seed);
  std::vector<View> views;
  for (const Camera& c : randomCameras(room, renderer.rayTarget(), count, width, height, random)) {
    views.push_back(renderer.render(c, 4, views.size()));
    views.back().name = std::to_string(views.size() - 1);
  }
  return views;
}

}  // namespace vdbc
