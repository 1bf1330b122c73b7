// Laws of the generated rooms: what is in them, where it stands, and that they are closed.
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <set>

#include "examples/rooms/floor_plan.h"
#include "examples/rooms/rooms.h"
#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;

constexpr uint64_t kTraining = kFirstTrainingSeed;

const AssetLibrary& assets() {
  static const AssetLibrary library = AssetLibrary::open();
  return library;
}

/// Rooms of these tests, made once: half of them with held-out models.
const std::vector<Room>& rooms() {
  static const std::vector<Room> made = [] {
    std::vector<Room> list;
    for (uint64_t i = 0; i < 20; ++i) {
      list.push_back(makeRoom(assets(), i));
      list.push_back(makeRoom(assets(), kTraining + i));
    }
    return list;
  }();
  return made;
}

class RoomTest : public testing::Test {
 protected:
  void SetUp() override {
    if (!AssetLibrary::isInstalled()) GTEST_SKIP() << "no furniture catalogues here";
  }
};

std::string role(const Piece& piece) {
  return piece.model.empty() ? "" : assets().models()[assets().find(piece.model)].role;
}

bool isFlat(const Piece& piece) { return piece.box.sizes().z() < .02f; }

/// The box of a piece in its own axes: a corner and three edges, room frame.
struct Oriented {
  Vector3f centre;
  std::array<Vector3f, 3> axis;  // unit
  Vector3f half;
};

Oriented oriented(const Piece& piece) {
  Oriented o;
  if (piece.model.empty()) {  // the room's own pieces are boxes, or round
    o = {piece.box.center(),
         {Vector3f::UnitX(), Vector3f::UnitY(), Vector3f::UnitZ()},
         piece.box.sizes() / 2};
    return o;
  }
  Eigen::AlignedBox3f box;
  for (const Vector3f& v : assets().mesh(assets().find(piece.model))->mesh.vertices) box.extend(v);
  o.centre = piece.room_from_model * box.center();
  for (int a = 0; a < 3; ++a) {
    const Vector3f column = piece.room_from_model.linear().col(a);
    o.axis[size_t(a)] = column.normalized();
    o.half[a] = column.norm() * box.sizes()[a] / 2;
  }
  return o;
}

/// How deep two upright boxes are in each other; negative where they are apart.
float penetration(const Oriented& a, const Oriented& b) {
  float least = INFINITY;
  for (const Oriented* o : {&a, &b})
    for (const Vector3f& axis : o->axis) {
      float reach = 0;
      for (int i = 0; i < 3; ++i)
        reach += a.half[i] * std::abs(axis.dot(a.axis[size_t(i)])) +
                 b.half[i] * std::abs(axis.dot(b.axis[size_t(i)]));
      least = std::min(least, reach - std::abs(axis.dot(a.centre - b.centre)));
    }
  return least;
}

TriangleMesh meshOf(const Piece& piece) {
  TriangleMesh mesh = assets().mesh(assets().find(piece.model))->mesh;
  for (Vector3f& v : mesh.vertices) v = piece.room_from_model * v;
  return mesh;
}

/// Whether an edge of one surface goes through the other.
bool cross(const TriangleMesh& edges_of, const RayTarget& surface) {
  std::vector<Vector3f> origins, directions;
  std::vector<float> lengths;
  for (const Eigen::Vector3i& t : edges_of.triangles)
    for (int k = 0; k < 3; ++k) {
      const Vector3f a = edges_of.vertices[size_t(t[k])];
      const Vector3f d = edges_of.vertices[size_t(t[(k + 1) % 3])] - a;
      if (d.norm() < 1e-4f) continue;
      origins.push_back(a), directions.push_back(d.normalized()), lengths.push_back(d.norm());
    }
  const std::vector<float> hits = surface.trace(origins, directions);
  for (size_t i = 0; i < hits.size(); ++i)
    if (hits[i] < lengths[i]) return true;
  return false;
}

