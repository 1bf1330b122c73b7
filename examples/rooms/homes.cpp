// Homes drawn by people, as Sweet Home 3D keeps them: XML in the jar (its examples) or in a .sh3d
// file (a zip). Its plan has y down and angles clockwise, in centimetres; ours is (x, -y) in
// metres. What the file says is read first, then walls, floors, ceilings and furniture are built
// from it.
#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <cstdlib>
#include <functional>
#include <limits>
#include <map>
#include <optional>
#include <pugixml.hpp>
#include <set>

#include "encoder/views/zip_file.h"
#include "examples/rooms/floor_plan.h"
#include "examples/rooms/rooms.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Affine3d;
using Eigen::Vector2d;
using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;

constexpr double kPi = 3.14159265358979323846;
constexpr char kExamples[] = "com/eteks/sweethome3d/io/resources/examples/";
constexpr uint64_t kMostHomeBytes = 64 << 20;  // the largest example has 0.1 MB
constexpr int kMostGroups = 16;                // of groups in groups

// --- what the file says: metres, world x and y, angles counter-clockwise
// ---------------------------

using Outline = std::vector<Vector2d>;

struct Finish {
  Vector3f colour = Vector3f::Constant(.7f);
  int texture = -1;  // of AssetLibrary::textures()
  double angle = 0;  // of the texture
};

struct Baseboard {
  double thickness = 0, height = 0;
  Finish finish;
};

struct Side {
  Finish finish;
  Baseboard baseboard;
};

struct Wall {
  std::string id, at_start, at_end;  // neighbours' ids
  int level = 0;
  Vector2d start, end;
  double thickness = 0, height = 0, height_at_end = 0;
  double arc = 0;  // counter-clockwise turn from start to end, radians
  Side left, right;
};

struct Space {
  std::string name;
  int level = 0;
  Outline outline;  // counter-clockwise
  bool floor_visible = true, ceiling_visible = true;
  Finish floor, ceiling;
};

/// A piece of furniture, a lamp, a door or a window.
struct Item {
  std::string name;
  size_t model = 0;  // of AssetLibrary::models()
  int level = 0;
  Vector2d place;
  double elevation = 0, angle = 0, pitch = 0, roll = 0;
  Vector3d size;  // width, depth, height of the unturned model
  double height_in_plan = 0;
  bool mirrored = false;
  std::optional<Vector3f> colour;
  std::map<std::string, Vector3f> material_colours;
  double power = 0;  // of a lamp
  bool is_opening = false;
  std::string cut_shape;                         // SVG path in a unit square, y down
  double wall_distance = 0, wall_thickness = 1;  // shares of the depth, from the back
};

struct Level {
  std::string id;
  double elevation = 0, height = 0, floor_thickness = 0;
};

