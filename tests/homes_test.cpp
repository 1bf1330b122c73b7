// Laws of the homes drawn by people: the examples of the jar, and small homes written here.
#include <gtest/gtest.h>
#include <zip.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <random>
#include <set>

#include "examples/rooms/rooms.h"
#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;

constexpr char kExamples[] = "com/eteks/sweethome3d/io/resources/examples/";

class Homes : public testing::Test {
 protected:
  void SetUp() override {
    if (!AssetLibrary::isInstalled()) GTEST_SKIP() << "sweethome3d is not installed";
    if (!library_) library_ = new AssetLibrary(AssetLibrary::open());
    path_ = std::filesystem::temp_directory_path() /
            (std::string("vdbc_") + testing::UnitTest::GetInstance()->current_test_info()->name() +
             ".sh3d");
  }
  void TearDown() override { std::filesystem::remove(path_); }

  const AssetLibrary& assets() const { return *library_; }

  /// Writes a zip with one entry and reads it as a home.
  std::vector<Room> read(const std::string& text, const char* entry = "Home.xml") const {
    std::filesystem::remove(path_);
    zip_t* zip = zip_open(path_.c_str(), ZIP_CREATE, nullptr);
    zip_file_add(zip, entry, zip_source_buffer(zip, text.data(), text.size(), 0), 0);
    EXPECT_EQ(zip_close(zip), 0);
    return readHome(assets(), path_.string());
  }

  void expectError(const std::string& part, const std::function<void()>& f) const {
    try {
      f();
      ADD_FAILURE() << "expected an Error with '" << part << "'";
    } catch (const Error& e) {
      EXPECT_NE(std::string(e.what()).find(part), std::string::npos) << e.what();
      EXPECT_EQ(std::string(e.what()).find('\n'), std::string::npos) << e.what();
    }
  }

  std::filesystem::path path_;

 private:
  static AssetLibrary* library_;
};
AssetLibrary* Homes::library_ = nullptr;

/// A piece; `more` are further attributes.
std::string piece(const std::string& id, double x, double y, const std::string& more = "",
                  const std::string& tag = "pieceOfFurniture") {
  return "<" + tag + " catalogId='eTeks#" + id + "' name='" + id + "' model='x.obj' x='" +
         std::to_string(x) + "' y='" + std::to_string(y) + "' " +
         (more.find("width") == std::string::npos ? "width='40' depth='50' height='90' " : "") +
         more + "/>";
}

/// Walls 0.2 m thick around (0, 0) - (400, 300) of the plan, in from 10 to 390 and 10 to 290, each
/// mitred with the next; two chairs; and `more`.
std::string box(const std::string& more, const std::string& wall_heights = "height='250'",
                bool has_chairs = true) {
  const double corners[4][2] = {{0, 0}, {400, 0}, {400, 300}, {0, 300}};
  std::string xml = "<?xml version='1.0'?><home version='7000' wallHeight='250'>";
  for (int i = 0; i < 4; ++i) {
    const auto &a = corners[i], &b = corners[(i + 1) % 4];
    xml += "<wall id='w" + std::to_string(i) + "' wallAtStart='w" + std::to_string((i + 3) % 4) +
           "' wallAtEnd='w" + std::to_string((i + 1) % 4) + "' xStart='" + std::to_string(a[0]) +
           "' yStart='" + std::to_string(a[1]) + "' xEnd='" + std::to_string(b[0]) + "' yEnd='" +
           std::to_string(b[1]) + "' thickness='20' " + wall_heights + "/>";
  }
  xml +=
      "<room name='Den'><point x='10' y='10'/><point x='390' y='10'/><point x='390' y='290'/>"
      "<point x='10' y='290'/></room>";
  if (has_chairs) xml += piece("chair", 100, 200) + piece("chair", 300, 200, "angle='1.5707963'");
  return xml + more + "</home>";
}

std::string window(double x, double elevation, double width, double height) {
  return piece("fixedWindow85x123", x, 0,
               "elevation='" + std::to_string(elevation) + "' width='" + std::to_string(width) +
                   "' depth='24' height='" + std::to_string(height) + "'",
               "doorOrWindow");
}

