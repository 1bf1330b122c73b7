#include "vdb/continuation.h"

#include <tbb/parallel_for.h>

#include <Eigen/Dense>
#include <array>
#include <cmath>

#include "vdb/token_map.h"

namespace vdbc {
namespace {

using Eigen::Vector3f;
using Leaf = FloatTree::LeafNodeType;
using Values = openvdb::tree::ValueAccessor<const FloatTree, false>;

const std::array<Coord, 6> kBeside = {Coord(-1, 0, 0), Coord(1, 0, 0),  Coord(0, -1, 0),
                                      Coord(0, 1, 0),  Coord(0, 0, -1), Coord(0, 0, 1)};
constexpr int kLeastSamples = 12;

// The plane by which a voxel goes on.
struct Plane {
  float distance = 0;                  // of the voxel's centre, in voxels
  Vector3f normal = Vector3f::Zero();  // 0: the surface ends here
};

bool isBorder(Values* measured, const Coord& ijk) {
  for (const Coord& step : kBeside)
    if (!measured->isValueOn(ijk + step)) return true;
  return false;
}

// The direction in which the measured distance grows around a voxel; 0 where that is not clear.
Vector3f fittedNormal(Values* measured, const Coord& ijk, int half_width) {
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
  if (samples < kLeastSamples) return Vector3f::Zero();
  squares.diagonal().head<3>().array() += 1e-3f * float(samples);
  const Vector3f slope = squares.ldlt().solve(products).head<3>();
  const float length = slope.norm();
  return length > 0 && std::isfinite(length) ? Vector3f(slope / length) : Vector3f::Zero();
}

// The voxels at the border of what was measured, near the surface, in the tree's order.
TokenMap<Plane> bordersOf(const FloatTree& measured, float voxel, int plane_voxels) {
  std::vector<const Leaf*> leaves;
  measured.getNodes(leaves);
  std::vector<std::vector<std::pair<Coord, Plane>>> found(leaves.size());
  const float near = measured.background() - voxel;
  tbb::parallel_for(size_t(0), leaves.size(), [&](size_t i) {
    Values values(measured);
    for (auto value = leaves[i]->cbeginValueOn(); value; ++value) {
      const Coord ijk = value.getCoord();
      if (std::abs(*value) > near || !isBorder(&values, ijk)) continue;
      found[i].push_back({ijk, {*value / voxel, fittedNormal(&values, ijk, plane_voxels)}});
    }
  });
  TokenMap<Plane> planes;
  for (const auto& some : found)
    for (const auto& [ijk, plane] : some) planes.insert(ijk, plane);
  return planes;
}

Plane meanPlane(const TokenMap<Plane>& planes, const Coord& ijk, float half_width) {
  Plane mean;
  int n = 0;
  for (const Coord& step : kBeside) {
    const Plane* from = planes.find(ijk + step);
    if (!from || from->normal.isZero()) continue;
    mean.distance += from->distance -
                     from->normal.dot(Vector3f(float(step.x()), float(step.y()), float(step.z())));
    mean.normal += from->normal;
    ++n;
  }
  mean.distance /= float(n);
  if (std::abs(mean.distance) < half_width && !mean.normal.isZero())
    mean.normal.normalize();
  else
    mean.normal.setZero();
  return mean;
}

// The voxels beside the planes from row `begin` on that are neither measured nor among them.
TokenMap<Plane> nextLayer(const FloatTree& measured, const TokenMap<Plane>& planes, size_t begin,
                          float half_width) {
  const Values known(measured);
  TokenMap<size_t> beside;
  for (size_t i = begin; i < planes.size(); ++i) {
    if (planes.values()[i].normal.isZero()) continue;
    for (const Coord& step : kBeside) {
      const Coord ijk = planes.tokens()[i] + step;
      if (!known.isValueOn(ijk) && !planes.find(ijk)) beside.insert(ijk, beside.size());
    }
  }
  std::vector<Plane> carried(beside.size());
  tbb::parallel_for(size_t(0), carried.size(), [&](size_t i) {
    carried[i] = meanPlane(planes, beside.tokens()[i], half_width);
  });
  return {beside.tokens(), std::move(carried)};
}

}  // namespace

std::vector<ContinuedVoxel> continueDistance(const FloatTree& measured, float voxel,
                                             int plane_voxels, float reach) {
  std::vector<ContinuedVoxel> continued;
  const float half_width = measured.background() / voxel;
  TokenMap<Plane> planes = bordersOf(measured, voxel, plane_voxels);
  size_t begin = 0;
  for (int layer = 1; float(layer) * voxel < reach; ++layer) {
    const TokenMap<Plane> next = nextLayer(measured, planes, begin, half_width);
    begin = planes.size();
    for (size_t i = 0; i < next.size(); ++i) {
      const Plane& p = next.values()[i];
      planes.insert(next.tokens()[i], p);
      if (!p.normal.isZero())
        continued.push_back({next.tokens()[i], p.distance * voxel, p.normal, float(layer) * voxel});
    }
  }
  return continued;
}

}  // namespace vdbc
