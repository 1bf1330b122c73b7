#pragma once
// Textured triangles: what rooms and furniture are made of.
#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "splat/rays.h"

namespace vdbc {

/// 8-bit picture for surfaces: display sRGB and coverage (0-255), rows top-down. [H, W, 4]
struct Texture {
  int width = 0, height = 0;
  std::vector<uint8_t> rgba;
  bool has_alpha = false;  // any coverage below 255
};

/// How a surface takes light. Colours are scene-linear.
struct Material {
  enum class Pattern {
    kPlain,
    kStripes,
    kChecks,
    kPlanks,
    kTiles,
    kNoise
  } pattern = Pattern::kPlain;
  /// Reflectance; of a texture the factor; b is the second colour of a pattern.
  Eigen::Vector3f colour_a = Eigen::Vector3f::Constant(.6f), colour_b = Eigen::Vector3f::Zero();
  float period_m = 0.3f;                   // of a pattern
  std::shared_ptr<const Texture> texture;  // instead of a pattern; repeats, u right, v up
  float specular = 0.f;                    // reflectance of the gloss at normal incidence, 0-1
  float roughness = .5f;                   // of the gloss: 0 mirror, 1 matt
  float opacity = 1.f;   // share of light that is stopped; the rest goes straight on
  float emission = 0.f;  // radiance as a factor of the colour: windows, lamp shades
  std::string name;      // in its model's files: homes recolour by it
};

/// Materials of opacity below this are glass to a depth camera and to truth: seen through.
constexpr float kSolidOpacity = .5f;

/// Triangles with materials, metres; the parallel arrays have one row a triangle.
struct SurfaceMesh {
  TriangleMesh mesh;
  std::vector<int32_t> material;                   // [T] index into materials
  std::vector<std::array<Eigen::Vector2f, 3>> uv;  // [T] corners; of a pattern in metres
  /// [T] unit shading normals of the corners; all zero where the triangle is flat.
  std::vector<std::array<Eigen::Vector3f, 3>> normal;
  std::vector<Material> materials;

  /// Adds `other` moved by `to_this` (normals by its inverse transpose; mirroring keeps the winding
  /// outward).
  void append(const SurfaceMesh& other, const Eigen::Affine3f& to_this);
};

/// The triangles whose material is solid (kSolidOpacity): the true surface of a scene. Holes of a
/// texture's coverage are not cut out.
TriangleMesh solidMesh(const SurfaceMesh& surface);

}  // namespace vdbc
