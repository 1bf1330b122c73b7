// Where cameras can stand in a room, and which of them see most of it.
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <set>

#include "examples/rooms/floor_plan.h"
#include "examples/rooms/rooms.h"
#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;

constexpr double kFieldOfView = 70. * M_PI / 180;  // vertical
constexpr int kTriesPerCamera = 2000;

float distanceToOutline(const std::vector<Vector2f>& outline, const Vector2f& p) {
  float nearest = INFINITY;
  for (size_t i = 0, j = outline.size() - 1; i < outline.size(); j = i++) {
    const Vector2f d = outline[i] - outline[j];
    const float t =
        std::clamp((p - outline[j]).dot(d) / std::max(d.squaredNorm(), 1e-12f), 0.f, 1.f);
    nearest = std::min(nearest, (outline[j] + t * d - p).norm());
  }
  return nearest;
}

Eigen::AlignedBox2f footprint(const Room& room) {
  require(room.floor.size() >= 3 && !room.ceilings.empty(), room.name,
          ": expected a floor of three corners or more and a ceiling");
  Eigen::AlignedBox2f box;
  for (const Vector2f& p : room.floor) box.extend(p);
  return box;
}

/// At `eye`, looking along the unit vector `forward`, turned by `roll` radians about it; room
/// frame.
Camera cameraAt(const Room& room, const Vector3d& eye, const Vector3d& forward, double roll,
                int width, int height) {
  Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = camera.fy = height / (2 * std::tan(kFieldOfView / 2));
  camera.cx = width / 2., camera.cy = height / 2.;
  const Eigen::Matrix3d room_from_camera = lookAlong(forward, Vector3d::UnitZ());
  // Rebuilt in double: the float pose of the room is orthonormal to 1e-7 only.
  const Eigen::Quaterniond yaw(room.world_from_room.linear().cast<double>());
  camera.world_from_camera.linear() = yaw.normalized().toRotationMatrix() * room_from_camera *
                                      Eigen::AngleAxisd(roll, Vector3d::UnitZ()).toRotationMatrix();
  camera.world_from_camera.translation() = room.world_from_room.cast<double>() * eye;
  return camera;
}

/// Points where the rays of a regular grid of `side` x `side` pixels meet the surface.
std::vector<Vector3f> pointsSeen(const RayTarget& solid, const Camera& camera, int side,
                                 std::vector<float>* distances) {
  std::vector<Vector3f> origins, directions, points;
  const Vector3d eye = camera.world_from_camera.translation();
  for (int j = 0; j < side; ++j)
    for (int i = 0; i < side; ++i) {
      const Vector3d p =
          camera.unproject(camera.width * (i + .5) / side, camera.height * (j + .5) / side, 1);
      origins.push_back(eye.cast<float>());
      directions.push_back((p - eye).normalized().cast<float>());
    }
  *distances = solid.trace(origins, directions);
  for (size_t i = 0; i < origins.size(); ++i)
    if (std::isfinite((*distances)[i]))
      points.push_back(origins[i] + (*distances)[i] * directions[i]);
  return points;
}

/// A view of nothing but a near wall teaches nothing.
bool seesEnough(const RayTarget& solid, const Camera& camera) {
  constexpr int kProbes = 12;  // rays across the picture
  constexpr float kNearest = .4f, kMedian = 1.1f;
  std::vector<float> distances;
  pointsSeen(solid, camera, kProbes, &distances);
  std::nth_element(distances.begin(), distances.begin() + kProbes * kProbes / 2, distances.end());
  return distances[kProbes * kProbes / 2] >= kMedian &&
         *std::min_element(distances.begin(), distances.end()) >= kNearest;
}

}  // namespace

bool isFree(const Room& room, const Vector3f& p_room, float margin_m) {
  const Vector2f p = p_room.head<2>();
  if (p_room.z() < margin_m || p_room.z() + margin_m > ceilingAt(room.ceilings, p)) return false;
  if (!isInside(room.floor, p) || distanceToOutline(room.floor, p) < margin_m) return false;
  return std::none_of(room.solids.begin(), room.solids.end(), [&](const Eigen::AlignedBox3f& box) {
    return box.exteriorDistance(p_room) < std::max(margin_m, 1e-6f);
  });
}

bool isWithin(const Room& room, const Vector3f& p_room) {
  const Vector2f p = p_room.head<2>();
  return p_room.z() >= 0 && p_room.z() <= ceilingAt(room.ceilings, p) && isInside(room.floor, p);
}

