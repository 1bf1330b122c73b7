// Homes drawn by people, as Sweet Home 3D keeps them: XML in the jar (its examples) or in a .sh3d
// file (a zip). Its plan has y down and angles clockwise, in centimetres; ours is (x, -y) in
// metres.
#include "examples/rooms/home_file.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <pugixml.hpp>
#include <set>

#include "encoder/views/zip_file.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using Eigen::Vector3f;
using Baseboard = Home::Baseboard;
using Level = Home::Level;
using Outline = Home::Outline;
using Side = Home::Side;
using Space = Home::Space;

constexpr char kExamples[] = "com/eteks/sweethome3d/io/resources/examples/";
constexpr uint64_t kMostHomeBytes = 64 << 20;  // the largest example has 0.1 MB
constexpr int kMostGroups = 16;                // of groups in groups

/// For messages: one line, whatever the file holds.
std::string shown(std::string text) {
  for (char& c : text)
    if (static_cast<unsigned char>(c) < 32 || c == 127) c = ' ';
  return text.size() > 60 ? text.substr(0, 57) + "..." : text;
}

float linearOf(unsigned value) {
  const float c = float(value) / 255;
  return c <= .04045f ? c / 12.92f : std::pow((c + .055f) / 1.055f, 2.4f);
}

/// Reads one home. Every number is checked at the door: the geometry below relies on it.
class HomeReader {
 public:
  HomeReader(const AssetLibrary& assets, std::string file, const std::string& name)
      : assets_(assets), file_(std::move(file)) {
    home_.name = name;
    for (size_t i = 0; i < assets.models().size(); ++i) models_[assets.models()[i].id] = i;
    for (size_t i = 0; i < assets.textures().size(); ++i)
      textures_[assets.textures()[i].id] = int(i);
  }

  Home read(const std::string& xml) {
    pugi::xml_document document;
    const auto parsed = document.load_buffer(xml.data(), xml.size());
    require(parsed, "readHome: ", file_, ": expected XML, found ", parsed.description(),
            " at byte ", parsed.offset);
    const pugi::xml_node home = document.child("home");
    require(home, "readHome: ", file_, ": expected an element home, found ",
            shown(document.first_child().name()));
    wall_height_ = number(home, "wallHeight", 250, 1, 10000) / 100;
    for (const pugi::xml_node node : home.children("level")) readLevel(node);
    if (home_.levels.empty()) home_.levels.push_back({"", 0, wall_height_, 0});
    for (const pugi::xml_node node : home.children("wall")) readWall(node);
    for (const pugi::xml_node node : home.children("room")) readSpace(node);
    readItems(home, 0);
    return std::move(home_);
  }

 private:
  double number(pugi::xml_node node, const char* name, std::optional<double> fallback, double least,
                double most) const {
    const pugi::xml_attribute attribute = node.attribute(name);
    if (!attribute && fallback) return *fallback;
    char* end = nullptr;
    const double value = std::strtod(attribute.value(), &end);
    require(attribute && end != attribute.value() && *end == 0 && value >= least && value <= most,
            "readHome: ", file_, ": ", node.name(), " ", name, ": expected a number from ", least,
            " to ", most, ", found '", shown(attribute.value()), "'");
    return value;
  }

  Vector2d point(pugi::xml_node node, const char* x, const char* y) const {
    constexpr double kFar = 1e6;  // 10 km
    return Vector2d(number(node, x, {}, -kFar, kFar), -number(node, y, {}, -kFar, kFar)) / 100;
  }

  double length(pugi::xml_node node, const char* name, std::optional<double> fallback = {}) const {
    if (!node.attribute(name) && fallback) return *fallback;
    return number(node, name, {}, 0, 1e5) / 100;
  }

  double angle(pugi::xml_node node, const char* name) const {
    return number(node, name, 0, -1000, 1000);
  }

