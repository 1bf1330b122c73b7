// Laws of the procedural rooms, against closed forms and brute force.
#include "examples/rooms/rooms.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <set>
#include <tuple>

#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Eigen::Vector3f;

/// A closed box [0, size] of one grey material, lit by one lamp: the simplest room with a closed
/// form.
Room emptyBox(const Vector3f& size) {
  Room room;
  for (int i = 0; i < 8; ++i)
    room.mesh.vertices.push_back(
        Vector3f(float(i >> 2 & 1), float(i >> 1 & 1), float(i & 1)).cwiseProduct(size));
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      const int a = 4 >> (axis + 1) % 3, b = 4 >> (axis + 2) % 3, o = side ? 4 >> axis : 0;
      room.mesh.triangles.emplace_back(o, o + a, o + a + b);
      room.mesh.triangles.emplace_back(o, o + a + b, o + b);
      for (int k = 0; k < 2; ++k) {
        room.material.push_back(0);
        room.tangent_u.push_back(Vector3f::Unit((axis + 1) % 3));
        room.tangent_v.push_back(Vector3f::Unit((axis + 2) % 3));
      }
    }
  room.materials.emplace_back();
  room.inside = Eigen::AlignedBox3f(Vector3f::Zero(), size);
  RoomLight lamp;
  lamp.centre = size / 2 + Vector3f(0, 0, .8f);
  lamp.radius_m = .1f, lamp.radiance = Vector3f::Constant(30);
  room.lights.push_back(lamp);
  return room;
}

std::vector<Camera> cameras(const Room& room, int count, int width = 48, int height = 40,
                            uint64_t seed = 1) {
  std::mt19937_64 random(seed);
  return randomCameras(room, count, width, height, random);
}

double mean(const Image& image) {
  double sum = 0;
  for (float v : image.data) sum += v;
  return sum / double(image.data.size());
}

bool sameRoom(const Room& a, const Room& b) {
  return a.mesh.vertices == b.mesh.vertices && a.mesh.triangles == b.mesh.triangles &&
         a.material == b.material && a.world_from_room.matrix() == b.world_from_room.matrix();
}

TEST(Rooms, SeedNamesTheRoom) {
  for (uint64_t seed : {1, 2, 3, 40, 500}) {
    const Room a = makeRoom(seed), b = makeRoom(seed), c = makeRoom(seed + 1);
    EXPECT_TRUE(sameRoom(a, b)) << seed;
    EXPECT_FALSE(sameRoom(a, c)) << seed;
    EXPECT_NE(a.inside.sizes(), c.inside.sizes()) << seed;
  }
}

TEST(Rooms, ArraysAreParallelAndSizesAreThoseOfARoom) {
  for (uint64_t seed = 0; seed < 40; ++seed) {
    const Room room = makeRoom(seed);
    const size_t n = room.mesh.triangles.size();
    ASSERT_EQ(room.material.size(), n);
    ASSERT_EQ(room.tangent_u.size(), n);
    ASSERT_EQ(room.tangent_v.size(), n);
    const Vector3f size = room.inside.sizes();
    EXPECT_EQ(room.inside.min(), Vector3f::Zero());
    EXPECT_TRUE(size.x() >= 3 && size.x() <= 6.5f && size.y() >= 3 && size.y() <= 6.5f);
    EXPECT_TRUE(size.z() >= 2.4f && size.z() <= 3.f);
    const Eigen::Isometry3f room_from_world = room.world_from_room.inverse();
    EXPECT_NEAR((room.world_from_room.linear() * Vector3f::UnitZ()).z(), 1, 1e-6);
    Eigen::AlignedBox3f bounds;
    for (const Vector3f& v : room.mesh.vertices) bounds.extend(room_from_world * v);
    // Recesses of doors and windows reach into the walls, nothing through floor or ceiling.
    EXPECT_GT(bounds.min().z(), -1e-4f);
    EXPECT_LT(bounds.max().z(), size.z() + 1e-4f);
    EXPECT_GT(bounds.min().head<2>().minCoeff(), -.21f);
    EXPECT_LT((bounds.max() - size).head<2>().maxCoeff(), .21f);
    for (size_t i = 0; i < n; ++i) {
      ASSERT_TRUE(room.material[i] >= 0 && size_t(room.material[i]) < room.materials.size());
      const Eigen::Vector3i& t = room.mesh.triangles[i];
      const Vector3f a = room.mesh.vertices[size_t(t[0])], b = room.mesh.vertices[size_t(t[1])];
      const Vector3f normal = (b - a).cross(room.mesh.vertices[size_t(t[2])] - a);
      ASSERT_NEAR(room.tangent_u[i].norm(), 1, 1e-4) << seed << " triangle " << i;
      if (normal.norm() > 1e-6f) {
        ASSERT_LT(std::abs(room.tangent_u[i].cross(room.tangent_v[i]).norm() - 1), 1e-3f);
      }
    }
    for (const Material& m : room.materials)
      if (m.emission == 0) {
        EXPECT_TRUE(m.colour_a.minCoeff() >= 0 && m.colour_a.maxCoeff() < 1);
      }
    EXPECT_FALSE(room.lights.empty());
  }
}

