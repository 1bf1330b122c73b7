// Truth of rooms on a grid, against sampling, exact clipping, flood-free brute force and the file
// read back.
#include <gtest/gtest.h>
#include <openvdb/openvdb.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <set>
#include <tuple>

#include "tests/simple_room.h"
#include "vdb/error.h"
#include "vdb/grid_instances.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Eigen::Vector3f;

using NodeSet = std::set<std::tuple<int, int, int>>;
NodeSet asSet(const std::vector<Coord>& coords) {
  NodeSet set;
  for (const Coord& c : coords) set.emplace(c.x(), c.y(), c.z());
  return set;
}

VoxelFrame turnedFrame() {
  VoxelFrame frame;
  frame.voxel_m = .1f;
  frame.world_from_grid = Eigen::Translation3d(.37, -1.21, -.043) *
                          Eigen::AngleAxisd(.6, Vector3d(.1, .2, 1).normalized());
  return frame;
}

TEST(SurfaceNodes, HoldEveryPointOfTheSurface) {
  const Room room = simpleRoom(5);
  const VoxelFrame frame = turnedFrame();
  std::mt19937_64 random(3);
  for (int level = 0; level < kTokenLevels; ++level) {
    const std::vector<Coord> nodes = surfaceNodes(room.surface.mesh, frame, level);
    const NodeSet set = asSet(nodes);
    EXPECT_EQ(set.size(), nodes.size());  // unique
    NodeSet sampled;
    for (const Eigen::Vector3i& t : room.surface.mesh.triangles) {
      const Vector3d a = room.surface.mesh.vertices[size_t(t[0])].cast<double>();
      const Vector3d u = room.surface.mesh.vertices[size_t(t[1])].cast<double>() - a;
      const Vector3d v = room.surface.mesh.vertices[size_t(t[2])].cast<double>() - a;
      const int samples = 2 + int(u.cross(v).norm() * 1500);
      for (int i = 0; i < samples; ++i) {
        double p = uniform(random), q = uniform(random);
        if (p + q > 1) p = 1 - p, q = 1 - q;
        const Vector3d g = frame.toIndex(a + p * u + q * v);
        const Coord c(int(std::floor(g.x())) >> level, int(std::floor(g.y())) >> level,
                      int(std::floor(g.z())) >> level);
        sampled.emplace(c.x(), c.y(), c.z());
      }
    }
    for (const auto& s : sampled)
      EXPECT_TRUE(set.count(s)) << "level " << level << ": " << std::get<0>(s) << " "
                                << std::get<1>(s) << " " << std::get<2>(s);
    // Dense samples miss only corners that are barely cut.
    EXPECT_GT(double(sampled.size()), .93 * double(set.size())) << level;
  }
}

/// Area of a triangle clipped to a box by its six planes (Sutherland-Hodgman): an exact overlap
/// test that shares nothing with separating axes.
double clippedArea(std::vector<Vector3d> polygon, const Vector3d& lo, const Vector3d& hi) {
  for (int axis = 0; axis < 3; ++axis)
    for (double side : {-1., 1.}) {
      const double at = side > 0 ? hi[axis] : lo[axis];
      std::vector<Vector3d> kept;
      for (size_t i = 0; i < polygon.size(); ++i) {
        const Vector3d &p = polygon[i], &q = polygon[(i + 1) % polygon.size()];
        const double dp = side * (at - p[axis]), dq = side * (at - q[axis]);
        if (dp >= 0) kept.push_back(p);
        if ((dp >= 0) != (dq >= 0)) kept.push_back(p + (q - p) * (dp / (dp - dq)));
      }
      polygon = kept;
    }
  Vector3d area = Vector3d::Zero();
  for (size_t i = 2; i < polygon.size(); ++i)
    area += (polygon[i - 1] - polygon[0]).cross(polygon[i] - polygon[0]) / 2;
  return area.norm();
}