std::string where(const Room& room, const Piece& piece) {
  return room.name + " " + room.kind + " " + (piece.model.empty() ? "own piece" : piece.model);
}

TEST_F(RoomTest, SameSeedSameRoom) {
  for (uint64_t seed : {uint64_t(3), kTraining + 3}) {
    const Room a = makeRoom(assets(), seed), b = makeRoom(assets(), seed);
    EXPECT_EQ(a.surface.mesh.vertices, b.surface.mesh.vertices);
    EXPECT_EQ(a.surface.mesh.triangles, b.surface.mesh.triangles);
    EXPECT_EQ(a.surface.material, b.surface.material);
    EXPECT_EQ(a.world_from_room.matrix(), b.world_from_room.matrix());
    ASSERT_EQ(a.lights.size(), b.lights.size());
    for (size_t i = 0; i < a.lights.size(); ++i)
      EXPECT_EQ(a.lights[i].radiance, b.lights[i].radiance);
    ASSERT_EQ(a.surface.materials.size(), b.surface.materials.size());
    for (size_t i = 0; i < a.surface.materials.size(); ++i)
      EXPECT_EQ(a.surface.materials[i].colour_a, b.surface.materials[i].colour_a);
    EXPECT_NE(a.surface.mesh.vertices, makeRoom(assets(), seed + 1).surface.mesh.vertices);
  }
}

TEST_F(RoomTest, ArraysAreParallelAndFinite) {
  for (const Room& room : rooms()) {
    const SurfaceMesh& s = room.surface;
    ASSERT_EQ(s.material.size(), s.mesh.triangles.size());
    ASSERT_EQ(s.uv.size(), s.mesh.triangles.size());
    ASSERT_EQ(s.normal.size(), s.mesh.triangles.size());
    for (const Vector3f& v : s.mesh.vertices) ASSERT_TRUE(v.allFinite());
    for (size_t i = 0; i < s.mesh.triangles.size(); ++i) {
      ASSERT_GE(s.mesh.triangles[i].minCoeff(), 0);
      ASSERT_LT(size_t(s.mesh.triangles[i].maxCoeff()), s.mesh.vertices.size());
      ASSERT_GE(s.material[i], 0);
      ASSERT_LT(size_t(s.material[i]), s.materials.size());
      for (int k = 0; k < 3; ++k) {
        ASSERT_TRUE(s.uv[i][size_t(k)].allFinite());
        const float length = s.normal[i][size_t(k)].norm();
        ASSERT_TRUE(length == 0 || std::abs(length - 1) < 1e-3f) << length;
      }
    }
    for (const Material& m : s.materials) {
      ASSERT_TRUE(m.colour_a.allFinite() && m.colour_a.minCoeff() >= 0);
      if (!m.texture && m.emission == 0) {
        ASSERT_LE(m.colour_a.maxCoeff(), .95f);
      }
    }
  }
}

TEST_F(RoomTest, PiecesAreInTheRoomAndUnderTheCeiling) {
  for (const Room& room : rooms())
    for (const Piece& piece : room.pieces) {
      const Oriented o = oriented(piece);
      for (int corner = 0; corner < 8; ++corner) {
        Vector3f p = o.centre;
        for (int a = 0; a < 3; ++a)
          p +=
              (corner >> a & 1 ? 1.f : -1.f) * std::max(0.f, o.half[a] - .005f) * o.axis[size_t(a)];
        EXPECT_TRUE(isInside(room.floor, p.head<2>())) << where(room, piece);
        EXPECT_GT(p.z(), -.005f) << where(room, piece);
        for (const Vector3f& c : room.ceilings)
          EXPECT_LT(p.z(), c.x() * p.x() + c.y() * p.y() + c.z()) << where(room, piece);
      }
    }
}