TEST(Rooms, FurnitureStandsInsideAndDoesNotInterpenetrate) {
  int64_t pieces = 0;
  for (uint64_t seed = 0; seed < 120; ++seed) {
    const Room room = makeRoom(seed);
    pieces += int64_t(room.solids.size());
    for (size_t i = 0; i < room.solids.size(); ++i) {
      const auto& a = room.solids[i];
      EXPECT_TRUE((a.sizes().array() > 0).all()) << seed;
      EXPECT_LT(room.inside.exteriorDistance(a.min()) + room.inside.exteriorDistance(a.max()),
                1e-4f)
          << "room " << seed << " solid " << i << ": " << a.min().transpose() << " to "
          << a.max().transpose();
      for (size_t j = 0; j < i; ++j) {
        const Vector3f overlap =
            a.max().cwiseMin(room.solids[j].max()) - a.min().cwiseMax(room.solids[j].min());
        EXPECT_LT(overlap.minCoeff(), 2e-4f)
            << "room " << seed << " solids " << j << " and " << i << ": "
            << room.solids[j].min().transpose() << " to " << room.solids[j].max().transpose()
            << ", " << a.min().transpose() << " to " << a.max().transpose();
      }
    }
  }
  EXPECT_GT(pieces, 120 * 15);  // furnished, on the whole
}

TEST(Rooms, RoomIsClosed) {
  for (uint64_t seed = 0; seed < 12; ++seed) {
    const Room room = makeRoom(seed);
    const RayTarget target = RayTarget::fromMesh(room.mesh);
    const std::vector<Vector3f> origins = freePoints(room, 200, seed);
    EXPECT_EQ(openShare(target, origins, 20000, 7), 0) << seed;
    // What is hit is the room: nothing lies farther off than its diagonal and the recesses.
    EXPECT_EQ(leakRate(target, target, origins, 1000, 1e-3f, 8), 0);
  }
}

TEST(Rooms, FreePointsAreInTheAir) {
  for (uint64_t seed = 0; seed < 8; ++seed) {
    const Room room = makeRoom(seed);
    const std::vector<Vector3f> points = freePoints(room, 300, 3);
    ASSERT_EQ(points.size(), 300u);
    EXPECT_EQ(points, freePoints(room, 300, 3));
    EXPECT_NE(points, freePoints(room, 300, 4));
    const Eigen::Isometry3f room_from_world = room.world_from_room.inverse();
    for (const Vector3f& p : points) {
      const Vector3f q = room_from_world * p;
      EXPECT_TRUE(room.inside.contains(q));
      for (const auto& box : room.solids) EXPECT_FALSE(box.contains(q));
    }
  }
}

TEST(Rooms, CamerasStandInFreeSpaceAtHumanHeightAndSeeSomething) {
  for (uint64_t seed = 0; seed < 12; ++seed) {
    const Room room = makeRoom(seed);
    const Eigen::Isometry3f room_from_world = room.world_from_room.inverse();
    const RoomRenderer renderer(room);
    for (const Camera& c : cameras(room, 4, 40, 30)) {
      const Eigen::Matrix3d r = c.world_from_camera.linear();
      EXPECT_LT((r * r.transpose() - Eigen::Matrix3d::Identity()).norm(), 1e-9);
      EXPECT_GT(r.determinant(), 0);
      const Vector3d eye = c.world_from_camera.translation();
      EXPECT_TRUE(eye.z() >= 1.1 && eye.z() <= 1.9);
      const Vector3f q = room_from_world * eye.cast<float>();
      EXPECT_TRUE(room.inside.contains(q));
      for (const auto& box : room.solids) EXPECT_FALSE(box.contains(q));
      EXPECT_LT(std::abs(std::asin(r(2, 2))), .4);  // looks roughly level,
      EXPECT_LT(r(2, 1), -.85);                     // upright (y is down),
      EXPECT_NEAR(2 * std::atan(c.height / 2. / c.fy), 70 * M_PI / 180, 1e-9);
      const View view = renderer.render(c, 1, 1);
      for (int y = 0; y < c.height; y += 3)
        for (int x = 0; x < c.width; x += 3) {
          const Vector3d p =
              c.unproject(x + .5, y + .5, view.depth[size_t(y) * size_t(c.width) + size_t(x)]);
          EXPECT_GT((p - eye).norm(), .3);  // .4 on the rays that are probed
        }
    }
  }
}