TEST(SurfaceNodes, EqualExactClipping) {
  std::mt19937_64 random(9);
  const auto real = [&] { return uniform(random) * 2 - 1; };
  const VoxelFrame frame = turnedFrame();
  for (int trial = 0; trial < 60; ++trial) {
    TriangleMesh mesh;
    for (int k = 0; k < 3; ++k)
      mesh.vertices.emplace_back(float(real() * .6), float(real() * .6), float(real() * .6));
    mesh.triangles.emplace_back(0, 1, 2);
    const NodeSet found = asSet(surfaceNodes(mesh, frame, trial % 3));
    std::vector<Vector3d> corners;
    for (const Vector3f& v : mesh.vertices) corners.push_back(frame.toIndex(v.cast<double>()));
    const int edge = 1 << trial % 3;
    Eigen::AlignedBox3d bounds;
    for (const Vector3d& c : corners) bounds.extend(c);
    const Eigen::Vector3i first = (bounds.min() / edge).array().floor().cast<int>() - 1;
    const Eigen::Vector3i last = (bounds.max() / edge).array().floor().cast<int>() + 1;
    for (int x = first.x(); x <= last.x(); ++x)
      for (int y = first.y(); y <= last.y(); ++y)
        for (int z = first.z(); z <= last.z(); ++z) {
          const Vector3d lo = Vector3d(x, y, z) * edge, hi = lo.array() + edge;
          const bool is_found = found.count({x, y, z}) > 0;
          const double area = clippedArea(corners, lo, hi);
          if (area > 1e-9) {
            EXPECT_TRUE(is_found) << trial << " area " << area;
          } else if (clippedArea(corners, lo.array() - 1e-6, hi.array() + 1e-6) == 0) {
            EXPECT_FALSE(is_found) << trial;
          }
        }
  }
}

TEST(SurfaceNodes, WallInAFaceOfTheGridBelongsToOneSide) {
  // Half-open voxels: the floor z = 0 lies in voxels z = 0, not in z = -1 as well.
  Room room;
  addBox(Vector3f::Zero(), {1, 1, .95f}, Material(), true, &room.surface);
  VoxelFrame frame;
  int floor_voxels = 0;
  for (const Coord& c : surfaceNodes(room.surface.mesh, frame, 0)) {
    EXPECT_GE(c.z(), 0);
    EXPECT_GE(c.x(), 0);
    floor_voxels += c.z() == 0 && c.x() > 0 && c.x() < 10 && c.y() > 0 && c.y() < 10;
  }
  EXPECT_EQ(floor_voxels, 81);
}

TEST(SurfaceNodes, AreInTreeOrder) {
  const Room room = simpleRoom(7);
  const VoxelFrame frame = turnedFrame();
  const TokenGrid grid = TokenGrid::fromCoords(surfaceNodes(room.surface.mesh, frame, 0));
  EXPECT_EQ(surfaceNodes(room.surface.mesh, frame, 0), grid.coords(0));
  // A node is met where one of its children is: levels agree.
  EXPECT_EQ(surfaceNodes(room.surface.mesh, frame, 1), grid.coords(1));
  EXPECT_EQ(surfaceNodes(room.surface.mesh, frame, 2), grid.coords(2));
}

// --- roomTruth

TEST(RoomTruth, FilledEmptyAndUnknownAreWhatTheBoxesSay) {
  const Room room = simpleRoom(3);
  const RoomTruth truth = roomTruth(room, .1f);
  const Eigen::Isometry3d room_from_world = room.world_from_room.cast<double>().inverse();
  int64_t empty = 0, unknown = 0;
  for (auto c = truth.frame.bounds.begin(); c; ++c) {
    const bool filled = truth.space.filled.isValueOn(*c),
               is_empty = truth.space.empty.isValueOn(*c);
    EXPECT_FALSE(filled && is_empty);
    if (filled) continue;
    // Without a surface in it, a voxel is all on one side: its centre tells.
    const Coord v = *c;
    const Vector3d p =
        room_from_world * truth.frame.toWorld(Vector3d(v.x() + .5, v.y() + .5, v.z() + .5));
    const bool in_room = p.minCoeff() > 0 && (p.cast<float>() - kSimpleRoomSize).maxCoeff() < 0;
    const bool in_thing = std::any_of(room.solids.begin(), room.solids.end(), [&](const auto& box) {
      return box.contains(p.cast<float>());
    });
    EXPECT_EQ(is_empty, in_room && !in_thing) << p.transpose();
    ++(is_empty ? empty : unknown);
  }
  EXPECT_GT(empty, 10000);
  EXPECT_GT(unknown, 1000);
}