struct Home {
  std::string name;
  std::vector<Level> levels;
  std::vector<Wall> walls;
  std::vector<Space> spaces;
  std::vector<Item> items;
};

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
  Finish finish(pugi::xml_node node, const char* colour_name, const char* texture) const {
    Finish result;
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
    Wall wall;
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
    Item item;
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

// --- plane geometry
// ---------------------------------------------------------------------------------

double cross(const Vector2d& a, const Vector2d& b) { return a.x() * b.y() - a.y() * b.x(); }
Vector2d leftOf(const Vector2d& d) { return {-d.y(), d.x()}; }

bool triangleContains(const Vector2d& a, const Vector2d& b, const Vector2d& c, const Vector2d& p) {
  return cross(b - a, p - a) >= 0 && cross(c - b, p - b) >= 0 && cross(a - c, p - c) >= 0;
}

/// Ear clipping of a counter-clockwise outline (Meisters 1975); of a crossing one what can be cut.
std::vector<std::array<Vector2d, 3>> triangulated(const Outline& outline) {
  std::vector<Vector2d> rest;
  for (const Vector2d& p : outline)
    if (rest.empty() || (p - rest.back()).norm() > 1e-6) rest.push_back(p);
  std::vector<std::array<Vector2d, 3>> triangles;
  for (size_t i = 0, skipped = 0; rest.size() >= 3 && skipped <= rest.size();) {
    const size_t n = rest.size(), before = (i + n - 1) % n, after = (i + 1) % n;
    const Vector2d a = rest[before], b = rest[i % n], c = rest[after];
    const double turn = cross(b - a, c - b);
    const bool is_flat = std::abs(turn) < 1e-12;
    const bool is_ear = turn > 0 && std::none_of(rest.begin(), rest.end(), [&](const Vector2d& p) {
                          return p != a && p != b && p != c && triangleContains(a, b, c, p);
                        });
    if (is_flat || is_ear) {
      if (is_ear) triangles.push_back({a, b, c});
      rest.erase(rest.begin() + std::ptrdiff_t(i % n));
      skipped = 0;
      i = rest.empty() ? 0 : before % rest.size();
    } else {
      ++skipped, i = after;
    }
  }
  return triangles;
}

/// The part of a convex polygon where f >= 0; f is linear.
Outline clipped(const Outline& polygon, const std::function<double(const Vector2d&)>& f) {
  Outline kept;
  for (size_t i = 0, j = polygon.size() - 1; i < polygon.size(); j = i++) {
    const double a = f(polygon[j]), b = f(polygon[i]);
    if ((a >= 0) != (b >= 0)) kept.push_back(polygon[j] + a / (a - b) * (polygon[i] - polygon[j]));
    if (b >= 0) kept.push_back(polygon[i]);
  }
  return kept;
}

// --- faces
// --------------------------------------------------------------------------------------------

Vector3d lifted(const Vector2d& p, double z) { return {p.x(), p.y(), z}; }

class FaceBuilder {
 public:
  explicit FaceBuilder(const AssetLibrary& assets) : assets_(assets) {}

  /// Convex polygon whose front looks along `outward`; texture laid out in the world's metres.
  void add(const std::vector<Vector3d>& corners, const Vector3d& outward, const Finish& finish) {
    Vector3d normal = Vector3d::Zero();
    for (size_t i = 1; i + 1 < corners.size(); ++i)
      normal += (corners[i] - corners[0]).cross(corners[i + 1] - corners[0]);
    if (normal.norm() < 1e-10) return;
    const bool flips = normal.dot(outward) < 0;
    const Vector3d u = std::abs(normal.normalized().z()) > .8
                           ? Vector3d(std::cos(finish.angle), std::sin(finish.angle), 0)
                           : Vector3d::UnitZ().cross(flips ? -normal : normal).normalized();
    const Vector3d v =
        std::abs(normal.normalized().z()) > .8 ? Vector3d::UnitZ().cross(u) : Vector3d::UnitZ();
    const int32_t first = int32_t(surface.mesh.vertices.size());
    for (const Vector3d& c : corners) surface.mesh.vertices.push_back(c.cast<float>());
    const int32_t material = materialOf(finish);
    const Vector2d scale =
        finish.texture < 0
            ? Vector2d::Ones()
            : Vector2d(
                  assets_.textures()[size_t(finish.texture)].size_m.cast<double>().cwiseInverse());
    const auto uv = [&](size_t i) -> Vector2f {
      return Vector2d(u.dot(corners[i]), v.dot(corners[i])).cwiseProduct(scale).cast<float>();
    };
    for (size_t i = 1; i + 1 < corners.size(); ++i) {
      const size_t b = flips ? i + 1 : i, c = flips ? i : i + 1;
      surface.mesh.triangles.emplace_back(first, first + int32_t(b), first + int32_t(c));
      surface.uv.push_back({uv(0), uv(b), uv(c)});
      surface.normal.push_back({Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()});
      surface.material.push_back(material);
    }
  }

  /// Something that shines.
  void addPane(const std::vector<Vector3d>& corners, const Vector3d& outward) {
    const size_t before = surface.mesh.triangles.size();
    add(corners, outward, Finish());
    Material sky;
    sky.colour_a = {.72f, .86f, 1.f}, sky.emission = 2;
    surface.materials.push_back(sky);
    for (size_t i = before; i < surface.material.size(); ++i)
      surface.material[i] = int32_t(surface.materials.size()) - 1;
  }

  SurfaceMesh surface;

 private:
  int32_t materialOf(const Finish& finish) {
    const std::array<float, 4> key{finish.colour.x(), finish.colour.y(), finish.colour.z(),
                                   float(finish.texture)};
    const auto [at, is_new] = materials_.try_emplace(key, int32_t(surface.materials.size()));
    if (is_new) {
      Material material;
      material.colour_a = finish.colour;
      if (finish.texture >= 0) material.texture = assets_.texture(size_t(finish.texture));
      surface.materials.push_back(material);
    }
    return at->second;
  }

  const AssetLibrary& assets_;
  std::map<std::array<float, 4>, int32_t> materials_;
};

// --- openings
// -----------------------------------------------------------------------------------------

/// A hole through a wall: a shape in the plane of (x along the axis, height), pushed through.
struct Hole {
  struct Cut {
    double x, low, high;  // metres from the middle of the opening; world z
  };
  std::vector<Cut> cuts;  // ascending x: piecewise linear
  Vector2d centre, axis;

  double x(const Vector2d& p) const { return axis.dot(p - centre); }
};

/// Upper and lower edge of an SVG path with the commands M, v, h, a and z, which is all that the
/// catalogues use, at `x`; the shapes have no overhangs.
std::optional<std::pair<double, double>> shapeSpan(const std::string& path, double x) {
  std::vector<Vector2d> points;
  std::vector<double> numbers;
  char command = 0;
  Vector2d at(0, 0);
  const auto apply = [&]() {
    if (command == 'M' && numbers.size() == 2) points.push_back(at = {numbers[0], numbers[1]});
    if (command == 'v' && numbers.size() == 1) points.push_back(at += Vector2d(0, numbers[0]));
    if (command == 'h' && numbers.size() == 1) points.push_back(at += Vector2d(numbers[0], 0));
    if (command == 'a' && numbers.size() == 7) {
      // Half an ellipse whose horizontal axis is the chord: all arcs of the catalogues are.
      const double width = numbers[5], height = numbers[1];
      const double side = (numbers[4] > 0) == (width > 0) ? -1 : 1;
      const Vector2d middle = at + Vector2d(width / 2, numbers[6] / 2);
      for (int i = 1; i <= 24; ++i) {
        const double a = kPi * i / 24;
        points.push_back(middle + Vector2d(-width / 2 * std::cos(a), side * height * std::sin(a)));
      }
      at += Vector2d(numbers[5], numbers[6]);
    }
    numbers.clear();
  };
  for (const char* c = path.c_str(); *c != 0;) {
    if (std::isalpha(static_cast<unsigned char>(*c))) {
      apply();
      command = *c++;
      continue;
    }
    char* end = nullptr;
    const double value = std::strtod(c, &end);
    if (end == c)
      ++c;
    else
      numbers.push_back(value), c = end;
  }
  apply();
  double low = std::numeric_limits<double>::infinity(), high = -low;
  for (size_t i = 0; i < points.size(); ++i) {
    const Vector2d &a = points[i], &b = points[(i + 1) % points.size()];
    if (std::min(a.x(), b.x()) > x || std::max(a.x(), b.x()) < x) continue;
    const double t = std::abs(b.x() - a.x()) < 1e-9 ? 0 : (x - a.x()) / (b.x() - a.x());
    const double y = a.y() + t * (b.y() - a.y());
    low = std::min(low, y), high = std::max(high, y);
  }
  if (!(high > low)) return std::nullopt;
  return std::pair(std::clamp(low, 0., 1.), std::clamp(high, 0., 1.));
}

Hole holeOf(const Item& item, double level_elevation) {
  Hole hole;
  hole.centre = item.place, hole.axis = {std::cos(item.angle), std::sin(item.angle)};
  const bool is_round = item.cut_shape.find('a') != std::string::npos;
  const double bottom = level_elevation + item.elevation, height = item.size.z();
  const int steps = is_round ? 24 : 1;
  for (int i = 0; i <= steps; ++i) {
    // Cosine spacing: fine where an arch is steep.
    const double x = is_round ? .5 - .5 * std::cos(kPi * i / steps) : i;
    const auto span =
        is_round ? shapeSpan(item.cut_shape, std::clamp(x, 1e-7, 1 - 1e-7)) : std::nullopt;
    hole.cuts.push_back({(x - .5) * item.size.x(), bottom + height * (span ? 1 - span->second : 0),
                         bottom + height * (span ? 1 - span->first : 1)});
  }
  return hole;
}

// --- walls
// --------------------------------------------------------------------------------------------

/// A straight stretch of wall with upright sides: corners at its start and end, heights there.
struct Stretch {
  Vector2d left[2], right[2];
  double floor = 0;  // of its level
  double base = 0;   // of the wall, which goes through the floor
  double top[2] = {0, 0};
  bool has_cap[2] = {true, true};
  const Wall* wall = nullptr;
  std::vector<Hole> holes;

  Vector2d middle(int end) const { return (left[end] + right[end]) / 2; }
  Vector2d direction() const { return (middle(1) - middle(0)).normalized(); }
  /// Height of the top; beyond the ends, where mitred corners are, it goes on as it slopes.
  double topAt(const Vector2d& p) const {
    const Vector2d along = middle(1) - middle(0);
    const double share = (p - middle(0)).dot(along) / along.squaredNorm();
    return std::max(base, top[0] + (top[1] - top[0]) * share);
  }
};

/// Centre line and side lines of a wall before joining. Round walls are cut into short chords.
struct WallLines {
  std::vector<Vector2d> left, right;
};

WallLines unjoined(const Wall& wall) {
  WallLines lines;
  const Vector2d chord = wall.end - wall.start, d = chord.normalized();
  const double half = wall.thickness / 2;
  if (std::abs(wall.arc) < 1e-4) {
    lines.left = {wall.start + half * leftOf(d), wall.end + half * leftOf(d)};
    lines.right = {wall.start - half * leftOf(d), wall.end - half * leftOf(d)};
    return lines;
  }
  const Vector2d centre =
      (wall.start + wall.end) / 2 + leftOf(d) * (chord.norm() / 2 / std::tan(wall.arc / 2));
  const int steps = std::clamp(int(std::ceil(std::abs(wall.arc) / (kPi / 48))), 2, 96);
  for (int i = 0; i <= steps; ++i) {
    const Vector2d from_centre =
        Eigen::Rotation2Dd(wall.arc * i / steps) * Vector2d(wall.start - centre);
    const Vector2d to_left = from_centre.normalized() * (wall.arc > 0 ? -1 : 1);
    lines.left.push_back(centre + from_centre + half * to_left);
    lines.right.push_back(centre + from_centre - half * to_left);
  }
  return lines;
}

/// Where the line through p along d meets the one through q along e; p where they are parallel, or
/// meet far off.
Vector2d corner(const Vector2d& p, const Vector2d& d, const Vector2d& q, const Vector2d& e,
                double reach) {
  const double turn = cross(d, e);
  if (std::abs(turn) < 1e-3) return p;
  const Vector2d meet = p + d * (cross(q - p, e) / turn);
  return (meet - p).norm() <= reach ? meet : p;
}

/// Mitres one end of `wall` with the neighbour that names it: the outer lines meet, the inner too.
void joinEnd(const std::vector<Wall>& walls, const std::vector<WallLines>& lines, size_t index,
             bool at_end, WallLines* joined) {
  const Wall& wall = walls[index];
  const std::string& other_id = at_end ? wall.at_end : wall.at_start;
  if (other_id.empty()) return;
  const auto other =
      std::find_if(walls.begin(), walls.end(), [&](const Wall& w) { return w.id == other_id; });
  if (other == walls.end() || other->level != wall.level || &*other == &wall) return;
  const Vector2d mine = at_end ? wall.end : wall.start;
  const bool by_start = other->at_start == wall.id, by_end = other->at_end == wall.id;
  if (!by_start && !by_end) return;
  const bool other_end =
      by_start && by_end ? (other->end - mine).norm() < (other->start - mine).norm() : by_end;
  const WallLines &a = lines[index], &b = lines[size_t(other - walls.begin())];
  const auto along = [](const std::vector<Vector2d>& line, bool end) -> Vector2d {
    return end ? (line.back() - line[line.size() - 2]).normalized()
               : (line[1] - line[0]).normalized();
  };
  const auto tip = [](const std::vector<Vector2d>& line, bool end) {
    return end ? line.back() : line.front();
  };
  // Walls that run on into each other keep their sides; head to head, left meets right.
  const bool swaps = at_end == other_end;
  const double reach = 2 * std::max(wall.thickness, other->thickness);
  for (const bool left : {true, false}) {
    const auto& line = left ? a.left : a.right;
    const auto& other_line = left != swaps ? b.left : b.right;
    auto& out = left ? joined->left : joined->right;
    (at_end ? out.back() : out.front()) =
        corner(tip(line, at_end), along(line, at_end), tip(other_line, other_end),
               along(other_line, other_end), reach);
  }
}

std::vector<Stretch> stretchesOf(const Home& home) {
  std::vector<WallLines> lines;
  for (const Wall& wall : home.walls) lines.push_back(unjoined(wall));
  std::vector<Stretch> stretches;
  for (size_t i = 0; i < home.walls.size(); ++i) {
    const Wall& wall = home.walls[i];
    WallLines joined = lines[i];
    joinEnd(home.walls, lines, i, false, &joined);
    joinEnd(home.walls, lines, i, true, &joined);
    const size_t count = joined.left.size() - 1;
    for (size_t k = 0; k < count; ++k) {
      Stretch s;
      s.wall = &wall;
      s.floor = home.levels[size_t(wall.level)].elevation;
      s.base = s.floor - home.levels[size_t(wall.level)].floor_thickness;
      for (int end = 0; end < 2; ++end) {
        const size_t at = k + size_t(end);
        s.left[end] = joined.left[at], s.right[end] = joined.right[at];
        s.top[end] =
            s.floor + wall.height + (wall.height_at_end - wall.height) * double(at) / double(count);
        s.has_cap[end] = at == 0 || at == count;
      }
      if ((s.middle(1) - s.middle(0)).norm() > 1e-6) stretches.push_back(s);
    }
  }
  return stretches;
}

/// An opening in the walls: which stretches it is in, and where it ends across them.
struct Opening {
  const Item* item = nullptr;
  Hole hole;
  double back = 0, front = 0;  // of the walls, along leftOf(axis) from the centre
  bool is_in_wall = false;
};

std::vector<Opening> cutOpenings(const Home& home, std::vector<Stretch>* stretches) {
  std::vector<Opening> openings;
  for (const Item& item : home.items) {
    if (!item.is_opening) continue;
    Opening opening{&item, holeOf(item, home.levels[size_t(item.level)].elevation)};
    const Hole& hole = opening.hole;
    const Vector2d across = leftOf(hole.axis);  // the model's back looks this way
    const double band_end = (.5 - item.wall_distance) * item.size.y();
    const double band_start = band_end - item.wall_thickness * item.size.y();
    for (Stretch& s : *stretches) {
      if (s.wall->level != item.level || std::abs(cross(s.direction(), hole.axis)) > .2) continue;
      const double a = across.dot(s.middle(0) - hole.centre),
                   b = across.dot(s.middle(1) - hole.centre);
      const double xa = hole.x(s.middle(0)), xb = hole.x(s.middle(1)), half = s.wall->thickness / 2;
      const double from = std::max(std::min(xa, xb), hole.cuts.front().x),
                   to = std::min(std::max(xa, xb), hole.cuts.back().x);
      if (to - from < 1e-3) continue;
      const double middle = a + (b - a) * ((from + to) / 2 - xa) / (xb - xa);
      const double overlap =
          std::min(middle + half, band_end) - std::max(middle - half, band_start);
      if (overlap < .25 * std::min(2 * half, band_end - band_start)) continue;
      s.holes.push_back(hole);
      opening.back = opening.is_in_wall ? std::max(opening.back, middle + half) : middle + half;
      opening.front = opening.is_in_wall ? std::min(opening.front, middle - half) : middle - half;
      opening.is_in_wall = true;
    }
    openings.push_back(opening);
  }
  return openings;
}

/// What the holes of a stretch leave out between two places of its side, from below: heights of the
/// lower edge at both places, then of the upper. No hole begins or ends between them.
std::vector<std::array<double, 4>> gapsBetween(const Stretch& s, const Vector2d (&p)[2]) {
  std::vector<std::array<double, 4>> gaps;
  for (const Hole& hole : s.holes) {
    const double x[2] = {hole.x(p[0]), hole.x(p[1])}, mid = (x[0] + x[1]) / 2;
    for (size_t c = 0; c + 1 < hole.cuts.size(); ++c) {
      const Hole::Cut &l = hole.cuts[c], &h = hole.cuts[c + 1];
      if (mid <= l.x || mid >= h.x) continue;
      std::array<double, 4> gap;
      for (size_t end = 0; end < 2; ++end) {
        const double t = (x[end] - l.x) / (h.x - l.x), top = s.topAt(p[end]);
        gap[end] = std::clamp(l.low + t * (h.low - l.low), s.base, top);
        gap[end + 2] = std::clamp(l.high + t * (h.high - l.high), s.base, top);
      }
      gaps.push_back(gap);
    }
  }
  std::sort(gaps.begin(), gaps.end());
  return gaps;
}

/// One side of a stretch, less its holes: upright strips between the edges of the holes.
void addSide(const Stretch& s, bool left, FaceBuilder* faces) {
  const Vector2d a = left ? s.left[0] : s.right[0], b = left ? s.left[1] : s.right[1];
  const Vector2d outward = leftOf(s.direction()) * (left ? 1 : -1);
  const Finish& finish = (left ? s.wall->left : s.wall->right).finish;
  std::vector<double> cuts{0, 1};
  for (const Hole& hole : s.holes)
    for (const Hole::Cut& cut : hole.cuts) {
      const double t = (cut.x - hole.x(a)) / (hole.x(b) - hole.x(a));
      if (t > 0 && t < 1) cuts.push_back(t);
    }
  std::sort(cuts.begin(), cuts.end());
  for (size_t k = 0; k + 1 < cuts.size(); ++k) {
    if (cuts[k + 1] - cuts[k] < 1e-9) continue;
    const Vector2d p[2] = {a + cuts[k] * (b - a), a + cuts[k + 1] * (b - a)};
    const double top[2] = {s.topAt(p[0]), s.topAt(p[1])};
    double z[2] = {s.base, s.base};
    const auto emit = [&](double high0, double high1) {
      if (high0 > z[0] || high1 > z[1])
        faces->add({lifted(p[0], z[0]), lifted(p[1], z[1]), lifted(p[1], std::max(high1, z[1])),
                    lifted(p[0], std::max(high0, z[0]))},
                   lifted(outward, 0), finish);
    };
    for (const auto& gap : gapsBetween(s, p)) {
      emit(gap[0], gap[1]);
      z[0] = std::max(z[0], gap[2]), z[1] = std::max(z[1], gap[3]);
    }
    emit(top[0], top[1]);
  }
}

/// The faces inside a hole, from one side of the wall to the other.
void addReveal(const Stretch& s, const Hole& hole, const Finish& finish, FaceBuilder* faces) {
  const auto at = [&](bool left, double x) {  // share of the side's length, and the place
    const Vector2d a = left ? s.left[0] : s.right[0], b = left ? s.left[1] : s.right[1];
    const double t = std::clamp((x - hole.x(a)) / (hole.x(b) - hole.x(a)), 0., 1.);
    return std::pair<double, Vector2d>(t, a + t * (b - a));
  };
  const auto raised = [&](const Vector2d& p, double z) {
    return lifted(p, std::clamp(z, s.base, s.topAt(p)));
  };
  for (size_t k = 0; k + 1 < hole.cuts.size(); ++k) {
    const Hole::Cut* ends[2] = {&hole.cuts[k], &hole.cuts[k + 1]};
    for (const bool is_top : {false, true}) {
      std::vector<Vector3d> quad;
      for (const auto& [left, end] : {std::pair(true, 0), {true, 1}, {false, 1}, {false, 0}}) {
        const Vector2d p = at(left, ends[end]->x).second;
        quad.push_back(raised(p, is_top ? ends[end]->high : ends[end]->low));
      }
      faces->add(quad, Vector3d::UnitZ() * (is_top ? -1 : 1), finish);
    }
  }
  for (const bool is_last : {false, true}) {
    const Hole::Cut& cut = is_last ? hole.cuts.back() : hole.cuts.front();
    const auto [tl, l] = at(true, cut.x);
    const auto [tr, r] = at(false, cut.x);
    if (tl <= 0 || tl >= 1 || tr <= 0 || tr >= 1) continue;  // the hole goes on in the next stretch
    faces->add({raised(l, cut.low), raised(r, cut.low), raised(r, cut.high), raised(l, cut.high)},
               lifted(hole.axis, 0) * (is_last ? -1 : 1), finish);
  }
}

/// Skirting along one side, less the openings that reach down to it.
void addBaseboard(const Stretch& s, bool left, FaceBuilder* faces) {
  const Baseboard& board = (left ? s.wall->left : s.wall->right).baseboard;
  if (board.height <= 0 || board.thickness <= 0) return;
  const Vector2d a = left ? s.left[0] : s.right[0], b = left ? s.left[1] : s.right[1];
  const Vector2d outward = leftOf(s.direction()) * (left ? 1 : -1);
  std::vector<std::pair<double, double>> gaps;
  for (const Hole& hole : s.holes) {
    const double low = std::min_element(hole.cuts.begin(), hole.cuts.end(), [](auto& x, auto& y) {
                         return x.low < y.low;
                       })->low;
    if (low >= s.floor + board.height) continue;
    const double t0 = (hole.cuts.front().x - hole.x(a)) / (hole.x(b) - hole.x(a));
    const double t1 = (hole.cuts.back().x - hole.x(a)) / (hole.x(b) - hole.x(a));
    gaps.emplace_back(std::min(t0, t1), std::max(t0, t1));
  }
  gaps.emplace_back(1, 2);
  std::sort(gaps.begin(), gaps.end());
  double from = 0;
  for (const auto& [gap_start, gap_end] : gaps) {
    const double to = std::min(gap_start, 1.);
    if (to > from + 1e-6) {
      const Vector2d p = a + from * (b - a), q = a + to * (b - a), o = board.thickness * outward;
      const double z = s.floor + board.height;
      const Vector3d along = lifted(q - p, 0);
      faces->add(
          {lifted(p + o, s.floor), lifted(q + o, s.floor), lifted(q + o, z), lifted(p + o, z)},
          lifted(outward, 0), board.finish);
      faces->add({lifted(p, z), lifted(q, z), lifted(q + o, z), lifted(p + o, z)},
                 Vector3d::UnitZ(), board.finish);
      faces->add({lifted(p, s.floor), lifted(p + o, s.floor), lifted(p + o, z), lifted(p, z)},
                 -along, board.finish);
      faces->add({lifted(q, s.floor), lifted(q + o, s.floor), lifted(q + o, z), lifted(q, z)},
                 along, board.finish);
    }
    from = std::max(from, gap_end);
  }
}

void addStretch(const Stretch& s, FaceBuilder* faces) {
  const Vector3d along = lifted(s.direction(), 0);
  addSide(s, true, faces);
  addSide(s, false, faces);
  addBaseboard(s, true, faces);
  addBaseboard(s, false, faces);
  const Finish& finish = s.wall->left.finish;
  const auto top = [&](const Vector2d& p) { return lifted(p, s.topAt(p)); };
  faces->add({top(s.left[0]), top(s.left[1]), top(s.right[1]), top(s.right[0])}, Vector3d::UnitZ(),
             finish);
  for (int end = 0; end < 2; ++end)
    if (s.has_cap[end])
      faces->add({lifted(s.left[end], s.base), lifted(s.right[end], s.base), top(s.right[end]),
                  top(s.left[end])},
                 along * (end ? 1 : -1), finish);
  for (const Hole& hole : s.holes) addReveal(s, hole, s.wall->right.finish, faces);
}

// --- floors and ceilings
// ---------------------------------------------------------------------------

using Plane = Vector3d;  // z = x * a + y * b + c, world

double planeAt(const Plane& plane, const Vector2d& p) {
  return plane.x() * p.x() + plane.y() * p.y() + plane.z();
}

double lowestAt(const std::vector<Plane>& planes, const Vector2d& p) {
  double z = std::numeric_limits<double>::infinity();
  for (const Plane& plane : planes) z = std::min(z, planeAt(plane, p));
  return z;
}

/// Points along an outline, about 0.1 m apart.
std::vector<Vector2d> pointsAlong(const Outline& outline) {
  std::vector<Vector2d> points;
  for (size_t i = 0, j = outline.size() - 1; i < outline.size(); j = i++) {
    const Vector2d edge = outline[i] - outline[j];
    const int steps = std::clamp(int(edge.norm() / .1), 1, 1000);
    for (int k = 0; k < steps; ++k) points.push_back(outline[j] + edge * ((k + .5) / steps));
  }
  return points;
}

/// The stretch of wall at the edge of a room, or nullptr.
const Stretch* wallAt(const std::vector<Stretch>& stretches, int level, const Vector2d& p,
                      double near) {
  const Stretch* best = nullptr;
  for (const Stretch& s : stretches) {
    if (s.wall->level != level) continue;
    const Vector2d d = s.direction(), from = p - s.middle(0);
    const double along = d.dot(from), length = (s.middle(1) - s.middle(0)).norm();
    const double off = std::abs(cross(d, from)) - s.wall->thickness / 2;
    if (along < -near || along > length + near || off > near) continue;
    if (best == nullptr || std::max(s.top[0], s.top[1]) > std::max(best->top[0], best->top[1]))
      best = &s;
  }
  return best;
}

/// Planes whose lowest is the ceiling, carried by the tops of the walls around. Sloped walls make
/// sloped planes if these agree with all the walls; else the ceiling is flat.
std::vector<Plane> ceilingsOf(const Home& home, const std::vector<Stretch>& stretches,
                              const Space& space) {
  const Level& level = home.levels[size_t(space.level)];
  std::vector<Plane> planes;
  std::vector<std::pair<Vector2d, double>> tops;
  for (const Vector2d& p : pointsAlong(space.outline)) {
    const Stretch* s = wallAt(stretches, space.level, p, .1);
    if (s == nullptr) continue;
    tops.emplace_back(p, s->topAt(p));
    const Vector2d d = s->direction();
    const double slope = (s->top[1] - s->top[0]) / (s->middle(1) - s->middle(0)).norm();
    if (std::abs(slope) < .02) continue;
    const Vector2d tilt = slope * d;
    const Plane plane(tilt.x(), tilt.y(), s->top[0] - tilt.dot(s->middle(0)));
    if (std::none_of(planes.begin(), planes.end(), [&](const Plane& q) {
          return std::abs(planeAt(q, p) - planeAt(plane, p)) < .05 &&
                 (q - plane).head<2>().norm() < .05;
        }))
      planes.push_back(plane);
  }
  const auto agrees = [&](const std::pair<Vector2d, double>& top) {
    return std::abs(lowestAt(planes, top.first) - top.second) < .08;
  };
  if (!planes.empty() &&
      std::count_if(tops.begin(), tops.end(), agrees) * 10 >= 8 * int(tops.size()))
    return planes;
  std::vector<double> heights;
  for (const auto& [p, z] : tops)
    if (z > level.elevation + 1.8) heights.push_back(z);
  if (heights.empty()) return {Plane(0, 0, level.elevation + level.height)};
  std::nth_element(heights.begin(), heights.begin() + std::ptrdiff_t(heights.size() / 2),
                   heights.end());
  return {Plane(0, 0, heights[heights.size() / 2])};
}

/// A narrow rim around a floor or ceiling, into the walls and `rise` up at its outer edge: outlines
/// are drawn by hand and miss the walls by millimetres.
void addRim(const Outline& outline, const std::vector<Plane>& planes, double rise,
            const Finish& finish, FaceBuilder* faces) {
  constexpr double kWidth = .03;
  for (size_t i = 0, j = outline.size() - 1; i < outline.size(); j = i++) {
    const Vector2d a = outline[j], b = outline[i];
    if ((b - a).norm() < 1e-6) continue;
    const Vector2d along = (b - a).normalized() * kWidth, out = -leftOf(along);
    faces->add({lifted(a, lowestAt(planes, a)), lifted(b, lowestAt(planes, b)),
                lifted(b + along + out, lowestAt(planes, b) + rise),
                lifted(a - along + out, lowestAt(planes, a) + rise)},
               Vector3d::UnitZ() * (rise > 0 ? -1 : 1), finish);
  }
}

/// Closes what is left between a sloped ceiling and walls whose tops are a little lower.
void addUpstand(const std::vector<Stretch>& stretches, const Space& space,
                const std::vector<Plane>& planes, FaceBuilder* faces) {
  constexpr double kMost = .15, kOverlap = .02;
  const Outline& outline = space.outline;
  for (size_t i = 0, j = outline.size() - 1; i < outline.size(); j = i++) {
    const Vector2d a = outline[j], b = outline[i];
    const Stretch* s = wallAt(stretches, space.level, (a + b) / 2, .1);
    if (s == nullptr || (b - a).norm() < 1e-6) continue;
    const double gap_a = lowestAt(planes, a) - s->topAt(a),
                 gap_b = lowestAt(planes, b) - s->topAt(b);
    const double gap = std::max(gap_a, gap_b);
    if (gap < 1e-6 || gap > kMost) continue;
    faces->add({lifted(a, s->topAt(a) - kOverlap), lifted(b, s->topAt(b) - kOverlap),
                lifted(b, lowestAt(planes, b)), lifted(a, lowestAt(planes, a))},
               lifted(leftOf(b - a), 0), space.ceiling);
  }
}

void addSpace(const Home& home, const std::vector<Stretch>& stretches, const Space& space,
              FaceBuilder* faces) {
  constexpr double kRise = .002;
  const double floor = home.levels[size_t(space.level)].elevation;
  const std::vector<Plane> planes = ceilingsOf(home, stretches, space);
  if (space.floor_visible) addRim(space.outline, {Plane(0, 0, floor)}, -kRise, space.floor, faces);
  if (space.ceiling_visible) {
    addRim(space.outline, planes, kRise, space.ceiling, faces);
    addUpstand(stretches, space, planes, faces);
  }
  for (const auto& [a, b, c] : triangulated(space.outline)) {
    if (space.floor_visible)
      faces->add({lifted(a, floor), lifted(b, floor), lifted(c, floor)}, Vector3d::UnitZ(),
                 space.floor);
    if (!space.ceiling_visible) continue;
    for (const Plane& plane : planes) {
      Outline part{a, b, c};
      for (const Plane& other : planes)
        if (&other != &plane)
          part = clipped(part,
                         [&](const Vector2d& p) { return planeAt(other, p) - planeAt(plane, p); });
      std::vector<Vector3d> corners;
      for (const Vector2d& p : part) corners.push_back(lifted(p, planeAt(plane, p)));
      if (corners.size() >= 3) faces->add(corners, -Vector3d::UnitZ(), space.ceiling);
    }
  }
}

// --- furniture
// ----------------------------------------------------------------------------------------

/// World from the model frame. Sweet Home 3D turns the model, fitted to its size and centred, by
/// its pitch or roll, then by its angle; in x right, y up, z to the front.
Eigen::Affine3f worldFromModel(const Home& home, const Item& item, const SurfaceMesh& mesh) {
  Eigen::AlignedBox3d box;
  for (const Vector3f& v : mesh.mesh.vertices) box.extend(v.cast<double>());
  Eigen::Matrix3d upright, world;
  upright << -1, 0, 0, 0, 0, 1, 0, 1, 0;
  world << 1, 0, 0, 0, 0, -1, 0, 1, 0;
  const Vector3d size = upright.cwiseAbs() * box.sizes();
  Vector3d scale = (upright.cwiseAbs() * item.size).cwiseQuotient(size.cwiseMax(1e-6));
  if (item.mirrored) scale.x() = -scale.x();
  Eigen::Matrix3d tilt = Eigen::Matrix3d::Identity();
  if (item.pitch != 0)
    tilt = Eigen::AngleAxisd(-item.pitch, Vector3d::UnitX());
  else if (item.roll != 0)
    tilt = Eigen::AngleAxisd(-item.roll, Vector3d::UnitZ());
  const double middle =
      home.levels[size_t(item.level)].elevation + item.elevation + item.height_in_plan / 2;
  Affine3d result = Affine3d::Identity();
  result.linear() = world * Eigen::AngleAxisd(item.angle, Vector3d::UnitY()) * tilt *
                    scale.asDiagonal() * upright;
  result.translation() = lifted(item.place, middle) - result.linear() * box.center();
  return result.cast<float>();
}

/// The model in the item's own colours: one for all of it but its glass, or some materials'.
SurfaceMesh coloured(const SurfaceMesh& mesh, const Item& item) {
  SurfaceMesh result = mesh;
  for (Material& material : result.materials) {
    const auto named = item.material_colours.find(material.name);
    const bool is_named = named != item.material_colours.end();
    if (!is_named && (!item.colour || material.opacity < kSolidOpacity)) continue;
    material.texture.reset(), material.pattern = Material::Pattern::kPlain;
    material.colour_a = is_named ? named->second : *item.colour;
  }
  return result;
}

/// An item where it stands.
struct Placed {
  const Item* item = nullptr;
  Eigen::Affine3f world_from_model = Eigen::Affine3f::Identity();
  Eigen::AlignedBox3f box;  // world
};

// --- the whole home
// -----------------------------------------------------------------------------------

/// Parsed home with what is derived from its plan alone.
struct Plan {
  explicit Plan(Home parsed) : home(std::move(parsed)), stretches(stretchesOf(home)) {
    openings = cutOpenings(home, &stretches);
    for (const Space& space : home.spaces)
      if (isRoom(space)) rooms.push_back(&space);
  }
  Plan(const Plan&) = delete;

  Home home;
  std::vector<Stretch> stretches;
  std::vector<Opening> openings;
  std::vector<const Space*> rooms;  // furnished or not, in the file's order

  double elevation(int level) const { return home.levels[size_t(level)].elevation; }

  /// Whether something is above: a ceiling of this level or a higher one, or a wide board hung
  /// high.
  bool isCovered(int level, const Vector2d& p) const {
    for (const Space& space : home.spaces)
      if (space.ceiling_visible && elevation(space.level) >= elevation(level) &&
          isInside(space.outline, p))
        return true;
    for (const Item& item : home.items) {
      const Vector2d axis(std::cos(item.angle), std::sin(item.angle)), from = p - item.place;
      if (item.size.head<2>().minCoeff() > 1.5 && std::abs(axis.dot(from)) < item.size.x() / 2 &&
          std::abs(cross(axis, from)) < item.size.y() / 2 &&
          elevation(item.level) + item.elevation > elevation(level) + 1.8)
        return true;
    }
    return false;
  }

  /// Whether a point is in a room, not in the open or on a terrace.
  bool isIndoors(int level, const Vector2d& p) const {
    return std::any_of(rooms.begin(), rooms.end(), [&](const Space* space) {
      return elevation(space->level) == elevation(level) && isInside(space->outline, p);
    });
  }

  bool holds(const Space& space, const Item& item) const {
    return elevation(item.level) == elevation(space.level) && isInside(space.outline, item.place);
  }

  /// Rooms: floors under a cover, walled in for the most part.
  bool isRoom(const Space& space) const {
    if (!space.floor_visible) return false;
    double area = 0, covered = 0;
    for (const auto& [a, b, c] : triangulated(space.outline)) {
      const double part = cross(b - a, c - a) / 2;
      area += part, covered += isCovered(space.level, (a + b + c) / 3) ? part : 0;
    }
    const std::vector<Vector2d> edge = pointsAlong(space.outline);
    const auto walled = std::count_if(edge.begin(), edge.end(), [&](const Vector2d& p) {
      return wallAt(stretches, space.level, p, .15) != nullptr;
    });
    return area > 0 && covered >= .5 * area && 2 * walled >= std::ptrdiff_t(edge.size());
  }

  std::vector<const Space*> furnishedRooms() const {
    std::vector<const Space*> furnished;
    for (const Space* space : rooms)
      if (std::count_if(home.items.begin(), home.items.end(), [&](const Item& item) {
            return !item.is_opening && holds(*space, item);
          }) >= 2)
        furnished.push_back(space);
    return furnished;
  }

  /// Levels that one can see from `level`: of the same height, or past a floor with no ceiling
  /// below.
  std::set<int> seenFrom(int level) const {
    std::vector<double> heights;
    for (const Level& l : home.levels) heights.push_back(l.elevation);
    std::sort(heights.begin(), heights.end());
    heights.erase(std::unique(heights.begin(), heights.end()), heights.end());
    const auto isOpen = [&](double z) {
      return std::any_of(home.spaces.begin(), home.spaces.end(), [&](const Space& space) {
        return !space.ceiling_visible && elevation(space.level) == z;
      });
    };
    size_t low =
        size_t(std::find(heights.begin(), heights.end(), elevation(level)) - heights.begin());
    size_t high = low;
    while (low > 0 && isOpen(heights[low - 1])) --low;
    while (high + 1 < heights.size() && isOpen(heights[high])) ++high;
    std::set<int> seen;
    for (size_t i = 0; i < home.levels.size(); ++i)
      if (home.levels[i].elevation >= heights[low] && home.levels[i].elevation <= heights[high])
        seen.insert(int(i));
    return seen;
  }
};

/// Surface, lights and pieces of the levels in sight of one.
struct Built {
  SurfaceMesh surface;
  std::vector<uint8_t> is_shell;  // as Room
  std::vector<RoomLight> lights;
  std::vector<Placed> placed;
};

/// Whether light comes in through a model: panes over a quarter of its front.
bool isWindow(const ModelInfo& info, const SurfaceMesh& mesh) {
  std::string name = info.id + info.name;
  std::transform(name.begin(), name.end(), name.begin(),
                 [](unsigned char c) { return char(std::tolower(c)); });
  if (name.find("window") != std::string::npos || name.find("frame") != std::string::npos)
    return true;
  double glass = 0;
  Eigen::AlignedBox3f box;
  for (size_t i = 0; i < mesh.mesh.triangles.size(); ++i) {
    const Eigen::Vector3i& t = mesh.mesh.triangles[i];
    const Vector3f &a = mesh.mesh.vertices[size_t(t[0])], &b = mesh.mesh.vertices[size_t(t[1])],
                   &c = mesh.mesh.vertices[size_t(t[2])];
    box.extend(a), box.extend(b), box.extend(c);
    if (mesh.materials[size_t(mesh.material[i])].opacity < kSolidOpacity)
      glass += std::abs((b - a).cross(c - a).y()) / 2;
  }
  return glass > .25 * double(box.sizes().x() * box.sizes().z());
}

/// Outside light behind a window: the sky to look at, and a light of the window's size before it.
void addDaylight(const Plan& plan, const Opening& opening, FaceBuilder* faces,
                 std::vector<RoomLight>* lights) {
  const Item& item = *opening.item;
  const Vector2d across = leftOf(opening.hole.axis);
  const bool is_back_in = plan.isIndoors(item.level, item.place + (opening.back + .3) * across);
  const bool is_front_in = plan.isIndoors(item.level, item.place + (opening.front - .3) * across);
  if (is_back_in == is_front_in) return;
  constexpr double kMargin = .05, kBehind = .02;
  const Vector2d inward = is_back_in ? across : -across;
  const Vector2d face =
      item.place + across * (is_back_in ? opening.front - kBehind : opening.back + kBehind);
  const Vector2d along(-inward.y(), inward.x());
  const double bottom = plan.elevation(item.level) + item.elevation, half = item.size.x() / 2;
  const auto corner_at = [&](double u, double z) { return lifted(face + u * along, z); };
  const double reach = half + kMargin, low = bottom - kMargin,
               high = bottom + item.size.z() + kMargin;
  faces->addPane({corner_at(-reach, low), corner_at(reach, low), corner_at(reach, high),
                  corner_at(-reach, high)},
                 lifted(inward, 0));
  RoomLight light;
  light.centre = lifted(face + .005 * inward, bottom + item.size.z() / 2).cast<float>();
  light.half_u = lifted(along * half, 0).cast<float>();
  light.half_v = Vector3f(0, 0, float(item.size.z() / 2));
  light.bound_m = float(opening.back - opening.front + kBehind);
  light.radiance = {8, 9, 10};
  lights->push_back(light);
}

void addLamps(const ModelInfo& info, const Placed& placed, std::vector<RoomLight>* lights) {
  if (placed.item->power <= 0) return;
  for (const ModelLight& lamp : info.lights) {
    // Of the same intensity whatever its size; the examples have power .5.
    constexpr float kIntensity = 2.4f, kPiF = float(kPi);
    RoomLight light;
    light.centre = placed.world_from_model * lamp.centre;
    // The shade is what shines, as in furnished rooms.
    const float shade = std::min(.4f, .5f * placed.box.sizes().head<2>().maxCoeff());
    light.radius_m = std::max(std::clamp(lamp.diameter_m / 2, .02f, .15f), .75f * shade);
    light.bound_m = std::max(shade - light.radius_m, 0.f) + .02f;
    light.radiance = lamp.colour / std::max(lamp.colour.maxCoeff(), .01f) *
                     float(placed.item->power) * kIntensity /
                     (kPiF * light.radius_m * light.radius_m);
    lights->push_back(light);
  }
}

Built build(const AssetLibrary& assets, const Plan& plan, int level) {
  const std::set<int> levels = plan.seenFrom(level);
  Built built;
  FaceBuilder faces(assets);
  for (const Stretch& s : plan.stretches)
    if (levels.count(s.wall->level)) addStretch(s, &faces);
  for (const Space& space : plan.home.spaces)
    if (levels.count(space.level)) addSpace(plan.home, plan.stretches, space, &faces);
  for (const Opening& opening : plan.openings)
    if (levels.count(opening.item->level) && opening.is_in_wall &&
        isWindow(assets.models()[opening.item->model], *assets.mesh(opening.item->model)))
      addDaylight(plan, opening, &faces, &built.lights);
  built.surface = std::move(faces.surface);
  built.is_shell.assign(built.surface.mesh.triangles.size(), 1);
  for (const Item& item : plan.home.items) {
    if (!levels.count(item.level)) continue;
    const SurfaceMesh mesh = coloured(*assets.mesh(item.model), item);
    Placed placed{&item, worldFromModel(plan.home, item, mesh), {}};
    for (const Vector3f& v : mesh.mesh.vertices) placed.box.extend(placed.world_from_model * v);
    addLamps(assets.models()[item.model], placed, &built.lights);
    built.surface.append(mesh, placed.world_from_model);
    built.is_shell.resize(built.surface.mesh.triangles.size(), item.is_opening);
    built.placed.push_back(placed);
  }
  return built;
}

/// A place well inside an outline: of its triangles' middles the one farthest from its edge.
Vector2d middleOf(const Outline& outline) {
  Vector2d best = outline[0];
  double farthest = -1;
  const std::vector<Vector2d> edge = pointsAlong(outline);
  for (const auto& [a, b, c] : triangulated(outline)) {
    const Vector2d p = (a + b + c) / 3;
    double distance = std::numeric_limits<double>::infinity();
    for (const Vector2d& e : edge) distance = std::min(distance, (e - p).norm());
    if (distance > farthest) farthest = distance, best = p;
  }
  return best;
}

/// Whether a light shines inside an outline, or through a window at its edge.
bool lightsUp(const RoomLight& light, const Outline& outline) {
  const Vector2d p = light.centre.head<2>().cast<double>();
  const Vector2d inward = light.half_u.cross(light.half_v).head<2>().cast<double>();
  return isInside(outline,
                  inward.isZero() ? p : Vector2d(p + (light.bound_m + .3) * inward.normalized()));
}

/// The lights that shine on something that can be seen from the room: a home has up to 37, and most
/// are behind closed doors.
std::vector<RoomLight> lightsInSight(const Room& room) {
  constexpr int kOrigins = 64, kRays = 64;
  const RayTarget target = RayTarget::fromMesh(solidMesh(room.surface));
  std::vector<Vector3f> origins, directions;
  std::mt19937_64 random(1);
  const auto uniform = [&] { return float(random() >> 40) / float(1 << 24); };
  Eigen::AlignedBox2f area;
  for (const Vector2f& p : room.floor) area.extend(p);
  for (int tries = 0; tries < 100 * kOrigins && origins.size() < kOrigins * kRays; ++tries) {
    const float x = uniform(), y = uniform(), z = uniform();
    const Vector2f p = area.min() + area.sizes().cwiseProduct(Vector2f(x, y));
    const Vector3f origin(p.x(), p.y(), .2f + 1.8f * z);
    if (!isFree(room, origin, .05f)) continue;
    for (int i = 0; i < kRays; ++i) {
      const float cosine = 2 * uniform() - 1, turn = 2 * float(kPi) * uniform();
      const float sine = std::sqrt(1 - cosine * cosine);
      origins.push_back(room.world_from_room * origin);
      directions.emplace_back(sine * std::cos(turn), sine * std::sin(turn), cosine);
    }
  }
  const std::vector<float> distances = target.trace(origins, directions);
  std::vector<Vector3f> seen;
  for (size_t i = 0; i < distances.size(); ++i)
    if (std::isfinite(distances[i]))
      seen.push_back(origins[i] + (distances[i] - .01f) * directions[i]);
  std::vector<RoomLight> kept;
  for (const RoomLight& light : room.lights) {
    const Vector3f normal = light.half_u.cross(light.half_v);
    std::vector<Vector3f> from, towards;
    std::vector<float> reach;
    for (const Vector3f& p : seen) {
      const Vector3f to = light.centre - p;
      if (!normal.isZero() && normal.dot(to) >= 0) continue;
      from.push_back(p), towards.push_back(to.normalized());
      reach.push_back(to.norm() - light.radius_m - light.bound_m);
    }
    const std::vector<float> blocked = target.trace(from, towards);
    for (size_t i = 0; i < blocked.size(); ++i)
      if (blocked[i] >= reach[i]) {
        kept.push_back(light);
        break;
      }
  }
  return kept;
}

Room roomOf(const AssetLibrary& assets, const Plan& plan, const Space& space, Built built) {
  const double floor = plan.elevation(space.level);
  Room room;
  room.kind = space.name;
  std::transform(room.kind.begin(), room.kind.end(), room.kind.begin(),
                 [](unsigned char c) { return char(std::tolower(c)); });
  if (room.kind.empty()) room.kind = "room";
  room.world_from_room.translation().z() = float(floor);
  for (const Vector2d& p : space.outline) room.floor.push_back(p.cast<float>());
  double ceiling = std::numeric_limits<double>::infinity();
  const Vector2d middle = middleOf(space.outline);
  for (const Plane& plane : ceilingsOf(plan.home, plan.stretches, space)) {
    room.ceilings.push_back((plane - Vector3d(0, 0, floor)).cast<float>());
    ceiling = std::min(ceiling, planeAt(plane, middle));
  }
  Eigen::AlignedBox2d area;
  for (const Vector2d& p : space.outline) area.extend(p);
  for (const Placed& placed : built.placed) {
    if (plan.elevation(placed.item->level) != floor) continue;
    Piece piece{assets.models()[placed.item->model].id,
                room.world_from_room.inverse() * placed.world_from_model, placed.box};
    piece.box.translate(-room.world_from_room.translation());
    const Eigen::AlignedBox2d base(piece.box.min().head<2>().cast<double>(),
                                   piece.box.max().head<2>().cast<double>());
    // Carpets are walked on.
    if (area.intersects(base) && piece.box.max().z() > .05f) room.solids.push_back(piece.box);
    if (!placed.item->is_opening && plan.holds(space, *placed.item)) room.pieces.push_back(piece);
  }
  room.surface = std::move(built.surface);
  room.is_shell = std::move(built.is_shell);
  room.lights = std::move(built.lights);
  room.lights = lightsInSight(room);
  if (std::none_of(room.lights.begin(), room.lights.end(),
                   [&](const RoomLight& light) { return lightsUp(light, space.outline); })) {
    RoomLight light;
    light.centre = lifted(middle, ceiling - .4).cast<float>();
    light.radius_m = .1f, light.radiance = 40.f * Vector3f(1, .92f, .8f);
    room.lights.push_back(light);
  }
  return room;
}

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

/// Home.xml of a .sh3d file.
std::string homeXml(const std::string& path) {
  const ZipFile zip("readHome", path);
  require(zip.has("Home.xml") || !zip.has("Home"), "readHome: ", path,
          ": expected Home.xml, found only the Java object Home; save it with Sweet Home 3D 5.3 or "
          "newer");
  return zip.read("Home.xml", kMostHomeBytes);
}

}  // namespace