/// Rays in all directions from the air of a room that hit nothing.
int leaks(const Room& room, int count) {
  std::vector<Vector3f> origins, directions;
  std::mt19937_64 random(1);
  Eigen::AlignedBox2f area;
  for (const Vector2f& p : room.floor) area.extend(p);
  for (int tries = 0; int(origins.size()) < count && tries < 1000 * count; ++tries) {
    const double x = uniform(random), y = uniform(random), z = uniform(random);
    const Vector2f p = area.min() + area.sizes().cwiseProduct(Vector2f(float(x), float(y)));
    const Vector3f origin(p.x(), p.y(), float(.1 + 2 * z));
    if (!isFree(room, origin, .02f)) continue;
    const double cosine = 2 * uniform(random) - 1, turn = 2 * 3.14159265 * uniform(random);
    const double sine = std::sqrt(1 - cosine * cosine);
    origins.push_back(room.world_from_room * origin);
    directions.emplace_back(float(sine * std::cos(turn)), float(sine * std::sin(turn)),
                            float(cosine));
  }
  EXPECT_EQ(int(origins.size()), count) << room.name;
  int lost = 0;
  for (const float t : RayTarget::fromMesh(room.surface.mesh).trace(origins, directions))
    lost += !std::isfinite(t);
  return lost;
}

TEST_F(Homes, EveryExampleLoadsAndIsClosed) {
  // 62 floors under a ceiling of their own polygon carry two pieces or more, less three that are
  // ceilings only; four more have their ceiling elsewhere: double height, roof.
  ASSERT_EQ(homeRoomCount(assets()), 63);
  std::set<std::string> kinds;
  for (int i = 0; i < 63; ++i) {
    const Room room = homeRoom(assets(), i);
    EXPECT_EQ(room.name, "homes:" + std::to_string(i));
    kinds.insert(room.kind);
    EXPECT_GE(room.pieces.size(), 2u);
    EXPECT_GE(room.lights.size(), 1u);
    EXPECT_EQ(room.surface.mesh.triangles.size(), room.surface.material.size());
    for (const Vector3f& v : room.surface.mesh.vertices) ASSERT_TRUE(v.allFinite());
    float area = 0;
    for (size_t k = 0, j = room.floor.size() - 1; k < room.floor.size(); j = k++)
      area += room.floor[j].x() * room.floor[k].y() - room.floor[k].x() * room.floor[j].y();
    EXPECT_GT(area / 2, 1.5f) << room.name;
    EXPECT_LE(leaks(room, 1000), 1) << room.name << " " << room.kind;
  }
  for (const char* kind : {"bedroom", "living room", "kitchen", "bathroom", "office", "room"})
    EXPECT_TRUE(kinds.count(kind)) << kind;
  expectError("expected an index from 0 to 62, found 63", [&] { homeRoom(assets(), 63); });
  expectError("found -1", [&] { homeRoom(assets(), -1); });
}

TEST_F(Homes, EveryPlacedModelIsInTheCatalogues) {
  int homes = 0, placed = 0;
  for (const std::string& name : assets().jarFiles(kExamples)) {
    if (name.find(".xml") == std::string::npos) continue;
    ++homes;
    const std::string xml = assets().jarFile(name), key = "catalogId='";
    for (size_t at = xml.find(key); at != std::string::npos; at = xml.find(key, at + 1), ++placed) {
      const size_t from = at + key.size();
      EXPECT_NO_THROW(assets().find(xml.substr(from, xml.find('\'', from) - from)));
    }
  }
  EXPECT_EQ(homes, 9);
  EXPECT_EQ(placed, 1081);
}

TEST_F(Homes, ChairsFaceTheirTables) {
  int facing = 0, all = 0;
  for (int i = 0; i < homeRoomCount(assets()); ++i) {
    const Room room = homeRoom(assets(), i);
    for (const Piece& chair : room.pieces) {
      if (chair.model != "eTeks#chair" && chair.model != "eTeks#chair2") continue;
      const Piece* nearest = nullptr;
      for (const Piece& table : room.pieces)
        if (table.model.find("able") != std::string::npos || table.model == "eTeks#desk")
          if (!nearest || table.box.squaredExteriorDistance(chair.box.center()) <
                              nearest->box.squaredExteriorDistance(chair.box.center()))
            nearest = &table;
      if (!nearest || nearest->box.exteriorDistance(chair.box.center()) > .5f ||
          nearest->box.min().z() > .3f)
        continue;
      const Vector3f front = chair.room_from_model.linear() * Vector3f::UnitY();
      const Vector3f closest =
          chair.box.center().cwiseMax(nearest->box.min()).cwiseMin(nearest->box.max());
      Vector3f to = nearest->box.contains(chair.box.center())
                        ? Vector3f(nearest->box.center() - chair.box.center())
                        : Vector3f(closest - chair.box.center());
      to.z() = 0;
      ++all, facing += front.dot(to) > 0;
    }
  }
  EXPECT_GE(all, 15);
  EXPECT_GE(facing, all * 9 / 10) << "of " << all;
}