  std::optional<Vector3f> colour(pugi::xml_node node, const char* name) const {
    const pugi::xml_attribute attribute = node.attribute(name);
    if (!attribute) return std::nullopt;
    const std::string text = attribute.value();
    require(!text.empty() && text.size() <= 8 &&
                text.find_first_not_of("0123456789abcdefABCDEF") == std::string::npos,
            "readHome: ", file_, ": ", node.name(), " ", name,
            ": expected a colour AARRGGBB, found '", shown(text), "'");
    const unsigned long rgb = std::strtoul(text.c_str(), nullptr, 16);
    return Vector3f(linearOf(rgb >> 16 & 255), linearOf(rgb >> 8 & 255), linearOf(rgb & 255));
  }

  /// The texture child whose attribute is `texture`, or the colour, or the default.
  Home::Finish finish(pugi::xml_node node, const char* colour_name, const char* texture) const {
    Home::Finish result;
    if (const auto c = colour(node, colour_name)) result.colour = *c;
    for (const pugi::xml_node child : node.children("texture")) {
      if (child.attribute("attribute").as_string() != std::string(texture)) continue;
      const auto found = textures_.find(child.attribute("catalogId").value());
      if (found == textures_.end()) continue;  // a picture of the user's own: the plain colour
      result.texture = found->second, result.angle = -angle(child, "angle");
      result.colour = Vector3f::Ones();
    }
    return result;
  }

  int levelOf(pugi::xml_node node) const {
    const pugi::xml_attribute attribute = node.attribute("level");
    if (!attribute) return 0;
    for (size_t i = 0; i < home_.levels.size(); ++i)
      if (home_.levels[i].id == attribute.value()) return int(i);
    throw Error(joinText("readHome: ", file_, ": ", node.name(),
                         ": expected a level of the home, found '", shown(attribute.value()), "'"));
  }

  void readLevel(pugi::xml_node node) {
    home_.levels.push_back({node.attribute("id").value(),
                            number(node, "elevation", {}, -1e5, 1e5) / 100, length(node, "height"),
                            length(node, "floorThickness", 0)});
  }

  Side readSide(pugi::xml_node node, const std::string& name) const {
    Side side;
    side.finish = finish(node, (name + "SideColor").c_str(), (name + "SideTexture").c_str());
    for (const pugi::xml_node child : node.children("baseboard")) {
      if (child.attribute("attribute").value() != name + "SideBaseboard") continue;
      side.baseboard.thickness = length(child, "thickness");
      side.baseboard.height = length(child, "height");
      side.baseboard.finish = child.attribute("color") ? finish(child, "color", "") : side.finish;
    }
    return side;
  }

  void readWall(pugi::xml_node node) {
    Home::Wall wall;
    wall.id = node.attribute("id").value();
    wall.at_start = node.attribute("wallAtStart").value();
    wall.at_end = node.attribute("wallAtEnd").value();
    wall.level = levelOf(node);
    wall.start = point(node, "xStart", "yStart"), wall.end = point(node, "xEnd", "yEnd");
    wall.thickness = length(node, "thickness");
    wall.height = length(node, "height", wall_height_);
    wall.height_at_end = length(node, "heightAtEnd", wall.height);
    wall.arc = -number(node, "arcExtent", 0, -6.2, 6.2);
    wall.left = readSide(node, "left"), wall.right = readSide(node, "right");
    if ((wall.end - wall.start).norm() > 1e-4 && wall.thickness > 1e-4)
      home_.walls.push_back(std::move(wall));
  }

  void readSpace(pugi::xml_node node) {
    Space space;
    space.name = node.attribute("name").value();
    space.level = levelOf(node);
    for (const pugi::xml_node child : node.children("point"))
      space.outline.push_back(point(child, "x", "y"));
    require(space.outline.size() >= 3, "readHome: ", file_, ": room '", shown(space.name),
            "': expected 3 points or more, found ", space.outline.size());
    double area = 0;
    for (size_t i = 0, j = space.outline.size() - 1; i < space.outline.size(); j = i++)
      area +=
          space.outline[j].x() * space.outline[i].y() - space.outline[i].x() * space.outline[j].y();
    if (area < 0) std::reverse(space.outline.begin(), space.outline.end());
    space.floor_visible = node.attribute("floorVisible").as_bool(true);
    space.ceiling_visible = node.attribute("ceilingVisible").as_bool(true);
    space.floor = finish(node, "floorColor", "floorTexture");
    space.ceiling = finish(node, "ceilingColor", "ceilingTexture");
    home_.spaces.push_back(std::move(space));
  }

