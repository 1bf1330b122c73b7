// Truth of a room on a grid, from its triangles, and its files.
#include <openvdb/io/File.h>
#include <openvdb/tools/MeshToVolume.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "examples/rooms/floor_plan.h"
#include "examples/rooms/rooms.h"
#include "vdb/error.h"
#include "vdb/file_io.h"
#include "vdb/fit_volume.h"
#include "vdb/grid_instances.h"
#include "vdb/vdb_file.h"

namespace vdbc {

using Eigen::Vector3d;
using Eigen::Vector3f;

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
  std::vector<Vector3d> vertices;
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

namespace {

constexpr int kCoarse = kTokenLevels - 1, kCoarseVoxels = 1 << kCoarse;
constexpr float kBandVoxels = 3;  // of `distance`

/// Whole coarse nodes around the room's outline and height, with one more on each side.
VoxelFrame truthFrame(const Room& room, float voxel_m) {
  VoxelFrame frame;
  frame.voxel_m = voxel_m;
  frame.world_from_grid = room.world_from_room.cast<double>();
  const Eigen::Quaterniond turn(frame.world_from_grid.linear());
  frame.world_from_grid.linear() = turn.normalized().toRotationMatrix();
  // Floor and walls at 0 in the middle of a layer of voxels: rounding must not choose between two.
  const Vector3f shift = Vector3f::Constant(voxel_m / 2);
  frame.world_from_grid.translate(-shift.cast<double>());
  Eigen::AlignedBox3f box;
  for (const Eigen::Vector2f& p : room.floor) {
    box.extend(Vector3f(p.x(), p.y(), 0) + shift);
    box.extend(Vector3f(p.x(), p.y(), ceilingAt(room.ceilings, p)) + shift);
  }
  Coord lo, hi;
  for (int a = 0; a < 3; ++a) {
    const float node = voxel_m * kCoarseVoxels;
    lo[a] = (int(std::floor(box.min()[a] / node)) - 1) * kCoarseVoxels;
    hi[a] = (int(std::floor(box.max()[a] / node)) + 2) * kCoarseVoxels - 1;
  }
  frame.bounds = CoordBBox(lo, hi);
  return frame;
}

/// Nodes of `level` inside the bounds.
std::vector<Coord> clipped(std::vector<Coord> nodes, const CoordBBox& bounds, int level) {
  const CoordBBox box(tokenCoord(bounds.min(), level), tokenCoord(bounds.max(), level));
  nodes.erase(
      std::remove_if(nodes.begin(), nodes.end(), [&](const Coord& c) { return !box.isInside(c); }),
      nodes.end());
  return nodes;
}

/// Everything that faces of free voxels lead to from `seeds` without entering a filled voxel.
void floodEmpty(const VoxelFrame& frame, const std::vector<Coord>& seeds, SeenSpace* space) {
  openvdb::tree::ValueAccessor<const TokenMask> filled(space->filled);
  openvdb::tree::ValueAccessor<TokenMask> empty(space->empty);
  std::vector<Coord> open;
  const auto visit = [&](const Coord& c) {
    if (!frame.bounds.isInside(c) || filled.isValueOn(c) || empty.isValueOn(c)) return;
    empty.setValueOn(c);
    open.push_back(c);
  };
  for (const Coord& c : seeds) visit(c);
  while (!open.empty()) {
    const Coord c = open.back();
    open.pop_back();
    for (int axis = 0; axis < 3; ++axis)
      for (int step : {-1, 1}) {
        Coord next = c;
        next[axis] += step;
        visit(next);
      }
  }
}

MaskGrid::Ptr maskGrid(const char* name, const VoxelFrame& frame, int level) {
  MaskGrid::Ptr grid = MaskGrid::create();
  grid->setName(name);
  grid->setTransform(fileTransform(frame, level));
  return grid;
}

MaskGrid::Ptr voxelMask(const char* name, const VoxelFrame& frame, const TokenMask& mask) {
  MaskGrid::Ptr grid = maskGrid(name, frame, 0);
  for (auto value = mask.cbeginValueOn(); value; ++value) {
    CoordBBox box;
    value.getBoundingBox(box);
    grid->sparseFill(box, true, true);
  }
  return grid;
}

FloatGrid::Ptr distanceGrid(const TriangleMesh& mesh, const VoxelFrame& frame) {
  std::vector<openvdb::Vec3s> points;
  std::vector<openvdb::Vec3I> triangles;
  for (const Vector3f& v : mesh.vertices) {
    const Vector3d p =
        frame.toIndex(v.cast<double>()).array() - .5;  // voxel centres at whole indices
    points.emplace_back(float(p.x()), float(p.y()), float(p.z()));
  }
  for (const Eigen::Vector3i& t : mesh.triangles)
    triangles.emplace_back(uint32_t(t[0]), uint32_t(t[1]), uint32_t(t[2]));
  const openvdb::tools::QuadAndTriangleDataAdapter<openvdb::Vec3s, openvdb::Vec3I> data(points,
                                                                                        triangles);
  const auto transform = fileTransform(frame, 0);
  FloatGrid::Ptr grid = openvdb::tools::meshToVolume<FloatGrid>(
      data, *transform, kBandVoxels, kBandVoxels, openvdb::tools::UNSIGNED_DISTANCE_FIELD);
  grid->setName("distance");
  return grid;
}

}  // namespace

TriangleMesh shellMesh(const Room& room) {
  require(room.is_shell.size() == room.surface.mesh.triangles.size(), room.name,
          ": expected to know which of ", room.surface.mesh.triangles.size(),
          " triangles are of the shell, found ", room.is_shell.size());
  TriangleMesh shell;
  shell.vertices = room.surface.mesh.vertices;
  for (size_t i = 0; i < room.is_shell.size(); ++i)
    if (room.is_shell[i] &&
        room.surface.materials[size_t(room.surface.material[i])].opacity >= kSolidOpacity)
      shell.triangles.push_back(room.surface.mesh.triangles[i]);
  return shell;
}

RoomTruth roomTruth(const Room& room, float voxel_m) {
  constexpr int kSeeds = 256;
  RoomTruth truth;
  truth.frame = truthFrame(room, voxel_m);
  const TriangleMesh solid = solidMesh(room.surface);
  for (int level = 0; level < kTokenLevels; ++level)
    truth.surface_nodes[size_t(level)] =
        clipped(surfaceNodes(solid, truth.frame, level), truth.frame.bounds, level);
  truth.space.box = truth.frame.bounds;
  for (const Coord& c : truth.surface_nodes[0]) truth.space.filled.setValueOn(c);
  std::vector<Coord> seeds;
  for (const Vector3f& p : freePoints(room, kSeeds, 0)) {
    const Vector3d q = truth.frame.toIndex(p.cast<double>());
    seeds.push_back(Coord::floor(openvdb::Vec3d(q.x(), q.y(), q.z())));
  }
  floodEmpty(truth.frame, seeds, &truth.space);
  openvdb::tools::pruneInactive(truth.space.empty);
  return truth;
}

void writeTruth(const Room& room, const RoomTruth& truth, const std::string& path) {
  openvdb::GridPtrVec grids = {voxelMask("filled", truth.frame, truth.space.filled),
                               voxelMask("empty", truth.frame, truth.space.empty)};
  for (int level = 1; level < kTokenLevels; ++level) {
    MaskGrid::Ptr nodes = maskGrid(level == 1 ? "nodes_1" : "nodes_2", truth.frame, level);
    for (const Coord& c : truth.surface_nodes[size_t(level)]) nodes->tree().setValueOn(c);
    grids.push_back(nodes);
  }
  grids.push_back(distanceGrid(solidMesh(room.surface), truth.frame));
  TemporaryFile file("writeTruth", path);
  openvdb::io::File out(file.path());
  out.write(grids);
  out.close();
  file.commit();
}

void writeMesh(const TriangleMesh& mesh, const std::string& path) {
  std::string bytes =
      joinText("ply\nformat binary_little_endian 1.0\nelement vertex ", mesh.vertices.size(),
               "\nproperty float x\nproperty float y\nproperty float z\nelement face ",
               mesh.triangles.size(), "\nproperty list uchar int vertex_indices\nend_header\n");
  for (const Vector3f& v : mesh.vertices)
    bytes.append(reinterpret_cast<const char*>(v.data()), 3 * sizeof(float));
  for (const Eigen::Vector3i& t : mesh.triangles) {
    bytes.push_back(3);
    bytes.append(reinterpret_cast<const char*>(t.data()), 3 * sizeof(int32_t));
  }
  writeFile("writeMesh", path, bytes.data(), bytes.size());
}

}  // namespace vdbc