TEST(Rooms, DepthOfAnEmptyBoxIsTheClosedForm) {
  const Vector3f size(4, 3, 2.5f);
  Room room = emptyBox(size);
  const RoomRenderer renderer(room);
  for (const Camera& c : cameras(room, 5, 50, 37)) {
    const View view = renderer.render(c, 1, 1);
    const Vector3d eye = c.world_from_camera.translation();
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        const Vector3d d = c.unproject(x + .5, y + .5, 1) - eye;  // planar: z of 1
        double t = 1e9;
        for (int a = 0; a < 3; ++a)
          t = std::min(t, ((d[a] > 0 ? double(size[a]) : 0.) - eye[a]) / d[a]);
        EXPECT_NEAR(view.depth[size_t(y) * size_t(c.width) + size_t(x)], t, 2e-5 * t);
      }
  }
}

TEST(Rooms, RenderIsDeterministicAndItsNoiseFallsWithSamples) {
  const Room room = makeRoom(11);
  const RoomRenderer renderer(room), again(room);
  const Camera c = cameras(room, 1, 48, 40)[0];
  const View a = renderer.render(c, 4, 5), b = again.render(c, 4, 5),
             other = renderer.render(c, 4, 6);
  EXPECT_EQ(a.colour.data, b.colour.data);
  EXPECT_EQ(a.depth, b.depth);
  EXPECT_NE(a.colour.data, other.colour.data);
  EXPECT_EQ(a.depth, other.depth);  // of the pixel's centre, whatever the jitter
  const View truth = renderer.render(c, 128, 1), one = renderer.render(c, 1, 2);
  const auto error = [&](const View& v) {
    double sum = 0;
    for (size_t i = 0; i < v.colour.data.size(); ++i)
      sum += std::pow(v.colour.data[i] - truth.colour.data[i], 2);
    return std::sqrt(sum / double(v.colour.data.size()));
  };
  EXPECT_LT(error(a), .04);
  EXPECT_LT(error(a), .75 * error(one));
  EXPECT_LT(error(renderer.render(c, 32, 9)), .6 * error(a));
}

TEST(Rooms, ExposureIsInTheMiddle) {
  double sum = 0;
  int count = 0;
  for (uint64_t seed = 100; seed < 112; ++seed) {
    const Room room = makeRoom(seed);
    const RoomRenderer renderer(room);
    double room_mean = 0;
    for (const Camera& c : cameras(room, 4, 32, 32)) {
      const View view = renderer.render(c, 2, 1);
      const auto range = std::minmax_element(view.colour.data.begin(), view.colour.data.end());
      EXPECT_GE(*range.first, 0);
      EXPECT_LE(*range.second, 1);
      room_mean += mean(view.colour) / 4;
    }
    EXPECT_NEAR(room_mean, .5, .25) << seed;  // a view may show little but the window
    sum += room_mean, ++count;
  }
  EXPECT_NEAR(sum / count, .5, .06);
}

TEST(Rooms, LightFallsOffWithItsDistanceAndIsBlocked) {
  // Under the lamp the floor is brighter than in the corners, and a board in between darkens it.
  Room room = emptyBox({4, 4, 2.5f});
  Camera down;
  down.width = down.height = 40, down.fx = down.fy = 20, down.cx = down.cy = 20;
  down.world_from_camera.linear() << 1, 0, 0, 0, -1, 0, 0, 0, -1;
  down.world_from_camera.translation() = Vector3d(2, 2, 1.);
  const View lit = RoomRenderer(room).render(down, 8, 1);
  const float middle = lit.colour.at(20, 20, 1), corner = lit.colour.at(1, 1, 1);
  EXPECT_GT(middle, corner + .02f);
  const int first = int(room.mesh.vertices.size());
  for (float x : {1.7f, 2.3f})
    for (float y : {1.7f, 2.3f}) room.mesh.vertices.emplace_back(x, y, 1.6f);
  for (const Eigen::Vector3i& t : {Eigen::Vector3i(0, 1, 3), Eigen::Vector3i(0, 3, 2)}) {
    room.mesh.triangles.push_back(t.array() + first);
    room.material.push_back(0);
    room.tangent_u.push_back(Vector3f::UnitX()), room.tangent_v.push_back(Vector3f::UnitY());
  }
  const View shaded = RoomRenderer(room).render(down, 8, 1);
  EXPECT_LT(shaded.colour.at(20, 20, 1) / shaded.colour.at(1, 1, 1), .9f * middle / corner);
}