TEST_F(Homes, AnglesTurnClockwiseInThePlan) {
  const Room room = read(box("")).at(0);
  ASSERT_EQ(room.pieces.size(), 2u);
  // The plan's y is down: a front at angle 0 looks down the plan, at a quarter turn to its left.
  const Eigen::Matrix3f a = room.pieces[0].room_from_model.linear(),
                        b = room.pieces[1].room_from_model.linear();
  EXPECT_LT((a.col(1).normalized() - Vector3f(0, -1, 0)).norm(), 1e-5f);
  EXPECT_LT((a.col(0).normalized() - Vector3f(-1, 0, 0)).norm(), 1e-5f);
  EXPECT_LT((b.col(1).normalized() - Vector3f(-1, 0, 0)).norm(), 1e-5f);
  EXPECT_LT((room.pieces[0].box.sizes() - Vector3f(.4f, .5f, .9f)).norm(), 1e-4f);
  EXPECT_LT((room.pieces[1].box.sizes() - Vector3f(.5f, .4f, .9f)).norm(), 1e-4f);
  EXPECT_LT((room.pieces[1].box.center() - Vector3f(3, -2, .45f)).norm(), 1e-4f);
}

TEST_F(Homes, MirroredAndTiltedPiecesFitTheirBoxes) {
  const double pitch = .4, height = .5 * std::sin(pitch) + .1 * std::cos(pitch);
  const Room room = read(box(piece("texturableBox", 200, 150,
                                   "width='30' depth='50' height='10' pitch='.4' heightInPlan='" +
                                       std::to_string(100 * height) + "' elevation='20'") +
                             piece("chair", 150, 100, "modelMirrored='true'")))
                        .at(0);
  ASSERT_EQ(room.pieces.size(), 4u);
  EXPECT_NEAR(room.pieces[2].box.sizes().z(), height, 1e-4);
  EXPECT_NEAR(room.pieces[2].box.min().z(), .2, 1e-4);
  // Java 3D's rotX(-pitch), of y up and z to the front: the front rises.
  EXPECT_GT((room.pieces[2].room_from_model.linear() * Vector3f::UnitY()).z(), 0);
  EXPECT_LT(room.pieces[3].room_from_model.linear().determinant(), 0);
}

TEST_F(Homes, AWindowIsTheOnlyHoleInItsWall) {
  // 1.2 m wide around x = 2 m, from 0.9 to 1.8 m high.
  const Room room = read(box(window(200, 90, 120, 90))).at(0);
  std::vector<Vector3f> origins, directions;
  for (float x = .2f; x < 3.8f; x += .0317f)
    for (float z = .05f; z < 2.45f; z += .0317f)
      origins.emplace_back(x, -.9f, z), directions.emplace_back(0, 1, 0);
  const std::vector<float> t = RayTarget::fromMesh(room.surface.mesh).trace(origins, directions);
  int inside = 0;
  for (size_t i = 0; i < t.size(); ++i) {
    const float x = std::abs(origins[i].x() - 2) - .6f, z = std::abs(origins[i].z() - 1.35f) - .45f;
    const float off = std::max(x, z);
    if (std::abs(off) < .002f) continue;
    const bool is_wall = std::abs(t[i] - .8f) < 1e-4f;
    EXPECT_EQ(is_wall, off > 0) << origins[i].transpose() << " at " << t[i];
    inside += off < 0;
  }
  EXPECT_GT(inside, 500);
}

TEST_F(Homes, OutsideLightShinesInwardsThroughAWindow) {
  const Room room = read(box(window(200, 90, 120, 90))).at(0);
  ASSERT_EQ(room.lights.size(), 1u);
  const RoomLight& light = room.lights[0];
  const Vector3f inward = light.half_u.cross(light.half_v);
  EXPECT_LT((inward.normalized() - Vector3f(0, -1, 0)).norm(), 1e-5f);
  EXPECT_NEAR(inward.norm(), .6f * .45f, 1e-4f);
  EXPECT_GT(light.centre.y(), .1f);
  // Without it the room has a lamp.
  const Room dark = read(box("")).at(0);
  ASSERT_EQ(dark.lights.size(), 1u);
  EXPECT_GT(dark.lights[0].radius_m, 0);
  EXPECT_TRUE(isFree(dark, dark.lights[0].centre, .1f));
}

