#include "splat/detail_grids.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>

#include "splat/image.h"
#include "vdb/fuse.h"
#include "vdb/token_map.h"

namespace vdbc {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector3f;
using ColourLeaf = Vec3STree::LeafNodeType;
using Leaf = FloatTree::LeafNodeType;

constexpr float kReachSigmas = 3;
constexpr float kBlurAlong = .5f, kBlurAcross = 1.5f;  // detail voxels, standard deviations
constexpr float kShareSteps = 8;                       // of a density of 1
// Round values make small files. Those of colour are as fine as a display shows, in few bits.
constexpr float kColourSteps = 128;
// Further off the surface than that no sample at it looks, for which eight voxels are asked.
constexpr float kColourReach = 2;        // detail voxels
constexpr float kSameColour = 1 / 16.f;  // of display values: one for all voxels of a leaf

float roundedColour(float c) {
  int exponent = 0;
  const float display = std::round(srgbFromLinear(c) * kColourSteps) / kColourSteps;
  const float mantissa = std::frexp(linearFromSrgb(display), &exponent);
  return std::ldexp(std::round(mantissa * kColourSteps) / kColourSteps, exponent);
}
openvdb::Vec3f storedColour(const Vector3f& c) {
  return {roundedColour(c[0]), roundedColour(c[1]), roundedColour(c[2])};
}

// A Gaussian as it colours what is around.
struct Sample {
  Vector3f mean, colour, reach;  // metres, grid axes; display sRGB; half of its box
  Matrix3f precision;
  float weight;
};

// A thin disc colours the voxels at both of its sides, and is not blurred along itself by more than
// voxels do anyhow.
Sample sampleOf(const Gaussians& g, size_t i, const VoxelFrame& frame, float voxel_m) {
  Sample s;
  const Eigen::Isometry3d grid = frame.world_from_grid.inverse();
  s.mean = (grid * (g.origin + g.mean[i].cast<double>())).cast<float>();
  const Eigen::Vector4f& q = g.rotation[i];
  const Matrix3f axes = grid.linear().cast<float>() *
                        Eigen::Quaternionf(q[0], q[1], q[2], q[3]).normalized().toRotationMatrix();
  Eigen::Index thin = 0;
  g.log_scale[i].minCoeff(&thin);
  Vector3f variance = (2 * g.log_scale[i].array()).exp() + std::pow(kBlurAlong * voxel_m, 2.f);
  const float area = std::sqrt(variance.prod() / variance[thin]);
  variance[thin] += std::pow(kBlurAcross * voxel_m, 2.f);
  s.precision = axes * variance.cwiseInverse().asDiagonal() * axes.transpose();
  const Matrix3f covariance = axes * variance.asDiagonal() * axes.transpose();
  s.reach = kReachSigmas * covariance.diagonal().cwiseSqrt();
  const float* sh = &g.sh[i * size_t(g.shCoefficients()) * 3];
  for (int c = 0; c < 3; ++c) s.colour[c] = std::clamp(.5f + kSh0 * sh[c], 0.f, 1.f);
  // A fine disc says more of the place where it lies than what is wide does.
  s.weight = 1 / (1 + std::exp(-g.opacity_logit[i])) / area;
  return s;
}

// Rows of the samples whose boxes touch each leaf, ascending.
std::vector<std::vector<uint32_t>> samplesOf(const std::vector<const Leaf*>& leaves,
                                             const std::vector<Sample>& samples, float voxel_m) {
  TokenMap<size_t> index;
  const auto place = [](const Coord& c) { return c >> Leaf::LOG2DIM; };
  CoordBBox all;
  for (size_t i = 0; i < leaves.size(); ++i) {
    index.insert(place(leaves[i]->origin()), i);
    all.expand(place(leaves[i]->origin()));
  }
  std::vector<std::vector<uint32_t>> rows(leaves.size());
  const float leaf_m = voxel_m * float(Leaf::DIM);
  for (size_t row = 0; row < samples.size(); ++row) {
    const Sample& s = samples[row];
    const auto corner = [&](float sign) {
      Coord c;
      for (int axis = 0; axis < 3; ++axis)
        c[axis] = int(std::clamp(std::floor((s.mean[axis] + sign * s.reach[axis]) / leaf_m),
                                 float(all.min()[axis] - 1), float(all.max()[axis] + 1)));
      return c;
    };
    for (const Coord& leaf : CoordBBox(corner(-1), corner(1)))
      if (const size_t* found = index.find(leaf)) rows[*found].push_back(uint32_t(row));
  }
  return rows;
}

// The voxels' own colours, for where no Gaussian is near.
class VoxelColours {
 public:
  explicit VoxelColours(const SceneVoxels& v) : voxels_(v) {
    for (size_t i = 0; i < v.ijk.size(); ++i) rows_.insert(v.ijk[i], i);
  }
  // Scene-linear, at a place in voxels.
  Vector3f at(const Vector3f& p) const {
    Vector3f sum = Vector3f::Zero();
    float mass = 0;
    const Vector3f low = p.array().floor();
    const Coord middle(int(low.x()), int(low.y()), int(low.z()));
    for (const Coord& ijk : CoordBBox(middle.offsetBy(-kReach), middle.offsetBy(kReach))) {
      const size_t* row = rows_.find(ijk);
      if (!row) continue;
      const Vector3f centre(float(ijk.x()) + .5f, float(ijk.y()) + .5f, float(ijk.z()) + .5f);
      const float weight = 1 / (.01f + std::pow((centre - p).squaredNorm(), 2.f));
      sum += weight * voxels_.colour_linear[*row], mass += weight;
    }
    return sum / std::max(mass, 1e-30f);
  }

