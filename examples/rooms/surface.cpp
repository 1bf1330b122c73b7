#include "examples/rooms/surface.h"

#include <algorithm>

namespace vdbc {

using Eigen::Vector3f;

void SurfaceMesh::append(const SurfaceMesh& other, const Eigen::Affine3f& to_this) {
  const int32_t first_vertex = int32_t(mesh.vertices.size());
  const int32_t first_material = int32_t(materials.size());
  const Eigen::Matrix3f turn = to_this.linear().inverse().transpose();
  const bool mirrors = to_this.linear().determinant() < 0;
  for (const Vector3f& v : other.mesh.vertices) mesh.vertices.push_back(to_this * v);
  for (size_t i = 0; i < other.mesh.triangles.size(); ++i) {
    Eigen::Vector3i t = other.mesh.triangles[i].array() + first_vertex;
    std::array<Eigen::Vector2f, 3> corners = other.uv[i];
    std::array<Vector3f, 3> normals = other.normal[i];
    for (Vector3f& n : normals)
      if (!n.isZero()) n = (turn * n).normalized();
    if (mirrors) {
      std::swap(t[1], t[2]);
      std::swap(corners[1], corners[2]);
      std::swap(normals[1], normals[2]);
    }
    mesh.triangles.push_back(t);
    uv.push_back(corners);
    normal.push_back(normals);
    material.push_back(other.material[i] + first_material);
  }
  materials.insert(materials.end(), other.materials.begin(), other.materials.end());
}

TriangleMesh solidMesh(const SurfaceMesh& surface) {
  TriangleMesh solid;
  solid.vertices = surface.mesh.vertices;
  for (size_t i = 0; i < surface.mesh.triangles.size(); ++i)
    if (surface.materials[size_t(surface.material[i])].opacity >= kSolidOpacity)
      solid.triangles.push_back(surface.mesh.triangles[i]);
  return solid;
}

}  // namespace vdbc
