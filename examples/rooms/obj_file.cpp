#include "examples/rooms/obj_file.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <sstream>

#include "examples/rooms/obj_materials.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;
using Corner = ObjFile::Corner;
using Face = ObjFile::Face;

constexpr size_t kMaxReadTriangles = 4000000;
constexpr size_t kMaxPolygonCorners = 1024;
constexpr double kMaxStretch = 3;  // a model is stretched unequally to its size by at most this

/// 0-based index from an OBJ's, which counts from 1, or back from the end; -1: has none; -2: wrong.
int fromObjIndex(int index, size_t count) {
  if (index == 0) return -1;
  if (index > 0) return size_t(index) <= count ? index - 1 : -2;
  return int64_t(count) + index >= 0 ? int(int64_t(count) + index) : -2;
}

/// Corners of a polygon in its plane.
std::vector<Vector2d> flattened(const ObjFile& obj, const std::vector<Corner>& polygon) {
  Vector3d normal = Vector3d::Zero();
  const Vector3d origin = obj.vertices[size_t(polygon[0].vertex)].cast<double>();
  std::vector<Vector3d> points;
  for (const Corner& c : polygon)
    points.push_back(obj.vertices[size_t(c.vertex)].cast<double>() - origin);
  for (size_t i = 0; i < points.size(); ++i)
    normal += points[i].cross(points[(i + 1) % points.size()]);
  const Vector3d u = normal.unitOrthogonal(), v = normal.normalized().cross(u);
  std::vector<Vector2d> flat;
  for (const Vector3d& p : points) flat.emplace_back(u.dot(p), v.dot(p));
  return flat;
}

double turnOf(const Vector2d& a, const Vector2d& b, const Vector2d& c) {
  return (b - a).x() * (c - a).y() - (b - a).y() * (c - a).x();
}

/// Whether the corner after `before` can be cut off: it bulges, and no other corner is in the way.
/// Holes hang on bridges, whose ends are there twice: corners at the triangle's own do not count.
bool isEar(const std::vector<Vector2d>& p, const std::vector<size_t>& left, size_t at) {
  const size_t n = left.size();
  const Vector2d &a = p[left[(at + n - 1) % n]], &b = p[left[at]], &c = p[left[(at + 1) % n]];
  if (turnOf(a, b, c) <= 0) return false;
  return std::none_of(left.begin(), left.end(), [&](size_t i) {
    const Vector2d& q = p[i];
    return q != a && q != b && q != c && turnOf(a, b, q) >= 0 && turnOf(b, c, q) >= 0 &&
           turnOf(c, a, q) >= 0;
  });
}

/// Triangles of a polygon, as places in it: ear clipping; of a quad's two cuts the shorter.
std::vector<std::array<size_t, 3>> triangulated(const ObjFile& obj,
                                                const std::vector<Corner>& polygon) {
  if (polygon.size() == 3) return {{0, 1, 2}};
  const std::vector<Vector2d> p = flattened(obj, polygon);
  std::vector<size_t> left(polygon.size());
  std::iota(left.begin(), left.end(), size_t(0));
  std::vector<std::array<size_t, 3>> triangles;
  while (left.size() > 3) {
    const size_t n = left.size();
    size_t best = n;
    double best_cut = 0;
    for (size_t i = 0; i < n && (best == n || n == 4); ++i) {
      if (!isEar(p, left, i)) continue;
      const double cut = (p[left[(i + 1) % n]] - p[left[(i + n - 1) % n]]).squaredNorm();
      if (best == n || cut < best_cut) best = i, best_cut = cut;
    }
    if (best == n) best = 0;  // a polygon that crosses itself: any cut is as good
    triangles.push_back({left[(best + n - 1) % n], left[best], left[(best + 1) % n]});
    left.erase(left.begin() + std::ptrdiff_t(best));
  }
  triangles.push_back({left[0], left[1], left[2]});
  return triangles;
}

