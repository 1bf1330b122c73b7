#pragma once
// Private: points sorted into cubic cells.
#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <unordered_map>
#include <utility>
#include <vector>

namespace vdbc {

/// Names the cubic cell of a point: 21 bits an axis, so a million cells to each side of the origin.
inline uint64_t cellOf(const Eigen::Vector3f& p, float cell_m) {
  uint64_t name = 0;
  for (int axis = 0; axis < 3; ++axis)
    name = name << 21 | (uint64_t(int64_t(std::floor(p[axis] / cell_m))) & 0x1fffff);
  return name;
}

/// Finds which of many points are near one.
class PointCells {
 public:
  PointCells(const std::vector<Eigen::Vector3f>& points, float cell_m)
      : points_(points), cell_m_(cell_m) {
    for (size_t i = 0; i < points.size(); ++i) cells_[cellOf(points[i], cell_m)].push_back(i);
  }

  /// Calls visit(row, squared distance) for the points within one cell's edge of p, always in the
  /// same order.
  template <typename Visit>
  void near(const Eigen::Vector3f& p, const Visit& visit) const {
    for (int k = 0; k < 27; ++k) {
      const Eigen::Vector3f offset(float(k / 9 - 1), float(k / 3 % 3 - 1), float(k % 3 - 1));
      const auto cell = cells_.find(cellOf(p + cell_m_ * offset, cell_m_));
      if (cell == cells_.end()) continue;
      for (size_t i : cell->second) {
        const float d = (points_[i] - p).squaredNorm();
        if (d <= cell_m_ * cell_m_) visit(i, d);
      }
    }
  }

 private:
  const std::vector<Eigen::Vector3f>& points_;
  float cell_m_;
  std::unordered_map<uint64_t, std::vector<size_t>> cells_;
};

}  // namespace vdbc
