#pragma once
// Furnished rooms and their pictures, rendered with Embree: training, validation and test scenes
// that anyone can rebuild. A seed names a room; the same seed gives the same room on any machine.
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "examples/rooms/assets.h"
#include "examples/rooms/surface.h"
#include "splat/view.h"

namespace vdbc {

/// A light, world frame. A rectangle shines to the side of half_u x half_v; with both zero it is a
/// sphere of radius_m. Shadow rays end bound_m before its surface, so that a lamp's shade or the
/// bars of a window do not hide it.
struct RoomLight {
  Eigen::Vector3f centre = Eigen::Vector3f::Zero();
  Eigen::Vector3f half_u = Eigen::Vector3f::Zero(), half_v = Eigen::Vector3f::Zero();  // metres
  float radius_m = 0.f, bound_m = 0.f;
  Eigen::Vector3f radiance = Eigen::Vector3f::Zero();  // scene-linear
};

/// The sun: parallel light that comes in where it meets a window's pane (a material with emission).
struct Sun {
  Eigen::Vector3f towards = Eigen::Vector3f::UnitZ();  // unit, world
  Eigen::Vector3f irradiance =
      Eigen::Vector3f::Zero();  // on a plane across it, scene-linear; 0: none
};

/// A piece of furniture in a room.
struct Piece {
  std::string model;  // catalogue id; "" of what the room builds itself
  Eigen::Affine3f room_from_model = Eigen::Affine3f::Identity();
  Eigen::AlignedBox3f box;  // of its vertices; room frame
};

/// A room: world +Z up, metres, floor at z = 0 of the room frame. The surface and the lights are in
/// the world frame; floor, ceilings, pieces and solids in the room's own frame.
struct Room {
  std::string name;  // "rooms:17", "homes:3"
  std::string
      kind;  // bedroom, living, dining, study, kitchen, bathroom, office; of a home its own name
  Eigen::Isometry3f world_from_room = Eigen::Isometry3f::Identity();  // yaw about +Z and place
  SurfaceMesh surface;
  /// [T] 1: of the shell (floors, ceilings, walls, skirting, doors, windows and their curtains); 0:
  /// of what stands, lies or hangs in it. Empty where that is not known.
  std::vector<uint8_t> is_shell;
  std::vector<RoomLight> lights;
  Sun sun;
  std::vector<Eigen::Vector2f> floor;     // outline, counter-clockwise from above
  std::vector<Eigen::Vector3f> ceilings;  // z < a x + b y + c for each (a, b, c)
  std::vector<Piece> pieces;
  std::vector<Eigen::AlignedBox3f> solids;  // what can't be walked or looked through
};

/// Training rooms have seeds from here on, and only models that are not held out; rooms of lower
/// seeds have only models that are.
constexpr uint64_t kFirstTrainingSeed = 1000000;

/// A furnished room: walls, floor, ceiling (now and then sloped), skirting, doors, windows, rugs,
/// pictures, lamps, and furniture placed by the rules of its kind, without interpenetration and
/// with walkable space left; rectangular or L-shaped; yaw and place in the world random, so that
/// nothing learns to lean on the axes. Throws Error.
Room makeRoom(const AssetLibrary& assets, uint64_t seed);

/// Number of furnished rooms in the jar's example homes, and one of them with its whole home around
/// it: layouts by people, held out. Throws Error.
int homeRoomCount(const AssetLibrary& assets);
Room homeRoom(const AssetLibrary& assets, int index);
/// The furnished rooms of a .sh3d file (Sweet Home 3D 5.3 or newer), whose furniture has to be in
/// the catalogues. Throws Error.
std::vector<Room> readHome(const AssetLibrary& assets, const std::string& sh3d_path);

/// Whether a point of the room frame is in the room's air, at least margin_m from its walls, floor,
/// ceilings and solids.
bool isFree(const Room& room, const Eigen::Vector3f& p_room, float margin_m);

/// Whether a point of the room frame is over the room's floor and below its ceilings, in furniture
/// or not.
bool isWithin(const Room& room, const Eigen::Vector3f& p_room);

/// The solid triangles (solidMesh) of the shell, world frame. Throws Error where is_shell is empty.
TriangleMesh shellMesh(const Room& room);

/// Random cameras in free space at human heights (1.1-1.9 m), looking roughly level, vertical field
/// of view 70 degrees, whose view is not blocked by something near. `solid` is the room's
/// solidMesh. Throws Error where the room has no place for them.
std::vector<Camera> randomCameras(const Room& room, const RayTarget& solid, int count, int width,
                                  int height, std::mt19937_64& random);

/// 0.1 m cells of the world in which a camera sees a surface, sorted and unique: what it covers.
std::vector<Coord> coveredCells(const RayTarget& solid, const Camera& camera);

/// Of `candidates` the `count` that see most of the room: greedily, each next one adds most covered
/// cells to those before it; in that order. Paper sec. 4, 3DFront.
std::vector<Camera> coveringCameras(const RayTarget& solid, const std::vector<Camera>& candidates,
                                    int count);

/// Everything a renderer knows of a view.
struct RoomPicture {
  View view;       // colour: display sRGB, tone-mapped; planar depth
  Image radiance;  // [H, W, 3] scene-linear, exposed, before the tone curve
  Image normal;    // [H, W, 3] world, unit, towards the camera; 0 where nothing is hit
  std::vector<int32_t>
      material;  // [H * W] index into the surface's materials; -1 where nothing is hit
};

/// Embree scene of a room; keep it to render many views.
class RoomRenderer {
 public:
  explicit RoomRenderer(const Room& room);
  ~RoomRenderer();
  RoomRenderer(RoomRenderer&&) noexcept;