void addFace(ObjFile* obj, const tinyobj::index_t* indices, int count) {
  if (count < 3) {
    ++obj->lines;
    return;
  }
  if (size_t(count) > kMaxPolygonCorners) {
    obj->problem = joinText("polygon of more than ", kMaxPolygonCorners, " corners");
    return;
  }
  std::vector<Corner> polygon;
  for (int k = 0; k < count; ++k) {
    const Corner c{fromObjIndex(indices[k].vertex_index, obj->vertices.size()),
                   fromObjIndex(indices[k].texcoord_index, obj->uv.size()),
                   fromObjIndex(indices[k].normal_index, obj->normals.size())};
    if (c.vertex < 0 || c.uv < -1 || c.normal < -1) {
      obj->problem = "index out of range";
      return;
    }
    polygon.push_back(c);
  }
  for (const auto& t : triangulated(*obj, polygon)) {
    if (obj->faces.size() > kMaxReadTriangles) {
      obj->problem = joinText("more than ", kMaxReadTriangles, " triangles");
      return;
    }
    obj->faces.push_back(
        {{polygon[t[0]], polygon[t[1]], polygon[t[2]]}, obj->material, obj->finish});
  }
}

Vector3d vertexOf(const ObjFile& obj, const Corner& corner) {
  return obj.vertices[size_t(corner.vertex)].cast<double>();
}

bool isDegenerate(const ObjFile& obj, const Face& face) {
  std::array<Vector3d, 3> p;
  for (size_t k = 0; k < 3; ++k) p[k] = vertexOf(obj, face.corner[k]);
  const double longest = std::max(
      {(p[1] - p[0]).squaredNorm(), (p[2] - p[1]).squaredNorm(), (p[0] - p[2]).squaredNorm()});
  return (p[1] - p[0]).cross(p[2] - p[0]).norm() <= 1e-7 * longest;
}

/// Ratio of the largest to the smallest factor that turns one size into another, flat axes aside.
double stretch(const Vector3d& from, const Vector3d& to) {
  double least = 0, most = 0;
  for (int a = 0; a < 3; ++a) {
    if (from[a] <= 1e-6 * from.maxCoeff()) continue;
    const double factor = to[a] / from[a];
    least = least > 0 ? std::min(least, factor) : factor;
    most = std::max(most, factor);
  }
  return least > 0 ? most / least : 1;
}

/// Corner normals in the model frame, on the side the triangle faces; zero (all) where one lacks.
std::array<Vector3f, 3> cornerNormals(const ObjFile& obj, const Face& face, const Matrix3d& turn,
                                      const Vector3d& face_normal) {
  const std::array<Vector3f, 3> none = {Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()};
  std::array<Vector3f, 3> normals;
  for (size_t k = 0; k < 3; ++k) {
    const int index = face.corner[k].normal;
    if (index < 0) return none;
    Vector3d n = turn * obj.normals[size_t(index)].cast<double>();
    const double length = n.norm();
    if (!std::isfinite(length) || length < 1e-12) return none;
    if (n.dot(face_normal) < 0) n = -n;
    normals[k] = (n / length).cast<float>();
  }
  return normals;
}

}  // namespace

void addNote(std::string* note, const std::string& text) {
  *note += (note->empty() ? "" : "; ") + text;
}

ObjFile readObj(const CatalogueZip& zip, const std::string& entry) {
  std::string text = zip.read(entry);
  if (text.find("mtllib") == std::string::npos) text = "mtllib named\n" + text;
  std::istringstream in(text);
  tinyobj::callback_t callbacks;
  callbacks.vertex_cb = [](void* data, float x, float y, float z, float) {
    static_cast<ObjFile*>(data)->vertices.emplace_back(x, y, z);
  };
  callbacks.normal_cb = [](void* data, float x, float y, float z) {
    static_cast<ObjFile*>(data)->normals.emplace_back(x, y, z);
  };
  callbacks.texcoord_cb = [](void* data, float x, float y, float) {
    static_cast<ObjFile*>(data)->uv.emplace_back(x, y);
  };
  callbacks.index_cb = [](void* data, tinyobj::index_t* indices, int count) {
    auto* obj = static_cast<ObjFile*>(data);
    if (obj->problem.empty()) addFace(obj, indices, count);
  };
  callbacks.usemtl_cb = [](void* data, const char*, int material) {
    static_cast<ObjFile*>(data)->material = material >= 0 ? material : ObjFile::kUnknownMaterial;
  };
  callbacks.mtllib_cb = [](void* data, const tinyobj::material_t* materials, int count) {
    static_cast<ObjFile*>(data)->materials.assign(materials, materials + count);
  };
  callbacks.group_cb = [](void* data, const char** names, int count) {
    const std::string name = count > 0 ? names[0] : "";
    const bool is_pane = name.compare(0, 23, "sweethome3d_window_pane") == 0,
               is_mirror = name.compare(0, 25, "sweethome3d_window_mirror") == 0;
    static_cast<ObjFile*>(data)->finish = is_pane     ? ObjFile::Finish::kPane
                                          : is_mirror ? ObjFile::Finish::kMirror
                                                      : ObjFile::Finish::kOwn;
  };
  ObjFile obj;
  CatalogueMaterials reader(zip, entry);
  std::string warnings, error;
  const bool ok = tinyobj::LoadObjWithCallback(in, callbacks, &obj, &reader, &warnings, &error);
  require(ok, "readModel: ", zip.path(), ": ", entry, ": ", trimmed(error));
  require(obj.problem.empty(), "readModel: ", zip.path(), ": ", entry, ": ", obj.problem);
  for (const Vector3f& v : obj.vertices)
    require(v.allFinite(), "readModel: ", zip.path(), ": ", entry,
            ": expected finite vertices, found ", v.transpose());
  return obj;
}

