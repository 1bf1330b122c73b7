#pragma once
// Private to assets: surfaces of OBJ files.
#include <tiny_obj_loader.h>

#include <Eigen/Geometry>
#include <array>
#include <string>
#include <vector>

#include "examples/rooms/catalogue.h"

namespace vdbc {

/// What mesh() hands out: the surface, and what was mended and found wrong on the way.
struct ReadMesh : SurfaceMesh {
  std::string note, fault;
};

void addNote(std::string* note, const std::string& text);

/// An OBJ file; what tinyobj's callbacks fill. Its own triangulation folds concave polygons over
/// (Debian's 2.0 rc10), so that polygons are cut up here.
struct ObjFile {
  /// Corner of a face: indices into the file's arrays; -1: has none.
  struct Corner {
    int vertex = -1, uv = -1, normal = -1;
  };
  /// What Sweet Home 3D's names of groups say of a surface whatever its material.
  enum class Finish { kOwn, kPane, kMirror };
  static constexpr int kNoMaterial = -1,
                       kUnknownMaterial = -2;  // a face of no material, of an undefined one
  struct Face {
    std::array<Corner, 3> corner;
    int material = kNoMaterial;
    Finish finish = Finish::kOwn;
  };

  std::vector<Eigen::Vector3f> vertices, normals;
  std::vector<Eigen::Vector2f> uv;
  std::vector<tinyobj::material_t> materials;
  std::vector<Face> faces;
  size_t lines = 0;     // faces of two corners
  std::string problem;  // callbacks can't throw through tinyobj

  int material = kNoMaterial;  // of the faces that follow
  Finish finish = Finish::kOwn;
};

/// Throws Error.
ObjFile readObj(const CatalogueZip& zip, const std::string& entry);
/// Drops what has no area.
void dropDegenerate(ObjFile* obj, const std::string& where, std::string* note);
/// Model frame from OBJ space: turned, stretched to the catalogue's size, set on the floor.
Eigen::Affine3d modelFromObj(const ObjFile& obj, const Eigen::Matrix3d& rotation,
                             const Eigen::Vector3f& size_m, const std::string& where,
                             std::string* fault);
void fillGeometry(const ObjFile& obj, const Eigen::Affine3d& to_model, ReadMesh* out);

}  // namespace vdbc