  /// By catalogue id, or by the model's file name, which is the id's second half in the jar.
  size_t modelOf(pugi::xml_node node) const {
    std::string base = node.attribute("model").value();
    base = base.substr(base.find_last_of('/') + 1);
    base = base.substr(0, base.find_last_of('.'));
    for (const std::string& id :
         {std::string(node.attribute("catalogId").value()), "eTeks#" + base}) {
      const auto found = models_.find(id);
      if (found != models_.end()) return found->second;
    }
    throw Error(joinText("readHome: ", file_, ": '", shown(node.attribute("name").value()),
                         "': expected a model of the catalogues, found '",
                         shown(node.attribute("catalogId").value()), "', '",
                         shown(node.attribute("model").value()), "'"));
  }

  void readItems(pugi::xml_node parent, int depth) {
    require(depth < kMostGroups, "readHome: ", file_, ": expected at most ", kMostGroups,
            " groups in each other, found more");
    for (const pugi::xml_node node : parent.children()) {
      const std::string kind = node.name();
      if (!node.attribute("visible").as_bool(true)) continue;
      if (kind == "furnitureGroup") readItems(node, depth + 1);
      if (kind == "pieceOfFurniture" || kind == "light" || kind == "doorOrWindow") readItem(node);
    }
  }

  void readItem(pugi::xml_node node) {
    Home::Item item;
    item.name = node.attribute("name").value();
    item.model = modelOf(node);
    item.level = levelOf(node);
    item.place = point(node, "x", "y");
    item.elevation = number(node, "elevation", 0, -1e5, 1e5) / 100;
    item.angle = -angle(node, "angle");
    item.pitch = angle(node, "pitch"), item.roll = angle(node, "roll");
    item.size = {length(node, "width"), length(node, "depth"), length(node, "height")};
    item.height_in_plan = length(node, "heightInPlan", item.size.z());
    item.mirrored = node.attribute("modelMirrored").as_bool();
    item.colour = colour(node, "color");
    for (const pugi::xml_node child : node.children("material"))
      if (const auto c = colour(child, "color"))
        item.material_colours[child.attribute("name").value()] = *c;
    item.power = number(node, "power", 0, 0, 1000);
    item.is_opening = node.name() == std::string("doorOrWindow");
    item.cut_shape = node.attribute("cutOutShape").value();
    item.wall_distance = number(node, "wallDistance", 0, 0, 1);
    item.wall_thickness = number(node, "wallThickness", 1, 0, 1);
    home_.items.push_back(std::move(item));
  }

  const AssetLibrary& assets_;
  const std::string file_;
  std::map<std::string, size_t> models_;
  std::map<std::string, int> textures_;
  double wall_height_ = 2.5;
  Home home_;
};

/// Home.xml of a .sh3d file.
std::string homeXml(const std::string& path) {
  const ZipFile zip("readHome", path);
  require(zip.has("Home.xml") || !zip.has("Home"), "readHome: ", path,
          ": expected Home.xml, found only the Java object Home; save it with Sweet Home 3D 5.3 or "
          "newer");
  return zip.read("Home.xml", kMostHomeBytes);
}

}  // namespace

Home exampleHome(const AssetLibrary& assets, const std::string& name) {
  return HomeReader(assets, name, name).read(assets.jarFile(name));
}

std::vector<std::string> exampleHomes(const AssetLibrary& assets) {
  std::vector<std::string> names;
  for (const std::string& name : assets.jarFiles(kExamples))
    if (name.size() > 4 && name.compare(name.size() - 4, 4, ".xml") == 0) names.push_back(name);
  require(!names.empty(), "homeRooms: expected example homes in sweethome3d.jar, found none");
  return names;
}

Home readHomeFile(const AssetLibrary& assets, const std::string& path) {
  return HomeReader(assets, path, path).read(homeXml(path));
}

}  // namespace vdbc