// Boxes are apart, but for a chair under a table and things on a piece with a raised back: there
// the triangles themselves must be.
TEST_F(RoomTest, PiecesDoNotInterpenetrate) {
  for (const Room& room : rooms()) {
    std::vector<Oriented> boxes;
    for (const Piece& piece : room.pieces) boxes.push_back(oriented(piece));
    for (size_t i = 0; i < boxes.size(); ++i)
      for (size_t j = i + 1; j < boxes.size(); ++j) {
        const Piece &a = room.pieces[i], &b = room.pieces[j];
        if (isFlat(a) || isFlat(b) || penetration(boxes[i], boxes[j]) <= .02f) continue;
        ASSERT_FALSE(a.model.empty() || b.model.empty())
            << where(room, a) << " and " << where(room, b);
        const TriangleMesh mesh_a = meshOf(a), mesh_b = meshOf(b);
        EXPECT_FALSE(cross(mesh_a, RayTarget::fromMesh(mesh_b)) ||
                     cross(mesh_b, RayTarget::fromMesh(mesh_a)))
            << where(room, a) << " and " << b.model;
      }
  }
}

TEST_F(RoomTest, RoomsAreClosed) {
  for (const Room& room : rooms()) {
    const RayTarget surface = RayTarget::fromMesh(solidMesh(room.surface));
    std::vector<Vector3f> origins, directions;
    std::mt19937_64 random(7);
    for (const Vector3f& p : freePoints(room, 20, 5))
      for (int i = 0; i < 500; ++i) {
        const auto unit = [&] { return float(uniform(random)); };
        const float z = 2 * unit() - 1, phi = 2 * float(M_PI) * unit();
        const float r = std::sqrt(1 - z * z);
        origins.push_back(p), directions.emplace_back(r * std::cos(phi), r * std::sin(phi), z);
      }
    const std::vector<float> hits = surface.trace(origins, directions);
    EXPECT_TRUE(std::all_of(hits.begin(), hits.end(), [](float t) { return std::isfinite(t); }))
        << room.name;
  }
}

TEST_F(RoomTest, ShellIsClosedAndFurnitureIsInPieces) {
  constexpr float kReach =
      .25f;  // of what belongs to a wall, floor or ceiling: curtains, frames, handles
  for (const Room& room : rooms()) {
    ASSERT_EQ(room.is_shell.size(), room.surface.mesh.triangles.size());
    const Eigen::Isometry3f room_from_world = room.world_from_room.inverse();
    for (size_t t = 0; t < room.is_shell.size(); ++t)
      for (int corner = 0; corner < 3; ++corner) {
        const Vector3f p =
            room_from_world *
            room.surface.mesh.vertices[size_t(room.surface.mesh.triangles[t][corner])];
        if (!room.is_shell[t]) {
          ASSERT_TRUE(
              std::any_of(room.pieces.begin(), room.pieces.end(),
                          [&](const Piece& piece) { return piece.box.exteriorDistance(p) < .01f; }))
              << room.name << ": " << p.transpose();
        } else if (isWithin(room, p)) {
          float to_wall = INFINITY;
          for (size_t i = 0, j = room.floor.size() - 1; i < room.floor.size(); j = i++) {
            const Eigen::AlignedBox2f wall(room.floor[i].cwiseMin(room.floor[j]),
                                           room.floor[i].cwiseMax(room.floor[j]));
            to_wall = std::min(to_wall, wall.exteriorDistance(Vector2f(p.head<2>())));
          }
          ASSERT_LT(std::min({to_wall, p.z(), ceilingAt(room.ceilings, p.head<2>()) - p.z()}),
                    kReach)
              << room.name;
        }
      }
    const RayTarget shell = RayTarget::fromMesh(shellMesh(room));
    std::vector<Vector3f> origins, directions;
    for (const Vector3f& p : freePoints(room, 50, 6))
      for (int axis = 0; axis < 3; ++axis)
        for (float side : {-1.f, 1.f})
          origins.push_back(p), directions.push_back(side * Vector3f::Unit(axis));
    const std::vector<float> hits = shell.trace(origins, directions);
    EXPECT_TRUE(std::all_of(hits.begin(), hits.end(), [](float t) { return std::isfinite(t); }))
        << room.name;
  }
}

