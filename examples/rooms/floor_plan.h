#pragma once
// Outlines of floors and the ceilings over them.
#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <vector>

namespace vdbc {

/// Whether `p` lies inside a closed outline (even-odd rule; the last corner joins the first).
template <typename Point>
bool isInside(const std::vector<Point>& outline, const typename std::vector<Point>::value_type& p) {
  bool inside = false;
  for (size_t i = 0, j = outline.size() - 1; i < outline.size(); j = i++) {
    const Point &a = outline[i], &b = outline[j];
    if ((a.y() > p.y()) != (b.y() > p.y()) &&
        p.x() < (b.x() - a.x()) * (p.y() - a.y()) / (b.y() - a.y()) + a.x())
      inside = !inside;
  }
  return inside;
}

/// Height of the lowest of the planes z = a x + b y + c over `p`; infinity where there are none.
inline float ceilingAt(const std::vector<Eigen::Vector3f>& ceilings, const Eigen::Vector2f& p) {
  float z = INFINITY;
  for (const Eigen::Vector3f& c : ceilings) z = std::min(z, c.x() * p.x() + c.y() * p.y() + c.z());
  return z;
}

}  // namespace vdbc