std::vector<Camera> randomCameras(const Room& room, const RayTarget& solid, int count, int width,
                                  int height, std::mt19937_64& random) {
  constexpr float kMargin = .3f;  // metres from walls and furniture
  require(width > 0 && height > 0, "randomCameras: expected a size in pixels, found ", width, " x ",
          height);
  const Eigen::AlignedBox2f area = footprint(room);
  std::vector<Camera> cameras;
  for (int tries = 0; int(cameras.size()) < count; ++tries) {
    require(tries < kTriesPerCamera * std::max(count, 10), room.name, ": expected a place for ",
            count, " cameras, found one for ", cameras.size());
    const double x = uniform(random, area.min().x(), area.max().x());
    const double y = uniform(random, area.min().y(), area.max().y());
    const double z = uniform(random, 1.1, 1.9);
    const double tx = uniform(random, area.min().x(), area.max().x());
    const double ty = uniform(random, area.min().y(), area.max().y());
    const double pitch = uniform(random, -.35, .12), roll = uniform(random, -.03, .03);
    const Eigen::Vector2d level(tx - x, ty - y);
    if (level.norm() < .5 || !isFree(room, Vector3d(x, y, z).cast<float>(), kMargin)) continue;
    const Vector3d forward =
        Vector3d(level.x() / level.norm(), level.y() / level.norm(), std::tan(pitch)).normalized();
    const Camera camera = cameraAt(room, {x, y, z}, forward, roll, width, height);
    if (seesEnough(solid, camera)) cameras.push_back(camera);
  }
  return cameras;
}

std::vector<Coord> coveredCells(const RayTarget& solid, const Camera& camera) {
  constexpr int kSide = 48;
  constexpr float kCell = .1f;
  std::vector<float> distances;
  std::vector<Coord> cells;
  for (const Vector3f& p : pointsSeen(solid, camera, kSide, &distances))
    cells.push_back(Coord::floor(openvdb::Vec3f(p.x() / kCell, p.y() / kCell, p.z() / kCell)));
  std::sort(cells.begin(), cells.end());
  cells.erase(std::unique(cells.begin(), cells.end()), cells.end());
  return cells;
}

std::vector<Camera> coveringCameras(const RayTarget& solid, const std::vector<Camera>& candidates,
                                    int count) {
  require(int(candidates.size()) >= count, "coveringCameras: expected at least ", count,
          " candidates, found ", candidates.size());
  std::vector<std::vector<Coord>> cells(candidates.size());
  tbb::parallel_for(size_t(0), candidates.size(),
                    [&](size_t i) { cells[i] = coveredCells(solid, candidates[i]); });
  std::set<Coord> covered;
  std::vector<Camera> chosen;
  std::vector<bool> is_chosen(candidates.size());
  while (int(chosen.size()) < count) {
    size_t best = 0;
    int64_t most = -1;
    for (size_t i = 0; i < candidates.size(); ++i) {
      if (is_chosen[i]) continue;
      const int64_t added = std::count_if(cells[i].begin(), cells[i].end(),
                                          [&](const Coord& c) { return covered.count(c) == 0; });
      if (added > most) best = i, most = added;
    }
    covered.insert(cells[best].begin(), cells[best].end());
    is_chosen[best] = true;
    chosen.push_back(candidates[best]);
  }
  return chosen;
}

std::vector<Camera> roomCameras(const Room& room, const RoomRenderer& renderer, int count,
                                int width, int height, uint64_t seed) {
  std::mt19937_64 random(seed);
  const RayTarget& solid = renderer.rayTarget();
  std::vector<Camera> cameras =
      coveringCameras(solid, randomCameras(room, solid, 4 * count, width, height, random), count);
  for (size_t i = cameras.size(); i-- > 1;) std::swap(cameras[i], cameras[random() % (i + 1)]);
  return cameras;
}

std::vector<View> roomViews(const Room& room, const RoomRenderer& renderer, int count, int width,
                            int height, int samples, uint64_t seed) {
  std::vector<View> views;
  for (const Camera& camera : roomCameras(room, renderer, count, width, height, seed))
    views.push_back(renderer.render(camera, samples, seed + views.size()));
  return views;
}

std::vector<Vector3f> freePoints(const Room& room, int count, uint64_t seed) {
  constexpr float kMargin = .03f;  // metres from walls (skirting, frames) and furniture
  const Eigen::AlignedBox2f area = footprint(room);
  float top = 0;
  for (const Vector2f& p : room.floor) top = std::max(top, ceilingAt(room.ceilings, p));
  std::mt19937_64 random(seed);
  std::vector<Vector3f> points;
  for (int tries = 0; int(points.size()) < count; ++tries) {
    require(tries < 10000 + 1000 * count, room.name, ": expected air to stand in, found none");
    const float x = float(uniform(random, area.min().x(), area.max().x()));
    const float y = float(uniform(random, area.min().y(), area.max().y()));
    const Vector3f p(x, y, float(uniform(random, kMargin, top)));
    if (isFree(room, p, kMargin)) points.push_back(room.world_from_room * p);
  }
  return points;
}

}  // namespace vdbc