TEST_F(RoomTest, ModelsKeepToTheirSplit) {
  for (const Room& room : rooms()) {
    const bool is_held_out = std::stoull(room.name.substr(6)) < kTraining;
    for (const Piece& piece : room.pieces) {
      if (piece.model.empty()) continue;
      const ModelInfo& info = assets().models()[assets().find(piece.model)];
      EXPECT_EQ(info.is_held_out, is_held_out) << where(room, piece);
      EXPECT_TRUE(info.fault.empty()) << where(room, piece);
    }
  }
}

TEST_F(RoomTest, ChairsFaceTables) {
  int chairs = 0;
  for (const Room& room : rooms())
    for (const Piece& chair : room.pieces) {
      if (role(chair) != "chair" && role(chair) != "office_chair") continue;
      ++chairs;
      const Oriented o = oriented(chair);
      bool faces = false;
      for (const Piece& table : room.pieces) {
        const std::string what = role(table);
        if (what != "dining_table" && what != "round_table" && what != "desk") continue;
        const Oriented t = oriented(table);
        // From the chair's middle forward, half a metre past its front.
        for (float y = 0; y < o.half.y() + .5f; y += .05f) {
          const Vector3f d = o.centre + y * o.axis[1] - t.centre;
          faces |=
              std::abs(d.dot(t.axis[0])) < t.half.x() && std::abs(d.dot(t.axis[1])) < t.half.y();
        }
      }
      EXPECT_TRUE(faces) << where(room, chair);
    }
  EXPECT_GT(chairs, 30);
}

TEST_F(RoomTest, BedsStandWithTheirHeadsAtAWall) {
  int beds = 0;
  for (const Room& room : rooms())
    for (const Piece& bed : room.pieces) {
      if (role(bed) != "bed" && role(bed) != "single_bed") continue;
      ++beds;
      const Oriented o = oriented(bed);
      const Vector3f behind = o.centre - (o.half.y() + .06f) * o.axis[1];
      EXPECT_FALSE(isInside(room.floor, behind.head<2>())) << where(room, bed);
    }
  EXPECT_GT(beds, 5);
}

