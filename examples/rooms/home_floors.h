#pragma once
// Private to homes: floors and ceilings.
#include <Eigen/Core>
#include <vector>

#include "examples/rooms/home_walls.h"

namespace vdbc {

using Plane = Eigen::Vector3d;  // z = x * a + y * b + c, world
inline double planeAt(const Plane& plane, const Eigen::Vector2d& p) {
  return plane.x() * p.x() + plane.y() * p.y() + plane.z();
}

/// Points along an outline, about 0.1 m apart.
std::vector<Eigen::Vector2d> pointsAlong(const Home::Outline& outline);
/// Planes whose lowest is the ceiling, carried by the tops of the walls around. Sloped walls make
/// sloped planes if these agree with all the walls; else the ceiling is flat.
std::vector<Plane> ceilingsOf(const Home& home, const std::vector<Stretch>& stretches,
                              const Home::Space& space);
/// The floor and the ceiling of a room.
void addSpace(const Home& home, const std::vector<Stretch>& stretches, const Home::Space& space,
              FaceBuilder* faces);

}  // namespace vdbc
