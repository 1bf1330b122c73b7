#pragma once
// Private to homes: walls, joined at their corners, with openings cut into them.
#include <Eigen/Core>
#include <algorithm>
#include <vector>

#include "examples/rooms/home_faces.h"

namespace vdbc {

/// A hole through a wall: a shape in the plane of (x along the axis, height), pushed through.
struct Hole {
  struct Cut {
    double x, low, high;  // metres from the middle of the opening; world z
  };
  std::vector<Cut> cuts;  // ascending x: piecewise linear
  Eigen::Vector2d centre, axis;

  double x(const Eigen::Vector2d& p) const { return axis.dot(p - centre); }
};

/// A straight stretch of wall with upright sides: corners at its start and end, heights there.
struct Stretch {
  Eigen::Vector2d left[2], right[2];
  double floor = 0;  // of its level
  double base = 0;   // of the wall, which goes through the floor
  double top[2] = {0, 0};
  bool has_cap[2] = {true, true};
  const Home::Wall* wall = nullptr;
  std::vector<Hole> holes;

  Eigen::Vector2d middle(int end) const { return (left[end] + right[end]) / 2; }
  Eigen::Vector2d direction() const { return (middle(1) - middle(0)).normalized(); }
  /// Height of the top; beyond the ends, where mitred corners are, it goes on as it slopes.
  double topAt(const Eigen::Vector2d& p) const {
    const Eigen::Vector2d along = middle(1) - middle(0);
    const double share = (p - middle(0)).dot(along) / along.squaredNorm();
    return std::max(base, top[0] + (top[1] - top[0]) * share);
  }
};

/// An opening in the walls: which stretches it is in, and where it ends across them.
struct WallOpening {
  const Home::Item* item = nullptr;
  Hole hole;
  double back = 0, front = 0;  // of the walls, along leftOf(axis) from the centre
  bool is_in_wall = false;
};

std::vector<Stretch> stretchesOf(const Home& home);
/// The openings of a home, cut into the stretches they are in.
std::vector<WallOpening> cutOpenings(const Home& home, std::vector<Stretch>* stretches);
/// All faces of a stretch.
void addStretch(const Stretch& s, FaceBuilder* faces);
/// The stretch of wall at the edge of a room, or nullptr.
const Stretch* wallAt(const std::vector<Stretch>& stretches, int level, const Eigen::Vector2d& p,
                      double near);

}  // namespace vdbc
