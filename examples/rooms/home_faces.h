#pragma once
// Private to homes: polygons of a plan, and textured faces above it.
#include <Eigen/Core>
#include <array>
#include <functional>
#include <map>
#include <vector>

#include "examples/rooms/home_file.h"

namespace vdbc {

inline double cross(const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  return a.x() * b.y() - a.y() * b.x();
}
inline Eigen::Vector2d leftOf(const Eigen::Vector2d& d) { return {-d.y(), d.x()}; }
inline Eigen::Vector3d lifted(const Eigen::Vector2d& p, double z) { return {p.x(), p.y(), z}; }

/// Ear clipping of a counter-clockwise outline (Meisters 1975); of a crossing one what can be cut.
std::vector<std::array<Eigen::Vector2d, 3>> triangulated(const Home::Outline& outline);
/// The part of a convex polygon where f >= 0; f is linear.
Home::Outline clipped(const Home::Outline& polygon,
                      const std::function<double(const Eigen::Vector2d&)>& f);

/// Faces in the finishes of a home.
class FaceBuilder {
 public:
  explicit FaceBuilder(const AssetLibrary& assets) : assets_(assets) {}

  /// Convex polygon whose front looks along `outward`; texture laid out in the world's metres.
  void add(const std::vector<Eigen::Vector3d>& corners, const Eigen::Vector3d& outward,
           const Home::Finish& finish);
  /// Something that shines.
  void addPane(const std::vector<Eigen::Vector3d>& corners, const Eigen::Vector3d& outward);

  SurfaceMesh surface;

 private:
  int32_t materialOf(const Home::Finish& finish);

  const AssetLibrary& assets_;
  std::map<std::array<float, 4>, int32_t> materials_;
};

}  // namespace vdbc