// Everyone who can stand somewhere can walk there from the largest free place.
TEST_F(RoomTest, AQuarterOfTheFloorCanBeWalkedOn) {
  constexpr float kCell = .1f, kRadius = .25f;
  for (const Room& room : rooms()) {
    Eigen::AlignedBox2f area;
    for (const Vector2f& p : room.floor) area.extend(p);
    const int nx = int(area.sizes().x() / kCell), ny = int(area.sizes().y() / kCell);
    std::vector<Oriented> boxes;
    for (const Piece& piece : room.pieces) {
      if (isFlat(piece) || piece.box.min().z() > .5f) continue;
      boxes.push_back(oriented(piece));
    }
    const auto centre = [&](int c) {
      return Vector2f(area.min() + kCell * Vector2f(float(c % nx) + .5f, float(c / nx) + .5f));
    };
    const auto isFreeAt = [&](const Vector2f& p) {
      for (int i = 0; i < 16; ++i) {
        const float angle = float(M_PI) * float(i) / 8;
        if (!isInside(room.floor, p + kRadius * Vector2f(std::cos(angle), std::sin(angle))))
          return false;
      }
      return std::none_of(boxes.begin(), boxes.end(), [&](const Oriented& b) {
        const Vector2f d = p - b.centre.head<2>();
        const Vector2f q(std::abs(d.dot(b.axis[0].head<2>())),
                         std::abs(d.dot(b.axis[1].head<2>())));
        return (q - b.half.head<2>()).cwiseMax(0.f).norm() < kRadius;
      });
    };
    int floor = 0;
    std::vector<int> group(size_t(nx * ny), -1);  // -1: blocked, 0: not seen, then by number
    for (int c = 0; c < nx * ny; ++c) {
      floor += isInside(room.floor, centre(c));
      if (isFreeAt(centre(c))) group[size_t(c)] = 0;
    }
    std::vector<int> sizes = {0};
    for (int c = 0; c < nx * ny; ++c) {
      if (group[size_t(c)] != 0) continue;
      std::vector<int> stack = {c};
      group[size_t(c)] = int(sizes.size());
      sizes.push_back(0);
      while (!stack.empty()) {
        const int at = stack.back();
        stack.pop_back();
        ++sizes.back();
        for (int next :
             {at % nx > 0 ? at - 1 : -1, at % nx < nx - 1 ? at + 1 : -1, at - nx, at + nx})
          if (next >= 0 && next < nx * ny && group[size_t(next)] == 0) {
            group[size_t(next)] = group[size_t(c)];
            stack.push_back(next);
          }
      }
    }
    const int largest = int(std::max_element(sizes.begin(), sizes.end()) - sizes.begin());
    int walked = 0;
    for (int c = 0; c < nx * ny; ++c) {
      bool near = false;
      for (int dy = -2; dy <= 2; ++dy)
        for (int dx = -2; dx <= 2; ++dx) {
          const int x = c % nx + dx, y = c / nx + dy;
          near |= dx * dx + dy * dy <= 4 && x >= 0 && y >= 0 && x < nx && y < ny &&
                  group[size_t(y * nx + x)] == largest;
        }
      walked += near;
    }
    EXPECT_GE(float(walked), .25f * float(floor)) << room.name << " " << room.kind;
  }
}

TEST_F(RoomTest, EveryKindAndShapeOccurs) {
  std::set<std::string> kinds;
  int l_shaped = 0, sloped = 0, sunny = 0;
  for (uint64_t seed = kTraining; seed < kTraining + 60; ++seed) {
    const Room room = makeRoom(assets(), seed);
    kinds.insert(room.kind);
    l_shaped += room.floor.size() > 4;
    sloped += room.ceilings.size() > 1;
    sunny += room.sun.irradiance.maxCoeff() > 0;
    EXPECT_FALSE(room.lights.empty()) << room.name;
  }
  EXPECT_EQ(kinds, (std::set<std::string>{"bathroom", "bedroom", "dining", "kitchen", "living",
                                          "office", "study"}));
  EXPECT_GT(l_shaped, 5);
  EXPECT_GT(sloped, 2);
  EXPECT_GT(sunny, 15);
}

// A ray from a lit window towards the sun leaves through its pane, not through a wall.
TEST_F(RoomTest, TheSunComesInThroughAWindow) {
  int sunny = 0;
  for (const Room& room : rooms()) {
    if (room.sun.irradiance.isZero()) continue;
    ++sunny;
    const RayTarget surface = RayTarget::fromMesh(room.surface.mesh);
    bool comes_in = false;
    for (const RoomLight& light : room.lights) {
      if (light.half_u.isZero()) continue;
      const Vector3f outward = -light.half_u.cross(light.half_v).normalized();
      const float distance = surface.trace({light.centre}, {room.sun.towards})[0];
      comes_in |= outward.dot(room.sun.towards) > .2f && distance < .6f;
    }
    EXPECT_TRUE(comes_in) << room.name;
  }
  EXPECT_GT(sunny, 5);
}

TEST_F(RoomTest, CamerasFindAPlace) {
  for (const Room& room : rooms()) {
    const RayTarget solid = RayTarget::fromMesh(solidMesh(room.surface));
    std::mt19937_64 random(1);
    EXPECT_NO_THROW(randomCameras(room, solid, 8, 32, 32, random)) << room.kind;
  }
}

}  // namespace
}  // namespace vdbc