TEST_F(Homes, MitredCornersHaveNoGap) {
  for (const std::string& more :
       {std::string(), window(200, 90, 120, 90), window(60, 0, 80, 210)}) {
    const Room room = read(box(more)).at(0);
    EXPECT_EQ(leaks(room, 20000), 0);
  }
  // The outer lines meet in the corner.
  const Room room = read(box("")).at(0);
  EXPECT_TRUE(
      std::any_of(room.surface.mesh.vertices.begin(), room.surface.mesh.vertices.end(),
                  [](const Vector3f& v) { return (v - Vector3f(-.1f, .1f, 0)).norm() < 1e-4f; }));
}

TEST_F(Homes, RoundWallsBulgeToTheLeftOfAPositiveArc) {
  // Half a circle of radius 2 m from (0, 300) to (400, 300) of the plan, above it as one looks.
  const std::string xml =
      "<home wallHeight='250'><wall id='a' wallAtStart='b' wallAtEnd='b' xStart='0' yStart='300' "
      "xEnd='400' yEnd='300' thickness='10' arcExtent='3.1415926'/><wall id='b' wallAtStart='a' "
      "wallAtEnd='a' xStart='400' yStart='300' xEnd='0' yEnd='300' thickness='10'/>"
      "<room><point x='10' y='298'/><point x='390' y='298'/><point x='340' y='165'/><point x='200' "
      "y='106'/><point x='60' y='165'/></room>" +
      piece("chair", 200, 200) + piece("chair", 250, 200) + "</home>";
  const Room room = read(xml).at(0);
  std::vector<Vector3f> origins, directions;
  for (float a = .1f; a < 3.1f; a += .05f)
    origins.emplace_back(2, -2.999f + .1f, 2), directions.emplace_back(std::cos(a), std::sin(a), 0);
  for (size_t i = 0; i < origins.size(); ++i) {
    const float t = RayTarget::fromMesh(room.surface.mesh).trace({origins[i]}, {directions[i]})[0];
    EXPECT_NEAR((origins[i] + t * directions[i] - Vector3f(2, -3, 2)).norm(), 1.95f, .01f);
  }
}

TEST_F(Homes, SlopedWallTopsCarryASlopedCeiling) {
  // The wall along the plan's x rises from 2 m to 3 m; the others follow.
  const char* heights[4] = {"height='200' heightAtEnd='300'", "height='300'",
                            "height='300' heightAtEnd='200'", "height='200'"};
  std::string xml = box("");
  for (const char* h : heights) xml.replace(xml.find("height='250'"), 12, h);
  const Room room = read(xml).at(0);
  ASSERT_EQ(room.ceilings.size(), 1u);
  const Vector3f plane = room.ceilings[0];
  EXPECT_LT((plane - Vector3f(.25f, 0, 2)).norm(), .03f) << plane.transpose();
  EXPECT_EQ(leaks(room, 20000), 0);
}

TEST_F(Homes, ConcaveFloorsAreWhole) {
  std::string xml = box(piece("chair", 50, 50));
  const size_t from = xml.find("<point"), to = xml.find("</room>");
  xml.replace(from, to - from,
              "<point x='10' y='10'/><point x='10' y='290'/><point x='150' y='290'/><point x='150' "
              "y='150'/><point x='390' y='150'/><point x='390' y='10'/><point x='200' y='10'/>");
  const Room room = read(xml).at(0);
  const RayTarget target = RayTarget::fromMesh(room.surface.mesh);
  std::mt19937_64 random(3);
  for (int i = 0; i < 2000; ++i) {
    const double x = .1 + 3.8 * uniform(random), y = -.1 - 2.8 * uniform(random);
    const Vector3f p{float(x), float(y), 2};
    if (!isFree(room, p, .05f)) continue;
    EXPECT_TRUE(y > -1.5 || x < 1.5);
    EXPECT_NEAR(target.trace({p}, {Vector3f::UnitZ()})[0], .5f, 1e-4f);
    EXPECT_LE(target.trace({p}, {-Vector3f::UnitZ()})[0], 2.0001f);
  }
}