TEST(Rooms, PointsOfOneViewReprojectIntoAnother) {
  const Room room = makeRoom(21);
  const RoomRenderer renderer(room);
  const std::vector<Camera> two = cameras(room, 6, 64, 64, 3);
  int64_t common = 0;
  for (size_t i = 0; i + 1 < two.size(); ++i) {
    const View a = renderer.render(two[i], 1, 1), b = renderer.render(two[i + 1], 1, 1);
    for (int y = 0; y < 64; ++y)
      for (int x = 0; x < 64; ++x) {
        const Vector3d p = a.camera.unproject(x + .5, y + .5, a.depth[size_t(y * 64 + x)]);
        const Vector3d q = b.camera.project(p);
        if (q.z() <= .1 || q.x() < 0 || q.x() >= 64 || q.y() < 0 || q.y() >= 64) continue;
        // Either this point is seen, or something nearer hides it: along b's own ray to it, the
        // first hit is never beyond it.
        const Vector3d eye = b.camera.world_from_camera.translation();
        const float t = renderer.rayTarget().trace({eye.cast<float>()},
                                                   {(p - eye).normalized().cast<float>()})[0];
        EXPECT_LT(t, (p - eye).norm() + 2e-3);
        common += std::abs(t - (p - eye).norm()) < 2e-3;
      }
  }
  EXPECT_GT(common, 500);
}

// --- surfaceNodes
// ---------------------------------------------------------------------------------

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
  const Room room = makeRoom(5);
  const VoxelFrame frame = turnedFrame();
  std::mt19937_64 random(3);
  for (int level = 0; level < kTokenLevels; ++level) {
    const std::vector<Coord> nodes = surfaceNodes(room.mesh, frame, level);
    const NodeSet set = asSet(nodes);
    EXPECT_EQ(set.size(), nodes.size());  // unique
    NodeSet sampled;
    for (const Eigen::Vector3i& t : room.mesh.triangles) {
      const Vector3d a = room.mesh.vertices[size_t(t[0])].cast<double>();
      const Vector3d u = room.mesh.vertices[size_t(t[1])].cast<double>() - a;
      const Vector3d v = room.mesh.vertices[size_t(t[2])].cast<double>() - a;
      const int samples = 2 + int(u.cross(v).norm() * 1500);
      for (int i = 0; i < samples; ++i) {
        double p = double(random() >> 11) * 0x1p-53, q = double(random() >> 11) * 0x1p-53;
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
  const auto real = [&] { return double(random() >> 11) * 0x1p-53 * 2 - 1; };
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
  const Room room = emptyBox({1, 1, .95f});
  VoxelFrame frame;
  int floor_voxels = 0;
  for (const Coord& c : surfaceNodes(room.mesh, frame, 0)) {
    EXPECT_GE(c.z(), 0);
    EXPECT_GE(c.x(), 0);
    floor_voxels += c.z() == 0 && c.x() > 0 && c.x() < 10 && c.y() > 0 && c.y() < 10;
  }
  EXPECT_EQ(floor_voxels, 81);
}

TEST(SurfaceNodes, AreInTreeOrder) {
  const Room room = makeRoom(7);
  const VoxelFrame frame = turnedFrame();
  const TokenGrid grid = TokenGrid::fromCoords(surfaceNodes(room.mesh, frame, 0));
  EXPECT_EQ(surfaceNodes(room.mesh, frame, 0), grid.coords(0));
  // A node is met where one of its children is: levels agree.
  EXPECT_EQ(surfaceNodes(room.mesh, frame, 1), grid.coords(1));
  EXPECT_EQ(surfaceNodes(room.mesh, frame, 2), grid.coords(2));
}

}  // namespace
}  // namespace vdbc
