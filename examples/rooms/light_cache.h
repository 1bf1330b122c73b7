#pragma once
// Private to the renderer: the light of all bounces after the first, made once a room.
#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace vdbc {

/// Irradiance in cells of space by the side a surface faces, coarser where there is little known.
/// Room frame, so that the cells lie along the walls.
class LightCache {
 public:
  struct Sample {
    Eigen::Vector3f position = Eigen::Vector3f::Zero(),
                    normal = Eigen::Vector3f::Zero();  // room frame
    Eigen::Vector3f direct =
        Eigen::Vector3f::Zero();  // irradiance, without what comes straight from the sun
    Eigen::Vector3f sun = Eigen::Vector3f::Zero();     // irradiance straight from the sun
    Eigen::Vector3f albedo = Eigen::Vector3f::Zero();  // of the surface here
    // The next sample along a cosine-distributed path from here, what the path carries on the way,
    // and whether it also brings the sun that shines there.
    int32_t link = kUnknown;
    Eigen::Vector3f link_weight = Eigen::Vector3f::Zero();
    bool link_sees_spots = false;
  };
  static constexpr int32_t kUnknown = -1, kDark = -2;

  LightCache() = default;
  explicit LightCache(const std::vector<Sample>& samples);

  /// Irradiance, without what comes straight from the sun; room frame. `capped`: without the
  /// excess.
  Eigen::Vector3f at(const Eigen::Vector3f& position, const Eigen::Vector3f& normal,
                     bool capped) const {
    for (int level = 0; level < kLevels; ++level) {
      const int32_t cell = find(cellKey(position, normal, level));
      if (cell < 0) continue;
      const Eigen::Vector3f& e = irradiance_[size_t(cell)];
      return capped && level == 0 ? Eigen::Vector3f(e * keptShare(e)) : e;
    }
    return mean_;
  }

  /// What at() leaves out when capped: irradiance far above the room's mean, near lamps and
  /// windows.
  Eigen::Vector3f excess(const Eigen::Vector3f& position, const Eigen::Vector3f& normal) const {
    const int32_t cell = find(cellKey(position, normal, 0));
    if (cell < 0) return Eigen::Vector3f::Zero();
    const Eigen::Vector3f& e = irradiance_[size_t(cell)];
    return e * (1 - keptShare(e));
  }
  const Eigen::Vector3f& mean() const { return mean_; }

 private:
  static constexpr int kLevels = 5;
  static constexpr float kEdge = .2f;  // of the finest cells, metres
  static constexpr float kCap = 1;     // irradiance that is not excess, of the mean
  static constexpr float kPrior = 6;   // samples that the next coarser cell counts for

  static uint64_t cellKey(const Eigen::Vector3f& p, const Eigen::Vector3f& n, int level) {
    int axis = 0;
    n.cwiseAbs().maxCoeff(&axis);
    const uint64_t side = uint64_t(2 * axis + (n[axis] > 0));
    // Half a cell off the surface: both faces of a thin board are apart, and surfaces that lie in a
    // boundary of cells stay on one side of it.
    const float edge = kEdge * float(1 << level);
    const Eigen::Vector3f q = p / edge + .5f * n;
    uint64_t key = uint64_t(level + 1) << 3 | side;
    for (int a = 0; a < 3; ++a)
      key = key << 18 | (uint64_t(int64_t(std::floor(q[a])) + (1 << 17)) & 0x3ffffu);
    return key;
  }
  float keptShare(const Eigen::Vector3f& irradiance) const {
    return std::min(1.f, kCap * mean_.sum() / std::max(irradiance.sum(), 1e-12f));
  }
  size_t slot(uint64_t key) const { return size_t(key * 0x9e3779b97f4a7c15ull >> shift_); }
  int32_t find(uint64_t key) const {
    for (size_t i = slot(key); table_[i].cell >= 0; i = (i + 1) & (table_.size() - 1))
      if (table_[i].key == key) return table_[i].cell;
    return -1;
  }

  struct Entry {
    uint64_t key = 0;
    int32_t cell = -1;
  };
  std::vector<Entry> table_;
  int shift_ = 63;
  std::vector<Eigen::Vector3f> irradiance_;
  Eigen::Vector3f mean_ = Eigen::Vector3f::Zero();
};

}  // namespace vdbc