TEST_F(Homes, FurnitureOfGroupsIsPlacedAndTheInvisibleIsNot) {
  const Room room =
      read(box("<furnitureGroup name='g' x='1' y='1' width='1' depth='1' height='1'>" +
               piece("chair", 50, 50) + "</furnitureGroup>" +
               piece("chair", 60, 100, "visible='false'")))
          .at(0);
  EXPECT_EQ(room.pieces.size(), 3u);
  EXPECT_TRUE(read(box("", "height='250'", false)).empty()) << "not furnished";
}

TEST_F(Homes, AllButTheFurnitureIsShell) {
  const Room room = read(box(window(200, 90, 120, 90))).at(0);
  ASSERT_EQ(room.pieces.size(), 2u);  // the chairs
  const size_t chair = assets().mesh(assets().find(room.pieces[0].model))->mesh.triangles.size();
  ASSERT_EQ(room.is_shell.size(), room.surface.mesh.triangles.size());
  EXPECT_EQ(std::count(room.is_shell.begin(), room.is_shell.end(), 0), int64_t(2 * chair));
  for (const Eigen::Vector3i& t : shellMesh(room).triangles)
    for (int corner = 0; corner < 3; ++corner)  // stands in no chair
      for (const Piece& piece : room.pieces) {
        const Vector3f p = room.surface.mesh.vertices[size_t(t[corner])];
        EXPECT_GT(piece.box.exteriorDistance(room.world_from_room.inverse() * p), 0);
      }
}

TEST_F(Homes, SameHomeSameRoom) {
  const Room a = homeRoom(assets(), 5), b = homeRoom(assets(), 5);
  EXPECT_EQ(a.surface.mesh.vertices, b.surface.mesh.vertices);
  EXPECT_EQ(a.surface.mesh.triangles, b.surface.mesh.triangles);
  EXPECT_EQ(a.lights.size(), b.lights.size());
}

TEST_F(Homes, HostileFilesAreRefusedInOneLine) {
  const auto refused = [&](const std::string& part, const std::string& xml) {
    expectError(part, [&] { read(xml); });
  };
  expectError("No such file", [&] { readHome(assets(), "/nonexistent/a.sh3d"); });
  std::ofstream(path_) << "not a zip";
  expectError("expected a zip file", [&] { readHome(assets(), path_.string()); });
  expectError("only the Java object Home", [&] { read("x", "Home"); });
  expectError("no entry Home.xml", [&] { read("x", "Other"); });
  refused("expected XML", "");
  refused("expected XML", "<home><wall></home>");
  refused("expected an element home", "<house/>");
  refused("expected a model",
          box("<pieceOfFurniture name='a\nb' x='1' y='1' width='1' depth='1' height='1'/>"));
  refused("chair", box(piece("chairs", 1, 1)));
  for (const char* bad : {"nan", "1e30", "", "12px", "inf", "-5"})
    refused("width: expected a number",
            box(piece("chair", 1, 1, "width='" + std::string(bad) + "' depth='1' height='1'")));
  refused("expected a level", box(piece("chair", 1, 1, "level='9'")));
  refused("3 points or more", box("<room><point x='1' y='1'/></room>"));
  refused("expected a colour", box(piece("chair", 1, 1, "color='red'")));
  std::string deep;
  for (int i = 0; i < 40; ++i) deep += "<furnitureGroup>";
  for (int i = 0; i < 40; ++i) deep += "</furnitureGroup>";
  refused("groups in each other", box(deep));
  const std::string whole = box(window(200, 90, 120, 90));
  for (size_t n = 0; n < whole.size(); n += 37) refused("readHome", whole.substr(0, n));
}

TEST_F(Homes, DegenerateGeometryIsHarmless) {
  EXPECT_NO_THROW(
      read(box("<wall id='z' xStart='5' yStart='5' xEnd='5' yEnd='5' thickness='20' height='0'/>"
               "<room><point x='1' y='1'/><point x='1' y='1'/><point x='1' y='1'/></room>"
               "<room><point x='0' y='0'/><point x='100' y='100'/><point x='100' y='0'/>"
               "<point x='0' y='100'/></room>" +
               piece("chair", 1, 1, "width='0' depth='0' height='0'") + window(0, 240, 500, 100))));
}

}  // namespace
}  // namespace vdbc