TEST(RoomTruth, LevelsAgree) {
  const RoomTruth truth = roomTruth(simpleRoom(4), .1f);
  const TokenGrid grid = TokenGrid::fromCoords(truth.surface_nodes[0]);
  for (int level = 0; level < kTokenLevels; ++level)
    EXPECT_EQ(truth.surface_nodes[size_t(level)], grid.coords(level)) << level;
}

TEST(RoomTruth, ObservationNeverContradictsIt) {
  // What views see empty is empty or surface in truth (a ray may pass through a voxel that also
  // holds a surface); what they see filled is surface.
  const Room room = simpleRoom(5);
  const RoomTruth truth = roomTruth(room, .1f);
  const std::vector<View> views = simpleRoomViews(3, 64, 48, 5);
  std::vector<DepthView> depth;
  for (const View& v : views) depth.push_back(v.depthView());
  Progress silent;
  const SeenSpace seen = carve(truth.frame, depth, CarveSettings(), silent);
  int64_t filled = 0, apart = 0;
  for (auto c = truth.frame.bounds.begin(); c; ++c) {
    if (seen.empty.isValueOn(*c)) {
      EXPECT_TRUE(truth.space.empty.isValueOn(*c) || truth.space.filled.isValueOn(*c));
    }
    if (seen.filled.isValueOn(*c)) ++filled, apart += !truth.space.filled.isValueOn(*c);
  }
  // A hit on a voxel's very face may round to its neighbour.
  EXPECT_GT(filled, 1000);
  EXPECT_LT(double(apart), .02 * double(filled));
}

TEST(RoomTruth, FileHoldsEveryLevelAndTheDistanceToTheMesh) {
  openvdb::initialize();
  const Room room = simpleRoom(6);
  const RoomTruth truth = roomTruth(room, .1f);
  const std::string path =
      (std::filesystem::temp_directory_path() / ("vdbc_truth_" + std::to_string(getpid()) + ".vdb"))
          .string();
  writeTruth(room, truth, path);
  openvdb::io::File file(path);
  file.open();
  const auto count = [&](const char* name) { return file.readGrid(name)->activeVoxelCount(); };
  EXPECT_EQ(count("filled"), truth.space.filled.activeVoxelCount());
  EXPECT_EQ(count("empty"), truth.space.empty.activeVoxelCount());
  EXPECT_EQ(count("nodes_1"), truth.surface_nodes[1].size());
  EXPECT_EQ(count("nodes_2"), truth.surface_nodes[2].size());
  const auto distance = openvdb::gridPtrCast<openvdb::FloatGrid>(file.readGrid("distance"));
  const auto nodes = file.readGrid("nodes_2");
  file.close();
  // The room is boxes: distances have a closed form.
  std::vector<std::pair<Vector3f, Vector3f>> boxes = {{Vector3f::Zero(), kSimpleRoomSize}};
  for (const auto& s : room.solids) boxes.emplace_back(s.min(), s.max());
  int64_t compared = 0;
  for (auto v = distance->cbeginValueOn(); v; ++v) {
    const openvdb::Vec3d w = distance->indexToWorld(v.getCoord());
    const Vector3f p =
        (room.world_from_room.inverse() * Vector3d(w.x(), w.y(), w.z()).cast<float>());
    float nearest = INFINITY;
    for (const auto& [lo, hi] : boxes) {
      const Vector3f outside = (lo - p).cwiseMax(p - hi);
      nearest = std::min(
          nearest, outside.maxCoeff() < 0 ? -outside.maxCoeff() : outside.cwiseMax(0.f).norm());
    }
    // OpenVDB's narrow band is exact next to the surface and propagated beyond: never too small.
    EXPECT_GT(*v, nearest - 2e-3f);
    EXPECT_LT(*v, nearest + (nearest < .1f ? 2e-3f : .1f));
    ++compared;
  }
  EXPECT_GT(compared, 10000);
  // A coarse node's transform puts its centre where its voxels are.
  const Coord c = truth.surface_nodes[2][0];
  const Vector3d expected = truth.frame.toWorld((Vector3d(c.x(), c.y(), c.z()).array() + .5) * 4);
  const openvdb::Vec3d found = nodes->indexToWorld(c);
  EXPECT_LT((Vector3d(found.x(), found.y(), found.z()) - expected).norm(), 1e-5);
  std::filesystem::remove(path);
}

}  // namespace
}  // namespace vdbc