int homeRoomCount(const AssetLibrary& assets) {
  int count = 0;
  for (const std::string& name : exampleHomes(assets))
    count += int(Plan(exampleHome(assets, name)).furnishedRooms().size());
  return count;
}

Room homeRoom(const AssetLibrary& assets, int index) {
  int first = 0;
  for (const std::string& name : exampleHomes(assets)) {
    const Plan plan(exampleHome(assets, name));
    const std::vector<const Space*> rooms = plan.furnishedRooms();
    if (index >= first && index < first + int(rooms.size())) {
      const Space& space = *rooms[size_t(index - first)];
      Room room = roomOf(assets, plan, space, build(assets, plan, space.level));
      room.name = joinText("homes:", index);
      return room;
    }
    first += int(rooms.size());
  }
  throw Error(joinText("homeRoom: expected an index from 0 to ", first - 1, ", found ", index));
}

std::vector<Room> readHome(const AssetLibrary& assets, const std::string& sh3d_path) {
  const Plan plan(HomeReader(assets, sh3d_path, sh3d_path).read(homeXml(sh3d_path)));
  std::vector<Room> rooms;
  for (const Space* space : plan.furnishedRooms()) {
    rooms.push_back(roomOf(assets, plan, *space, build(assets, plan, space->level)));
    rooms.back().name = joinText(sh3d_path, ":", rooms.size() - 1);
  }
  return rooms;
}

}  // namespace vdbc