  /// Path-traced picture: `samples` a pixel, the same for the same seed whatever the threads.
  /// Depth, normal and material are of the pixel's centre ray and exact: the first solid surface.
  RoomPicture picture(const Camera& camera, int samples, uint64_t seed) const;
  View render(const Camera& camera, int samples, uint64_t seed) const;
  /// Depth alone, without colour: cheap.
  View renderDepth(const Camera& camera) const;
  /// The solid surface (solidMesh).
  const RayTarget& rayTarget() const;
  /// Rays traced so far, of all kinds.
  int64_t raysTraced() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// Samples a pixel: 30 dB or more against 4,096 in most rooms at 224 x 224 (docs/notes/rooms.md).
constexpr int kRoomSamples = 8;

/// `count` cameras in a room, the covering ones of four times as many random ones, in random order:
/// any first n of them are a random choice. The same for the same seed.
std::vector<Camera> roomCameras(const Room& room, const RoomRenderer& renderer, int count,
                                int width, int height, uint64_t seed);
/// Their pictures; the i-th is rendered with seed + i.
std::vector<View> roomViews(const Room& room, const RoomRenderer& renderer, int count, int width,
                            int height, int samples, uint64_t seed);

/// Random points in the air of the room (not in furniture): origins for leak rays. World, metres.
std::vector<Eigen::Vector3f> freePoints(const Room& room, int count, uint64_t seed);

/// Coordinates of the level-`level` nodes of `frame`'s grid that a triangle of the mesh meets
/// (exact triangle-box overlap; not clipped to the frame's bounds). Tree order, unique.
std::vector<Coord> surfaceNodes(const TriangleMesh& mesh, const VoxelFrame& frame, int level);

/// Truth of a room on a grid: F where the surface is, E where its air is (reached from free points
/// through voxels without surface), U elsewhere: behind the walls and inside closed furniture. The
/// grid is aligned with the room and holds it with a margin of one coarse node.
struct RoomTruth {
  VoxelFrame frame;
  SeenSpace space;                                             // level 0
  std::array<std::vector<Coord>, kTokenLevels> surface_nodes;  // occupancy by level, in the bounds
};
RoomTruth roomTruth(const Room& room, float voxel_m);

/// Writes the truth as a .vdb: mask grids `filled` and `empty` (voxels), `nodes_1` and `nodes_2`
/// (occupancy of the higher levels, on their own transforms), and `distance`, the unsigned distance
/// to the mesh in metres within three voxels. Temporary name, then rename. Throws Error.
void writeTruth(const Room& room, const RoomTruth& truth, const std::string& path);

/// The room's solid surface as a binary PLY, world frame, metres. Throws Error.
void writeMesh(const TriangleMesh& mesh, const std::string& path);

}  // namespace vdbc
