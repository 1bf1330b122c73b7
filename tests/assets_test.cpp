// Catalogues: small hostile ones made here, and the installed ones where there are any.
#include "examples/rooms/assets.h"

#include <gtest/gtest.h>
#include <unistd.h>
#include <zip.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <set>
#include <sstream>
#include <thread>

#include "splat/image.h"
#include "splat/image_files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Eigen::Vector3f;
using Files = std::map<std::string, std::string>;

/// A folder that goes with the test.
struct Folder {
  fs::path path;
  Folder() {
    const std::string name = ::testing::UnitTest::GetInstance()->current_test_info()->name();
    path = fs::path(::testing::TempDir()) / ("vdbc_assets_" + name + std::to_string(getpid()));
    fs::create_directories(path);
  }
  ~Folder() { fs::remove_all(path); }
};

void writeZip(const fs::path& path, const Files& files) {
  int code = 0;
  zip_t* zip = zip_open(path.c_str(), ZIP_CREATE | ZIP_TRUNCATE, &code);
  ASSERT_NE(zip, nullptr);
  for (const auto& [name, bytes] : files) {
    zip_source_t* source = zip_source_buffer(zip, bytes.data(), bytes.size(), 0);
    ASSERT_GE(zip_file_add(zip, name.c_str(), source, ZIP_FL_OVERWRITE), 0);
  }
  ASSERT_EQ(zip_close(zip), 0);
}

constexpr const char* kPropertiesName = "PluginFurnitureCatalog.properties";

/// One model of 1 x 2 x 3 m.
std::string properties(const std::string& more = "") {
  return "id=test\nlicense=CC0\nid#1=t#a\nname#1=A\nmodel#1=/m/a.obj\nwidth#1=100\ndepth#1=200\n"
         "height#1=300\n" +
         more;
}

/// A pyramid whose sides tell the axes apart: right 1 (x), up 2 (y), front 3 (z).
const char* const kArrow =
    "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";

AssetLibrary openWith(const Folder& folder, Files files) {
  if (!files.count(kPropertiesName)) files[kPropertiesName] = properties();
  writeZip(folder.path / "test.sh3f", files);
  return AssetLibrary::open({folder.path.string()});
}

std::string failure(const Folder& folder, const Files& files, bool read_mesh = true) {
  try {
    const AssetLibrary assets = openWith(folder, files);
    if (read_mesh) assets.mesh(0);
  } catch (const Error& error) {
    return error.what();
  }
  return "";
}

