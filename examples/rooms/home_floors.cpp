#include "examples/rooms/home_floors.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "examples/rooms/floor_plan.h"

namespace vdbc {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using Level = Home::Level;
using Outline = Home::Outline;
using Space = Home::Space;

double lowestAt(const std::vector<Plane>& planes, const Vector2d& p) {
  double z = std::numeric_limits<double>::infinity();
  for (const Plane& plane : planes) z = std::min(z, planeAt(plane, p));
  return z;
}

/// A narrow rim around a floor or ceiling, into the walls and `rise` up at its outer edge: outlines
/// are drawn by hand and miss the walls by millimetres.
void addRim(const Outline& outline, const std::vector<Plane>& planes, double rise,
            const Home::Finish& finish, FaceBuilder* faces) {
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

}  // namespace

std::vector<Vector2d> pointsAlong(const Outline& outline) {
  std::vector<Vector2d> points;
  for (size_t i = 0, j = outline.size() - 1; i < outline.size(); j = i++) {
    const Vector2d edge = outline[i] - outline[j];
    const int steps = std::clamp(int(edge.norm() / .1), 1, 1000);
    for (int k = 0; k < steps; ++k) points.push_back(outline[j] + edge * ((k + .5) / steps));
  }
  return points;
}

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

}  // namespace vdbc