 private:
  static constexpr int kReach = 2;
  const SceneVoxels& voxels_;
  TokenMap<size_t> rows_;
};

// Deep inside, where the surface has no leaves.
std::vector<CoordBBox> insideTiles(const FloatGrid& surface) {
  std::vector<CoordBBox> boxes;
  for (auto value = surface.cbeginValueAll(); value; ++value)
    if (!value.isVoxelValue() && *value < 0) {
      boxes.emplace_back();
      value.getBoundingBox(boxes.back());
    }
  return boxes;
}

// How much of each voxel lies behind the surface, as if that were flat there.
FloatGrid::Ptr shareBehind(const FloatGrid& surface) {
  const auto edge = float(surface.voxelSize()[0]);
  auto grid = FloatGrid::create(0);
  grid->setTransform(surface.transformPtr()->copy());
  FloatTree& tree = grid->tree();
  for (const CoordBBox& box : insideTiles(surface)) tree.sparseFill(box, 1.f, true);
  for (auto leaf = surface.constTree().cbeginLeaf(); leaf; ++leaf) {
    auto* to = new Leaf(leaf->origin(), 0.f, false);
    for (openvdb::Index n = 0; n < Leaf::SIZE; ++n) {
      const float share = std::clamp(.5f - leaf->getValue(n) / edge, 0.f, 1.f);
      const float rounded = std::round(share * kShareSteps) / kShareSteps;
      if (rounded > 0) to->setValueOn(n, rounded);
    }
    if (to->isEmpty())
      delete to;
    else
      tree.addLeaf(to);
  }
  tree.prune();
  grid->setGridClass(openvdb::GRID_FOG_VOLUME);
  return grid;
}

// Display sRGB at a point, of the samples in `rows`; false where none is near.
bool sampledColour(const Vector3f& p, const std::vector<uint32_t>& rows,
                   const std::vector<Sample>& samples, Vector3f* colour) {
  Vector3f sum = Vector3f::Zero();
  float mass = 0;
  for (uint32_t row : rows) {
    const Sample& s = samples[row];
    const Vector3f d = p - s.mean;
    const float d2 = d.dot(s.precision * d) / (kReachSigmas * kReachSigmas);
    if (d2 >= 1) continue;
    const float bell = (1 - d2) * (1 - d2), weight = s.weight * bell * bell;
    sum += weight * s.colour, mass += weight;
  }
  *colour = sum / std::max(mass, 1e-30f);
  return mass > 0;
}

struct ColourSettings {
  float edge_m;  // of the detail voxels
  int parts;     // of a voxel's edge
  bool is_measured;
};

// Where nothing was measured, and deep inside, all detail voxels of a voxel have its colour: there
// is no more to say, and files stay small.
ColourLeaf* colourLeaf(const Leaf& surface, const std::vector<uint32_t>& rows,
                       const std::vector<Sample>& samples, const VoxelColours& voxels,
                       const ColourSettings& s) {
  auto* leaf = new ColourLeaf(surface.origin(), openvdb::Vec3f(0), false);
  const auto parts = float(s.parts);
  const float reach = kColourReach * s.edge_m;
  for (openvdb::Index n = 0; n < Leaf::SIZE; ++n) {
    const float distance = surface.getValue(n);
    if (distance > reach) continue;
    const Coord ijk = surface.offsetToGlobalCoord(n);
    Vector3f p(float(ijk.x()) + .5f, float(ijk.y()) + .5f, float(ijk.z()) + .5f);
    if (!s.is_measured || distance < -reach) p = ((p / parts).array().floor() + .5f) * parts;
    Vector3f colour;
    if (sampledColour(s.edge_m * p, rows, samples, &colour))
      for (int c = 0; c < 3; ++c) colour[c] = linearFromSrgb(colour[c]);
    else
      colour = voxels.at(p / parts);
    leaf->setValueOn(n, storedColour(colour));
  }
  return leaf;
}

// Whether nobody would tell the leaf's colours from the one in their middle.
bool isOneColour(const ColourLeaf& leaf, openvdb::Vec3f* colour) {
  Vector3f low = Vector3f::Constant(1e9f), high = -low;
  for (auto value = leaf.cbeginValueOn(); value; ++value)
    for (int c = 0; c < 3; ++c) {
      const float display = srgbFromLinear((*value)[c]);
      low[c] = std::min(low[c], display), high[c] = std::max(high[c], display);
    }
  if (!((high - low).maxCoeff() < kSameColour)) return false;
  Vector3f middle = (low + high) / 2;
  for (int c = 0; c < 3; ++c) middle[c] = linearFromSrgb(middle[c]);
  *colour = storedColour(middle);
  return true;
}

Vec3SGrid::Ptr colourAround(const FloatGrid& surface, const SceneVoxels& voxels,
                            const Gaussians& gaussians) {
  const auto edge = float(surface.voxelSize()[0]);
  const int parts = detailPartsOf(voxels.frame, surface);
  std::vector<Sample> samples(size_t(gaussians.size()));
  tbb::parallel_for(size_t(0), samples.size(),
                    [&](size_t i) { samples[i] = sampleOf(gaussians, i, voxels.frame, edge); });
  std::vector<const Leaf*> leaves;
  surface.constTree().getNodes(leaves);
  const auto rows = samplesOf(leaves, samples, edge);
  const VoxelColours own(voxels);
  const FloatTree& measured = voxels.seen_distance->constTree();
  const auto isMeasured = [&](const Coord& origin) {
    return measured.probeConstLeaf(origin) != nullptr;
  };
  std::vector<ColourLeaf*> coloured(leaves.size(), nullptr);
  tbb::parallel_for(size_t(0), leaves.size(), [&](size_t i) {
    coloured[i] = colourLeaf(*leaves[i], rows[i], samples, own,
                             {edge, parts, isMeasured(leaves[i]->origin())});
  });
  auto grid = Vec3SGrid::create(openvdb::Vec3f(0));
  grid->setTransform(surface.transformPtr()->copy());
  Vec3STree& tree = grid->tree();
  for (ColourLeaf* leaf : coloured) {
    openvdb::Vec3f colour;
    const bool is_tile = !isMeasured(leaf->origin()) && isOneColour(*leaf, &colour);
    if (is_tile) tree.addTile(1, leaf->origin(), colour, true);
    if (is_tile || leaf->isEmpty())
      delete leaf;
    else
      tree.addLeaf(leaf);
  }
  tree.prune();
  for (const CoordBBox& box : insideTiles(surface)) {
    const openvdb::Vec3d middle = (box.getCenter() + openvdb::Vec3d(.5)) / parts;
    const Vector3f place(float(middle.x()), float(middle.y()), float(middle.z()));
    tree.sparseFill(box, storedColour(own.at(place)), true);
  }
  grid->setVectorType(openvdb::VEC_INVARIANT);
  return grid;
}

}  // namespace

DetailGrids detailGrids(const SceneVoxels& voxels, const Gaussians& gaussians) {
  if (!voxels.seen_distance) return {};
  DetailGrids grids;
  grids.surface = closedSurface(voxels.frame, solidVoxels(voxels), *voxels.seen_distance);
  grids.density = shareBehind(*grids.surface);
  grids.colour = colourAround(*grids.surface, voxels, gaussians);
  return grids;
}

}  // namespace vdbc