Eigen::AlignedBox3f boxOf(const SurfaceMesh& surface) {
  Eigen::AlignedBox3f box;
  for (const Vector3f& v : surface.mesh.vertices) box.extend(v);
  return box;
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

/// Bytes of a 2 x 2 PNG.
std::string smallPng(const Folder& folder) {
  const std::string path = (folder.path / "small.png").string();
  Image image(2, 2, 3, 1.f);
  image.at(0, 0, 1) = image.at(0, 0, 2) = 0;  // top left red
  writePng(image, path);
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

const char* const kTexturedTriangle =
    "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n";

TEST(Assets, PropertiesHaveEscapesContinuationsAndLatin1) {
  const Folder folder;
  const AssetLibrary assets = openWith(
      folder,
      {{kPropertiesName,
        "# comment \\\n! another\r\nlicense : \xA9 me\r\nid#7=t#b\nname#7 = Caf\\u00e9 "
        "\\ud83d\\ude00 \\\n"
        "   and\\ttea\ncategory#7:Living\\ room\nmodel#7=/m/a.obj\nwidth#7=1e2\n depth#7 200\n"
        "height#7=300\nelevation#7=50.5\ndropOnTopElevation#7=-1\ndoorOrWindow#7=true\n"
        "creator#7=\\u0041nn\nlast=\\"},
       {"m/a.obj", kArrow}});
  const ModelInfo& model = assets.models().at(0);
  EXPECT_EQ(model.name, "Caf\xC3\xA9 \xF0\x9F\x98\x80 and\ttea");
  EXPECT_EQ(model.licence, "\xC2\xA9 me");
  EXPECT_EQ(model.category, "Living room");
  EXPECT_EQ(model.creator, "Ann");
  EXPECT_EQ(model.catalogue, "test");
  EXPECT_EQ(model.role, "none");
  EXPECT_TRUE(model.is_door_or_window);
  EXPECT_TRUE(model.size_m.isApprox(Vector3f(1, 2, 3)));
  EXPECT_FLOAT_EQ(model.elevation_m, .505f);
  EXPECT_LT(model.top_m, 0);
}

TEST(Assets, BadPropertiesThrow) {
  const Folder folder;
  const std::vector<std::pair<std::string, std::string>> cases = {
      {"width#1=-5\n", "positive"},
      {"width#1=nan\n", "number"},
      {"width#1=1e300\n", "up to"},
      {"width#1=12 13\n", "one number"},
      {"width#1=12cm\n", "12cm"},
      {"width#1=\n", "one number"},
      {"name#1=\\u12\n", "\\u"},
      {"name#1=\n", "name#1"},
      {"modelRotation#1=1 0 0\n", "9 numbers"},
      {"modelRotation#1=2 0 0 0 1 0 0 0 1\n", "rotation"},
      {"modelRotation#1=-1 0 0 0 1 0 0 0 1\n", "rotation"},
      {"lightSourceColor#1=#12\n", "#RRGGBB"},
      {"lightSourceColor#1=#ffffff\n", "a light"},
      {"id#2=t#a\nname#2=B\nmodel#2=/m/a.obj\nwidth#2=1\ndepth#2=1\nheight#2=1\n", "each id once"},
  };
  for (const auto& [line, part] : cases) {
    const std::string what = failure(folder, {{kPropertiesName, properties(line)}}, false);
    EXPECT_TRUE(contains(what, part)) << line << " -> " << what;
    EXPECT_EQ(what.find('\n'), std::string::npos);
  }
}

TEST(Assets, LightsLieInTheModelFrame) {
  const Folder folder;
  const AssetLibrary assets = openWith(
      folder, {{kPropertiesName,
                properties("lightSourceX#1=0 75\nlightSourceY#1=0 50\nlightSourceZ#1=10 20\n"
                           "lightSourceColor#1=#FF0000 #ffffff\nlightSourceDiameter#1=6 8\n")}});
  const std::vector<ModelLight>& lights = assets.models()[0].lights;
  ASSERT_EQ(lights.size(), 2u);
  // From the left of the front, for someone who looks at the front: the right of one behind.
  EXPECT_TRUE(lights[0].centre.isApprox(Vector3f(.5f, 1, .1f)));
  EXPECT_TRUE(lights[1].centre.isApprox(Vector3f(-.25f, .5f, .2f)));
  EXPECT_TRUE(lights[0].colour.isApprox(Vector3f(1, 0, 0)));
  EXPECT_FLOAT_EQ(lights[1].diameter_m, .08f);
}

TEST(Assets, ModelFrameHasFrontAtYAndStandsOnTheFloor) {
  const Folder folder;
  const auto mesh = openWith(folder, {{"m/a.obj", kArrow}}).mesh(0);
  const Eigen::AlignedBox3f box = boxOf(*mesh);
  EXPECT_TRUE(box.min().isApprox(Vector3f(-.5f, -1, 0)));
  EXPECT_TRUE(box.max().isApprox(Vector3f(.5f, 1, 3)));
  // OBJ right (+x) is the left of one who stands behind; up stays up, front is +y.
  const std::vector<Vector3f> expected = {{.5f, -1, 0}, {-.5f, -1, 0}, {.5f, -1, 3}, {.5f, 1, 0}};
  for (const Vector3f& corner : expected)
    EXPECT_TRUE(std::any_of(mesh->mesh.vertices.begin(), mesh->mesh.vertices.end(),
                            [&](const Vector3f& v) { return (v - corner).norm() < 1e-6f; }))
        << corner.transpose();
  double volume = 0;  // positive: faces outward
  for (const Eigen::Vector3i& t : mesh->mesh.triangles)
    volume += mesh->mesh.vertices[size_t(t[0])]
                  .cross(mesh->mesh.vertices[size_t(t[1])])
                  .dot(mesh->mesh.vertices[size_t(t[2])]);
  EXPECT_NEAR(volume / 6, 1, 1e-5);
}

TEST(Assets, RotationIsAppliedFirst) {
  const Folder folder;
  // R (x, y, z) = (z, x, y): right becomes up, up becomes front, front becomes right.
  const auto mesh =
      openWith(folder, {{kPropertiesName, properties("modelRotation#1=0 0 1 1 0 0 0 1 0\n")},
                        {"m/a.obj",
                         "v 0 0 0\nv 1 0 0\nv 0 4 0\nv 0 0 1\n"
                         "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"}})
          .mesh(0);
  const std::vector<Vector3f> expected = {{.5f, -1, 0}, {.5f, -1, 3}, {.5f, 1, 0}, {-.5f, -1, 0}};
  for (const Vector3f& corner : expected)
    EXPECT_TRUE(std::any_of(mesh->mesh.vertices.begin(), mesh->mesh.vertices.end(),
                            [&](const Vector3f& v) { return (v - corner).norm() < 1e-6f; }))
        << corner.transpose();
}

TEST(Assets, ConcavePolygonsKeepTheirArea) {
  const Folder folder;
  // A square with a square hole on a bridge, and an arrowhead quad; flat in z.
  const auto mesh =
      openWith(folder, {{"m/a.obj",
                         "v 0 0 0\nv 4 0 0\nv 4 4 0\nv 0 4 0\nv 1 1 0\nv 1 3 0\nv 3 3 0\nv 3 1 0\n"
                         "v 10 0 0\nv 12 1 0\nv 10 2 0\nv 11 1 0\nv 0 0 1\nv 1 0 1\nv 0 1 1\n"
                         "f 1 2 3 4 1 5 6 7 8 5\nf 9 10 11 12\nf 13 14 15\n"}})
          .mesh(0);
  const Vector3f scale(1 / 12.f, 3 / 4.f, 2.f);  // OBJ x and y to metres
  double area = 0;
  for (size_t i = 0; i + 1 < mesh->mesh.triangles.size(); ++i) {
    const Eigen::Vector3i& t = mesh->mesh.triangles[i];
    const Vector3f a = mesh->mesh.vertices[size_t(t[0])], b = mesh->mesh.vertices[size_t(t[1])],
                   c = mesh->mesh.vertices[size_t(t[2])];
    const Vector3f n = (b - a).cross(c - a);
    EXPECT_GT(n.y(), 0);  // all face the front, as the polygons do
    area += double(n.norm()) / 2;
  }
  EXPECT_NEAR(area, (16 - 4 + 1) * double(scale.x() * scale.y()), 1e-5);
}

TEST(Assets, DegenerateFacesAreDropped) {
  const Folder folder;
  const AssetLibrary assets =
      openWith(folder, {{"m/a.obj", std::string(kArrow) + "f 1 2\nf 1 1 2\nf 2 3\nf -4 -3 -3\n"}});
  std::string note;
  EXPECT_EQ(modelFault(assets, 0, &note), "");
  EXPECT_EQ(assets.mesh(0)->mesh.triangles.size(), 4u);
  EXPECT_TRUE(contains(note, "2 faces of two corners dropped")) << note;
  EXPECT_TRUE(contains(note, "2 degenerate triangles dropped")) << note;
}

TEST(Assets, HostileModelsThrow) {
  const Folder folder;
  const std::vector<std::pair<std::string, std::string>> cases = {
      {"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 9\n", "index out of range"},
      {"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 -4\n", "index out of range"},
      {"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1/7 2/1 3/1\n", "index out of range"},
      {"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1//1 2//2 3//3\n", "index out of range"},
      {"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 2000000000\n", "index out of range"},
      {"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangles"},
      {"", "no triangles"},
      {std::string(100000, 'f'), "no triangles"},
      {std::string("\0\1\2v\0f", 6), "no triangles"},
      {"v 0 0 0\nv 1e999 0 0\nv 0 1 1\nf 1 2 3\n", "finite"},
  };
  for (const auto& [obj, part] : cases) {
    const std::string what = failure(folder, {{"m/a.obj", obj}});
    EXPECT_TRUE(contains(what, part)) << obj.substr(0, 80) << " -> " << what;
    EXPECT_TRUE(contains(what, "test.sh3f") && contains(what, "m/a.obj")) << what;
  }
  std::string polygon = "v 0 0 0\nv 1 0 0\nv 0 1 1\nf";
  for (int i = 0; i < 5000; ++i) polygon += " 1 2 3";
  EXPECT_TRUE(contains(failure(folder, {{"m/a.obj", polygon}}), "corners"));
  EXPECT_TRUE(contains(failure(folder, {}), "no entry m/a.obj"));
}

TEST(Assets, EveryTruncationOfAModelIsReadOrThrows) {
  const Folder folder;
  const std::string obj =
      "mtllib a.mtl\nusemtl m\nvt 0 0\nvn 0 0 1\n" + std::string(kArrow) + "f 1/1/1 2/1/1 3/1/1\n";
  for (size_t n = 0; n <= obj.size(); n += 3) failure(folder, {{"m/a.obj", obj.substr(0, n)}});
}

TEST(Assets, TexturesAreFoundByBaseNameAndShared) {
  const Folder folder;
  const std::string png = smallPng(folder);
  const AssetLibrary assets = openWith(
      folder, {{"m/a.obj", kTexturedTriangle},
               {"m/a.mtl", "newmtl m\nKd .8 .8 .8\nmap_Kd C:\\Users\\Me and You\\Wood.PNG\n"},
               {"m/wood.png", png}});
  const auto mesh = assets.mesh(0);
  ASSERT_EQ(mesh->materials.size(), 1u);
  const auto texture = mesh->materials[0].texture;
  ASSERT_NE(texture, nullptr);
  EXPECT_EQ(texture->width, 2);
  EXPECT_FALSE(texture->has_alpha);
  EXPECT_EQ(std::vector<uint8_t>(texture->rgba.begin(), texture->rgba.begin() + 4),
            (std::vector<uint8_t>{255, 0, 0, 255}));
  EXPECT_EQ(assets.mesh(0), mesh);
  EXPECT_TRUE(mesh->uv[0][1].isApprox(Eigen::Vector2f(1, 0)));
}

TEST(Assets, MissingTextureFallsBackWithANote) {
  const Folder folder;
  const AssetLibrary assets =
      openWith(folder, {{"m/a.obj", kTexturedTriangle},
                        {"m/a.mtl",
                         "newmtl m\nKd 1 0 0\nd .5\nKs 1 1 1\nNs 98\nillum 2\n"
                         "map_Kd /home/me/gone.jpg\n"}});
  std::string note;
  EXPECT_EQ(modelFault(assets, 0, &note), "");
  EXPECT_TRUE(contains(note, "gone.jpg missing")) << note;
  const Material& material = assets.mesh(0)->materials[0];
  EXPECT_EQ(material.texture, nullptr);
  EXPECT_TRUE(material.colour_a.isApprox(Vector3f(.85f, 0, 0)));
  EXPECT_LT(material.opacity, kSolidOpacity);  // glass of .5 is glass
  EXPECT_NEAR(material.roughness, std::sqrt(.02f), 1e-5f);
  EXPECT_NEAR(material.specular, .25f, 1e-5f);
}

TEST(Assets, TextureWithoutCoordinatesBecomesItsMeanColour) {
  const Folder folder;
  const AssetLibrary assets =
      openWith(folder, {{"m/a.obj", "mtllib a.mtl\nusemtl m\n" + std::string(kArrow)},
                        {"m/a.mtl", "newmtl m\nmap_Kd wood.png\n"},
                        {"m/wood.png", smallPng(folder)}});
  std::string note;
  EXPECT_EQ(modelFault(assets, 0, &note), "");
  EXPECT_TRUE(contains(note, "without coordinates")) << note;
  EXPECT_TRUE(assets.mesh(0)->materials[0].colour_a.isApprox(Vector3f(.85f, .75f, .75f), 1e-3f));
}

TEST(Assets, CorruptTexturesThrow) {
  const Folder folder;
  const std::string png = smallPng(folder);
  std::string huge = png;  // IHDR says 2^31 - 1 pixels a side
  for (size_t i : {16, 20}) huge.replace(i, 4, "\x7f\xff\xff\xff");
  for (const std::string& bytes : {std::string(), std::string("GIF89a"), png.substr(0, 40), huge,
                                   std::string("\xFF\xD8\xFF\xE0garbage")}) {
    const std::string what = failure(folder, {{"m/a.obj", kTexturedTriangle},
                                              {"m/a.mtl", "newmtl m\nmap_Kd t.png\n"},
                                              {"m/t.png", bytes}});
    EXPECT_TRUE(contains(what, "readTexture") && contains(what, "m/t.png")) << what;
  }
}

TEST(Assets, NamesOfColoursNeedNoFileAndUnknownOnesAreFaults) {
  const Folder folder;
  const AssetLibrary named =
      openWith(folder, {{"m/a.obj", "usemtl flyellow\n" + std::string(kArrow)}});
  EXPECT_EQ(modelFault(named, 0, nullptr), "");
  const Vector3f yellow = named.mesh(0)->materials[0].colour_a;
  EXPECT_GT(yellow.x(), 2 * yellow.z());
  const AssetLibrary unknown =
      openWith(folder, {{"m/a.obj", "usemtl unheard\n" + std::string(kArrow)}});
  EXPECT_EQ(modelFault(unknown, 0, nullptr), "material missing");
  EXPECT_EQ(unknown.mesh(0)->mesh.triangles.size(), 4u);
}

TEST(Assets, PanesAreGlass) {
  const Folder folder;
  const auto mesh = openWith(folder, {{"m/a.obj", "usemtl white\n" + std::string(kArrow) +
                                                      "g sweethome3d_window_pane_1\nf 2 4 3\n"}})
                        .mesh(0);
  EXPECT_EQ(mesh->materials.at(size_t(mesh->material.front())).opacity, 1);
  EXPECT_LT(mesh->materials.at(size_t(mesh->material.back())).opacity, kSolidOpacity);
}

TEST(Assets, RotationThatDoesNotFitTheSizeIsAFault) {
  const Folder folder;  // 4 wide and 1 deep, where the catalogue has 1 x 4
  const AssetLibrary assets = openWith(
      folder, {{kPropertiesName, properties("width#1=100\ndepth#1=400\nheight#1=100\n")},
               {"m/a.obj", "v 0 0 0\nv 4 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\n"}});
  EXPECT_EQ(modelFault(assets, 0, nullptr), "rotation and size do not agree");
}

TEST(Assets, BrokenCataloguesThrow) {
  const Folder folder;
  EXPECT_THROW(AssetLibrary::open({folder.path.string()}), Error);  // nothing there
  EXPECT_THROW(AssetLibrary::open({"/no such folder"}), Error);
  EXPECT_TRUE(contains(failure(folder, {{kPropertiesName, ""}}), "index"));  // no models
  std::ofstream(folder.path / "test.sh3f") << "not a zip";
  EXPECT_THROW(AssetLibrary::open({folder.path.string()}), Error);
  writeZip(folder.path / "test.sh3f", {{"other", "file"}});
  EXPECT_THROW(AssetLibrary::open({folder.path.string()}), Error);
}

TEST(Assets, FlippedBytesOfACatalogueAreReadOrThrow) {
  const Folder folder;
  const fs::path path = folder.path / "test.sh3f";
  std::string text;
  for (int i = 0; i < 50; ++i) text += kArrow;
  writeZip(path, {{kPropertiesName, properties()}, {"m/a.obj", text}});
  std::ifstream in(path, std::ios::binary);
  const std::string whole{std::istreambuf_iterator<char>(in), {}};
  for (size_t i = 0; i < whole.size(); i += 7) {
    std::string bytes = whole;
    bytes[i] = char(bytes[i] ^ 0x55);
    std::ofstream(path, std::ios::binary) << bytes;
    try {
      const AssetLibrary assets = AssetLibrary::open({folder.path.string()});
      if (!assets.models().empty()) assets.mesh(0);
    } catch (const Error&) {
    }
  }
}

// ---- The installed catalogues

class InstalledAssets : public ::testing::Test {
 protected:
  static const AssetLibrary& assets() {
    static const AssetLibrary library = AssetLibrary::open();
    return library;
  }
  void SetUp() override {
    if (!AssetLibrary::isInstalled()) GTEST_SKIP() << "sweethome3d is not installed";
  }
};

TEST_F(InstalledAssets, AreWhatWeKnow) {
  std::map<std::string, int> count;
  for (const ModelInfo& model : assets().models()) ++count[model.catalogue];
  const std::map<std::string, int> expected = {{"BlendSwap-CC-0", 175}, {"BlendSwap-CC-BY", 135},
                                               {"KatorLegaz", 90},      {"Reallusion", 25},
                                               {"Scopia", 395},         {"default", 100}};
  EXPECT_EQ(count, expected);
  EXPECT_EQ(assets().textures().size(), 26u);
  for (size_t i = 0; i < assets().textures().size(); ++i) EXPECT_GT(assets().texture(i)->width, 0);
  EXPECT_EQ(assets().models()[assets().find("Scopia#bathroom3")].name, "Washbasin");
  EXPECT_THROW(assets().find("Scopia#none"), Error);
}

TEST_F(InstalledAssets, TableNamesEachModelAndSplitsTheUsable) {
  std::ifstream in(VDBC_SOURCE_DIR "/examples/rooms/models.tsv");
  std::set<std::string> train, held_out, neither;
  for (std::string line; std::getline(in, line);) {
    if (line[0] == '#') continue;
    std::istringstream cells(line);
    std::string id, split;
    std::getline(cells, id, '\t');
    std::getline(cells, split, '\t');
    auto& set = split == "train" ? train : split == "held-out" ? held_out : neither;
    EXPECT_TRUE(split == "train" || split == "held-out" || split == "-") << line;
    EXPECT_TRUE(set.insert(id).second) << id;
  }
  EXPECT_EQ(train.size() + held_out.size() + neither.size(), assets().models().size());
  for (const ModelInfo& model : assets().models()) {
    const bool is_used = model.fault.empty() && model.role != "none";
    EXPECT_EQ(train.count(model.id) + held_out.count(model.id), is_used ? 1u : 0u) << model.id;
    EXPECT_EQ(neither.count(model.id), is_used ? 0u : 1u) << model.id;
    EXPECT_EQ(model.is_held_out, held_out.count(model.id) > 0) << model.id;
    EXPECT_TRUE(!is_used || model.catalogue != "KatorLegaz" || model.is_held_out) << model.id;
  }
}

TEST_F(InstalledAssets, RolesOfFourHaveBothSides) {
  std::set<std::string> roles;
  for (const ModelInfo& model : assets().models()) roles.insert(model.role);
  roles.erase("none");
  for (const std::string& role : roles) {
    const size_t train = assets().withRole(role, false).size(),
                 held_out = assets().withRole(role, true).size();
    EXPECT_GE(train, 1u) << role;
    EXPECT_GE(held_out, train + held_out >= 4 ? 1u : 0u) << role;
  }
  EXPECT_TRUE(assets().withRole("no such role", false).empty());
}

TEST_F(InstalledAssets, TableIsWhatReadingFinds) {
  std::ifstream in(VDBC_SOURCE_DIR "/examples/rooms/models.tsv");
  const std::string table{std::istreambuf_iterator<char>(in), {}};
  EXPECT_TRUE(modelTable(assets()) == table)
      << "write models.tsv anew with vdb_lab make_rooms table";
}

TEST_F(InstalledAssets, UsableModelsHaveTheirSizeAndFiniteRows) {
  for (size_t i = 0; i < assets().models().size(); ++i) {
    const ModelInfo& model = assets().models()[i];
    if (!model.fault.empty()) continue;
    SCOPED_TRACE(model.id);
    const SurfaceMesh& mesh = *assets().mesh(i);
    const size_t count = mesh.mesh.triangles.size();
    EXPECT_TRUE(mesh.material.size() == count && mesh.uv.size() == count &&
                mesh.normal.size() == count);
    const Eigen::AlignedBox3f box = boxOf(mesh);
    for (int a = 0; a < 3; ++a) {
      const bool is_flat = box.sizes()[a] <= 1e-6f * box.sizes().maxCoeff();
      EXPECT_NEAR(box.sizes()[a], is_flat ? 0 : model.size_m[a],
                  1e-4f * std::max(1.f, model.size_m[a]));
    }
    EXPECT_NEAR(box.min().z(), 0, 1e-4f);
    EXPECT_NEAR(box.center().head<2>().norm(), 0, 1e-3f);
    bool is_finite = true;
    for (const Vector3f& v : mesh.mesh.vertices) is_finite &= v.allFinite();
    for (size_t t = 0; t < count; ++t) {
      for (int k = 0; k < 3; ++k) {
        const Vector3f& n = mesh.normal[t][size_t(k)];
        is_finite &=
            mesh.uv[t][size_t(k)].allFinite() && (n.isZero() || std::abs(n.norm() - 1) < 1e-3f);
        ASSERT_LT(size_t(mesh.mesh.triangles[t][k]), mesh.mesh.vertices.size());
      }
      ASSERT_LT(size_t(mesh.material[t]), mesh.materials.size());
    }
    EXPECT_TRUE(is_finite);
    for (const Material& m : mesh.materials)
      EXPECT_TRUE(m.colour_a.minCoeff() >= 0 && m.colour_a.maxCoeff() <= .85f && m.opacity >= 0 &&
                  m.opacity <= 1);
  }
}

TEST_F(InstalledAssets, SeatsFaceTheFront) {
  int sofas = 0, backs_behind = 0;
  for (const char* role : {"sofa", "chair", "armchair"}) {
    for (bool held_out : {false, true}) {
      for (size_t i : assets().withRole(role, held_out)) {
        const SurfaceMesh& mesh = *assets().mesh(i);
        // What rises above the seat is the back: its middle lies behind the footprint's.
        double area = 0, y = 0;
        for (const Eigen::Vector3i& t : mesh.mesh.triangles) {
          const Vector3f a = mesh.mesh.vertices[size_t(t[0])], b = mesh.mesh.vertices[size_t(t[1])],
                         c = mesh.mesh.vertices[size_t(t[2])], middle = (a + b + c) / 3;
          if (middle.z() < .85f * assets().models()[i].size_m.z()) continue;
          const double share = double((b - a).cross(c - a).norm());
          area += share, y += share * double(middle.y());
        }
        ++sofas, backs_behind += y < 0;
      }
    }
  }
  EXPECT_GT(sofas, 40);
  EXPECT_GE(backs_behind, sofas * 95 / 100);
}

TEST_F(InstalledAssets, ReadsTheSameFromManyThreads) {
  const AssetLibrary fresh = AssetLibrary::open();
  std::vector<std::thread> threads;
  std::vector<std::array<std::shared_ptr<const SurfaceMesh>, 40>> got(4);
  for (auto& mine : got)
    threads.emplace_back([&mine, &fresh] {
      for (size_t i = 0; i < mine.size(); ++i) mine[i] = fresh.mesh(i);
    });
  for (std::thread& thread : threads) thread.join();
  for (const auto& mine : got) EXPECT_EQ(mine, got[0]);
}

TEST_F(InstalledAssets, JarFilesAndAttribution) {
  const std::vector<std::string> homes = assets().jarFiles("com/eteks/sweethome3d/io/resources/");
  EXPECT_GT(homes.size(), 100u);
  EXPECT_TRUE(std::is_sorted(homes.begin(), homes.end()));
  EXPECT_FALSE(assets().jarFile(homes.back()).empty());
  EXPECT_THROW(assets().jarFile("none"), Error);
  const std::string text = attribution(assets());
  for (const ModelInfo& model : assets().models()) {
    const bool is_used = model.fault.empty() && model.role != "none";
    EXPECT_EQ(contains(text, "(" + model.id + ")"), is_used) << model.id;
  }
  for (const TextureInfo& texture : assets().textures()) EXPECT_TRUE(contains(text, texture.id));
}

}  // namespace
}  // namespace vdbc
