#include "vdb/continuation.h"

#include <tbb/parallel_for.h>

#include <Eigen/Dense>
#include <array>
#include <cmath>
#include <limits>

#include "vdb/token_map.h"

namespace vdbc {
namespace {

using Eigen::Vector3f;
using Leaf = FloatTree::LeafNodeType;
using FloatValues = openvdb::tree::ValueAccessor<const FloatTree, false>;

const std::array<Coord, 6> kBeside = {Coord(-1, 0, 0), Coord(1, 0, 0),  Coord(0, -1, 0),
                                      Coord(0, 1, 0),  Coord(0, 0, -1), Coord(0, 0, 1)};
// A plane is one where so much of the cube was measured, and distances grow as distances do.
constexpr float kLeastShare = .2f, kLeastSlope = .6f, kMostSlope = 1.4f;

// The plane by which a voxel goes on.
struct Plane {
  float distance = 0;                  // of the voxel's centre, in voxels
  Vector3f normal = Vector3f::Zero();  // 0: the surface ends here
  float reach = 0;                     // voxels from the border, along the surface

  bool ends() const { return normal.isZero(); }
};

bool isBorder(FloatValues* measured, const Coord& ijk) {
  for (const Coord& step : kBeside)
    if (!measured->isValueOn(ijk + step)) return true;
  return false;
}

// The direction in which the measured distance grows around a voxel; 0 where that is not clear.
Vector3f fittedNormal(FloatValues* measured, const Coord& ijk, int half_width, float voxel) {
  Eigen::Matrix4f squares = Eigen::Matrix4f::Zero();
  Eigen::Vector4f products = Eigen::Vector4f::Zero();
  const float cut_off = .99f * measured->tree().background();
  int samples = 0;
  for (const Coord& c : CoordBBox(ijk.offsetBy(-half_width), ijk.offsetBy(half_width))) {
    float value = 0;
    if (!measured->probeValue(c, value) || std::abs(value) > cut_off) continue;
    const Coord d = c - ijk;
    const Eigen::Vector4f row(float(d.x()), float(d.y()), float(d.z()), 1);
    squares += row * row.transpose(), products += value * row;
    ++samples;
  }
  if (float(samples) < kLeastShare * std::pow(float(2 * half_width + 1), 3.f))
    return Vector3f::Zero();
  squares.diagonal().head<3>().array() += 1e-3f * float(samples);
  const Vector3f slope = squares.ldlt().solve(products).head<3>() / voxel;
  const float length = slope.norm();
  return length > kLeastSlope && length < kMostSlope ? Vector3f(slope / length) : Vector3f::Zero();
}

// By voxel; rows stay as voxels are added.
class Planes {
 public:
  size_t size() const { return planes_.size(); }
  const Coord& ijk(size_t row) const { return rows_.tokens()[row]; }
  Plane& operator[](size_t row) { return planes_[row]; }
  void add(const Coord& ijk, const Plane& plane) {
    if (rows_.insert(ijk, planes_.size())) planes_.push_back(plane);
  }
  const Plane* find(const Coord& ijk) const {
    const size_t* row = rows_.find(ijk);
    return row ? &planes_[*row] : nullptr;
  }

 private:
  TokenMap<size_t> rows_;
  std::vector<Plane> planes_;
};

// The voxels at the border of what was measured, near the surface, in the tree's order.
Planes bordersOf(const FloatTree& measured, float voxel, int plane_voxels) {
  std::vector<const Leaf*> leaves;
  measured.getNodes(leaves);
  std::vector<std::vector<std::pair<Coord, Plane>>> found(leaves.size());
  const float near = measured.background() - voxel;
  tbb::parallel_for(size_t(0), leaves.size(), [&](size_t i) {
    FloatValues values(measured);
    for (auto value = leaves[i]->cbeginValueOn(); value; ++value) {
      const Coord ijk = value.getCoord();
      if (std::abs(*value) > near || !isBorder(&values, ijk)) continue;
      found[i].push_back(
          {ijk, {*value / voxel, fittedNormal(&values, ijk, plane_voxels, voxel), 0}});
    }
  });
  Planes planes;
  for (const auto& some : found)
    for (const auto& [ijk, plane] : some) planes.add(ijk, plane);
  return planes;
}

// Of the planes beside a voxel that go on.
Plane meanPlane(const Planes& planes, const Coord& ijk) {
  Plane mean;
  mean.reach = std::numeric_limits<float>::max();
  int n = 0;
  for (const Coord& step : kBeside) {
    const Plane* from = planes.find(ijk + step);
    if (!from || from->ends()) continue;
    const float rise =
        -from->normal.dot(Vector3f(float(step.x()), float(step.y()), float(step.z())));
    mean.distance += from->distance + rise;
    mean.normal += from->normal;
    mean.reach = std::min(mean.reach, from->reach + std::sqrt(std::max(0.f, 1 - rise * rise)));
    ++n;
  }
  mean.distance /= float(n);
  if (!mean.ends()) mean.normal.normalize();
  return mean;
}

// Adds the voxels beside those from row `begin` on that are neither measured nor there yet.
void addLayer(const FloatTree& measured, size_t begin, Planes* planes) {
  FloatValues known(measured);
  const size_t end = planes->size();
  for (size_t i = begin; i < end; ++i) {
    if ((*planes)[i].ends()) continue;
    for (const Coord& step : kBeside) {
      const Coord ijk = planes->ijk(i) + step;
      if (!known.isValueOn(ijk)) planes->add(ijk, {});
    }
  }
  std::vector<Plane> carried(planes->size() - end);
  tbb::parallel_for(size_t(0), carried.size(),
                    [&](size_t i) { carried[i] = meanPlane(*planes, planes->ijk(end + i)); });
  for (size_t i = 0; i < carried.size(); ++i) (*planes)[end + i] = carried[i];
}

// All that is above a place of the surface is as far from the border as that.
float reachOf(const ContinuedVoxel& v, const FloatTree& measured, const Planes& planes,
              float voxel) {
  const Vector3f off = v.distance / voxel * v.normal;
  const Coord foot = v.ijk.offsetBy(-int(std::lround(off.x())), -int(std::lround(off.y())),
                                    -int(std::lround(off.z())));
  if (const Plane* plane = planes.find(foot)) return plane->reach * voxel;
  return measured.isValueOn(foot) ? 0 : v.reach;
}

}  // namespace

std::vector<ContinuedVoxel> continueDistance(const FloatTree& measured, float voxel,
                                             const ContinuationSettings& s) {
  std::vector<ContinuedVoxel> continued;
  Planes planes = bordersOf(measured, voxel, s.plane_voxels);
  for (size_t begin = 0; begin < planes.size();) {
    const size_t end = planes.size();
    addLayer(measured, begin, &planes);
    for (size_t i = begin = end; i < planes.size(); ++i) {
      const float distance = planes[i].distance * voxel, reach = planes[i].reach * voxel;
      if (distance <= -s.behind || distance >= s.before || reach >= s.reach)
        planes[i].normal.setZero();
      else if (!planes[i].ends())
        continued.push_back({planes.ijk(i), distance, planes[i].normal, reach});
    }
  }
  tbb::parallel_for(size_t(0), continued.size(), [&](size_t i) {
    continued[i].reach = reachOf(continued[i], measured, planes, voxel);
  });
  return continued;
}

}  // namespace vdbc