void dropDegenerate(ObjFile* obj, const std::string& where, std::string* note) {
  const size_t all = obj->faces.size();
  const auto kept = std::remove_if(obj->faces.begin(), obj->faces.end(),
                                   [&](const Face& face) { return isDegenerate(*obj, face); });
  obj->faces.erase(kept, obj->faces.end());
  if (obj->lines > 0) addNote(note, joinText(obj->lines, " faces of two corners dropped"));
  if (obj->faces.size() < all)
    addNote(note, joinText(all - obj->faces.size(), " degenerate triangles dropped"));
  require(!obj->faces.empty(), "readModel: ", where, ": no triangles");
}

Eigen::Affine3d modelFromObj(const ObjFile& obj, const Matrix3d& rotation, const Vector3f& size_m,
                             const std::string& where, std::string* fault) {
  Matrix3d axes;
  axes << -1, 0, 0, 0, 0, 1, 0, 1, 0;
  const Matrix3d turn = axes * rotation;
  Eigen::AlignedBox3d box;
  for (const Face& face : obj.faces)
    for (const Corner& corner : face.corner) box.extend(turn * vertexOf(obj, corner));
  const Vector3d found = box.sizes(), wanted = size_m.cast<double>();
  Vector3d scale = Vector3d::Ones();
  int sides = 0;
  for (int a = 0; a < 3; ++a)
    if (found[a] > 1e-6 * found.maxCoeff()) scale[a] = wanted[a] / found[a], ++sides;
  require(sides >= 2 && scale.allFinite(), "readModel: ", where, ": a line without width");
  const double as_is = stretch(found, wanted),
               turned = stretch(found, {wanted.y(), wanted.x(), wanted.z()});
  if (as_is > 1.5 && turned < 1.1)
    *fault = "rotation and size do not agree";
  else if (as_is > kMaxStretch)
    *fault = joinText("stretched ", std::round(as_is * 10) / 10, " to 1");
  Eigen::Affine3d to_model = Eigen::Affine3d::Identity();
  to_model.linear() = scale.asDiagonal() * turn;
  const Vector3d foot(box.center().x(), box.center().y(), box.min().z());
  to_model.translation() = -(scale.asDiagonal() * foot);
  return to_model;
}

void fillGeometry(const ObjFile& obj, const Eigen::Affine3d& to_model, ReadMesh* out) {
  const Matrix3d turn = to_model.linear().inverse().transpose();
  std::vector<int> vertex(obj.vertices.size(), -1);
  for (const Face& face : obj.faces) {
    Eigen::Vector3i triangle;
    std::array<Vector3d, 3> p;
    std::array<Vector2f, 3> uv;
    uv.fill(Vector2f::Zero());
    for (size_t k = 0; k < 3; ++k) {
      const Corner& corner = face.corner[k];
      p[k] = to_model * vertexOf(obj, corner);
      int& index = vertex[size_t(corner.vertex)];
      if (index < 0) {
        index = int(out->mesh.vertices.size());
        out->mesh.vertices.push_back(p[k].cast<float>());
      }
      triangle[int(k)] = index;
      if (corner.uv >= 0 && obj.uv[size_t(corner.uv)].allFinite())
        uv[k] = obj.uv[size_t(corner.uv)];
    }
    out->mesh.triangles.push_back(triangle);
    out->uv.push_back(uv);
    out->normal.push_back(cornerNormals(obj, face, turn, (p[1] - p[0]).cross(p[2] - p[0])));
  }
}

}  // namespace vdbc
