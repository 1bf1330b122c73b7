#pragma once
// Procedural rooms and their pictures, rendered with Embree: training, validation and test scenes
// that anyone can rebuild. A seed names a room; the same seed gives the same room on any machine.
#include <memory>
#include <random>
#include <vector>

#include "splat/embree_check.h"
#include "splat/view.h"

namespace vdbc {

/// A texture on a surface, evaluated in the surface's own plane (metres). Colours are scene-linear.
struct Material {
  enum class Pattern {
    kPlain,
    kStripes,
    kChecks,
    kPlanks,
    kTiles,
    kNoise
  } pattern = Pattern::kPlain;
  Eigen::Vector3f colour_a = Eigen::Vector3f::Constant(.6f), colour_b = Eigen::Vector3f::Zero();
  float period_m = 0.3f;
  float emission = 0.f;  // windows and lamps: radiance
};

/// A light, world frame. A rectangle shines to the side of half_u x half_v; with both zero it is a
/// sphere of radius_m. Shadow rays end bound_m before its surface, so that a lamp's shade or the
/// bars of a window do not hide it.
struct RoomLight {
  Eigen::Vector3f centre = Eigen::Vector3f::Zero();
  Eigen::Vector3f half_u = Eigen::Vector3f::Zero(), half_v = Eigen::Vector3f::Zero();  // metres
  float radius_m = 0.f, bound_m = 0.f;
  Eigen::Vector3f radiance = Eigen::Vector3f::Zero();  // scene-linear
};

/// A room: world +Z up, metres, floor at z = 0. One triangle per row of mesh.triangles; the mesh
/// and the lights are in the world frame, `solids` and `inside` are axis-aligned in the room's own
/// frame.
struct Room {
  uint64_t seed = 0;
  Eigen::Isometry3f world_from_room = Eigen::Isometry3f::Identity();  // yaw about +Z and place
  TriangleMesh mesh;
  std::vector<int32_t> material;                      // [triangles] index into materials
  std::vector<Eigen::Vector3f> tangent_u, tangent_v;  // [triangles] texture axes (unit, in plane)
  std::vector<Material> materials;
  std::vector<RoomLight> lights;
  std::vector<Eigen::AlignedBox3f> solids;  // furniture, for placement and free space; room frame
  Eigen::AlignedBox3f inside;               // the air of the room, min corner at 0; room frame
};

/// Walls, floor, ceiling, skirting, one or two doors, windows, rug, pictures and furniture made of
/// primitives (tables, chairs, beds, sofas, wardrobes, shelves, lamps, plants) placed without
/// interpenetration; rectangular floor 3-6.5 x 3-6.5 m, height 2.4-3.0 m, yaw and place in the
/// world random so that nothing learns to lean on the axes (the yaw is about +Z).
Room makeRoom(uint64_t seed);

/// Random cameras in free space at human heights (1.1-1.9 m), looking roughly level, vertical field
/// of view 70 degrees, whose view is not blocked by something within 0.4 m.
std::vector<Camera> randomCameras(const Room& room, int count, int width, int height,
                                  std::mt19937_64& random);

/// Embree scene of a room; keep it to render many views.
class RoomRenderer {
 public:
  explicit RoomRenderer(const Room& room);
  ~RoomRenderer();
  RoomRenderer(RoomRenderer&&) noexcept;

  /// Colour (display sRGB) and planar depth. Diffuse shading: window and lamp area light with
  /// shadow rays, plus a one-bounce ambient estimate; `samples` jittered samples a pixel
  /// (stratified; deterministic for a seed). Depth is of the pixel's centre ray, exact.
  View render(const Camera& camera, int samples, uint64_t seed) const;
  const RayTarget& rayTarget() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Random points in the air of the room (not in furniture): origins for leak rays. World, metres.
std::vector<Eigen::Vector3f> freePoints(const Room& room, int count, uint64_t seed);

/// Coordinates of the level-`level` nodes of `frame`'s grid that a triangle of the mesh meets
/// (exact triangle-box overlap; not clipped to the frame's bounds). Tree order, unique.
std::vector<Coord> surfaceNodes(const TriangleMesh& mesh, const VoxelFrame& frame, int level);

}  // namespace vdbc
