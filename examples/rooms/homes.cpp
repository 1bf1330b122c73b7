// Rooms of homes drawn by people: what a home's file says is read first, then walls, floors,
// ceilings and furniture are built from it.
#include <algorithm>
#include <cmath>
#include <set>

#include "examples/rooms/floor_plan.h"
#include "examples/rooms/home_floors.h"
#include "examples/rooms/rooms.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Affine3d;
using Eigen::Vector2d;
using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;
using Level = Home::Level;
using Outline = Home::Outline;
using Space = Home::Space;

/// World from the model frame. Sweet Home 3D turns the model, fitted to its size and centred, by
/// its pitch or roll, then by its angle; in x right, y up, z to the front.
Eigen::Affine3f worldFromModel(const Home& home, const Home::Item& item, const SurfaceMesh& mesh) {
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
SurfaceMesh coloured(const SurfaceMesh& mesh, const Home::Item& item) {
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
  const Home::Item* item = nullptr;
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
  std::vector<WallOpening> openings;
  std::vector<const Space*> rooms;  // furnished or not, in the file's order

  double elevation(int level) const { return home.levels[size_t(level)].elevation; }

  /// Whether something is above: a ceiling of this level or a higher one, or a wide board hung
  /// high.
  bool isCovered(int level, const Vector2d& p) const {
    for (const Space& space : home.spaces)
      if (space.ceiling_visible && elevation(space.level) >= elevation(level) &&
          isInside(space.outline, p))
        return true;
    for (const Home::Item& item : home.items) {
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

  bool holds(const Space& space, const Home::Item& item) const {
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
      if (std::count_if(home.items.begin(), home.items.end(), [&](const Home::Item& item) {
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
void addDaylight(const Plan& plan, const WallOpening& opening, FaceBuilder* faces,
                 std::vector<RoomLight>* lights) {
  const Home::Item& item = *opening.item;
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
    constexpr float kIntensity = 2.4f, kPiF = float(M_PI);
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
  for (const WallOpening& opening : plan.openings)
    if (levels.count(opening.item->level) && opening.is_in_wall &&
        isWindow(assets.models()[opening.item->model], *assets.mesh(opening.item->model)))
      addDaylight(plan, opening, &faces, &built.lights);
  built.surface = std::move(faces.surface);
  built.is_shell.assign(built.surface.mesh.triangles.size(), 1);
  for (const Home::Item& item : plan.home.items) {
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
      const float cosine = 2 * uniform() - 1, turn = 2 * float(M_PI) * uniform();
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
  const Plan plan(readHomeFile(assets, sh3d_path));
  std::vector<Room> rooms;
  for (const Space* space : plan.furnishedRooms()) {
    rooms.push_back(roomOf(assets, plan, *space, build(assets, plan, space->level)));
    rooms.back().name = joinText(sh3d_path, ":", rooms.size() - 1);
  }
  return rooms;
}

}  // namespace vdbc
