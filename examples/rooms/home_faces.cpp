#include "examples/rooms/home_faces.h"

#include <algorithm>
#include <cmath>

namespace vdbc {
namespace {

using Eigen::Vector2d;
using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;
using Outline = Home::Outline;

bool triangleContains(const Vector2d& a, const Vector2d& b, const Vector2d& c, const Vector2d& p) {
  return cross(b - a, p - a) >= 0 && cross(c - b, p - b) >= 0 && cross(a - c, p - c) >= 0;
}

}  // namespace

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

Outline clipped(const Outline& polygon, const std::function<double(const Vector2d&)>& f) {
  Outline kept;
  for (size_t i = 0, j = polygon.size() - 1; i < polygon.size(); j = i++) {
    const double a = f(polygon[j]), b = f(polygon[i]);
    if ((a >= 0) != (b >= 0)) kept.push_back(polygon[j] + a / (a - b) * (polygon[i] - polygon[j]));
    if (b >= 0) kept.push_back(polygon[i]);
  }
  return kept;
}

void FaceBuilder::add(const std::vector<Vector3d>& corners, const Vector3d& outward,
                      const Home::Finish& finish) {
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

void FaceBuilder::addPane(const std::vector<Vector3d>& corners, const Vector3d& outward) {
  const size_t before = surface.mesh.triangles.size();
  add(corners, outward, Home::Finish());
  Material sky;
  sky.colour_a = {.72f, .86f, 1.f}, sky.emission = 2;
  surface.materials.push_back(sky);
  for (size_t i = before; i < surface.material.size(); ++i)
    surface.material[i] = int32_t(surface.materials.size()) - 1;
}

int32_t FaceBuilder::materialOf(const Home::Finish& finish) {
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

}  // namespace vdbc
