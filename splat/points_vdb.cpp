#include "splat/points_vdb.h"

#include <openvdb/openvdb.h>
#include <openvdb/points/PointAttribute.h>
#include <openvdb/points/PointGroup.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <numeric>

#include "splat/gaussian_files.h"
#include "splat/image.h"
#include "vdb/error.h"
#include "vdb/file_io.h"
#include "vdb/point_leaves.h"
#include "vdb/vdb_file.h"
#include "vdb/z_order.h"

namespace vdbc {
namespace {

constexpr const char* kModeKey = "splat_render_mode";  // in a grid's metadata
constexpr int kMaxShSlots = 16;  // of GS_SPH_R in files by others: room for degree 3

using openvdb::Vec3f;
using openvdb::math::Quats;

using PositionCodec = openvdb::points::FixedPointCodec<false, openvdb::points::PositionRange>;
using UnitCodec = openvdb::points::FixedPointCodec<false, openvdb::points::UnitRange>;

constexpr std::array<const char*, 3> kShNames = {"GS_SPH_R", "GS_SPH_G", "GS_SPH_B"};
// The 16-bit fixed-point codecs divide [0, 1] (GS_Alpha) and [-.5, .5] (P, voxels) into such steps
// and round down: half a step more makes that the nearest.
constexpr float kFixedStep = 1.f / 65535;
// From here on half floats have their full 11 bits.
constexpr float kMinNormalHalf = 6.103515625e-5f;
// Index coordinates stay within +-2^19: layOutPoints() takes no more.
constexpr int kIndexBits = 20;

/// The voxel edge (metres) at which occupied voxels hold about 8 points. Sorting the points once
/// along the Z-order curve gives the number of occupied cells at every level of an octree over
/// their box: neighbours in that order share a cell down to the level where their codes part. The
/// edge is interpolated between the two levels around the wanted count.
double pointsVoxelSize(const Gaussians& g, const std::vector<int64_t>& rows) {
  constexpr int kLevels = 21;
  if (rows.empty()) return 0.1;
  Eigen::AlignedBox<double, 3> box;
  for (int64_t row : rows) box.extend(g.mean[size_t(row)].cast<double>());
  const double farthest =
      std::max(box.min().cwiseAbs().maxCoeff(), box.max().cwiseAbs().maxCoeff());
  const double extent = box.sizes().maxCoeff();
  const double smallest = std::max(farthest / double(1 << (kIndexBits - 1)), 1e-6);
  if (!(extent > 0)) return std::max(smallest, 0.01);
  std::vector<uint64_t> codes(rows.size());
  const double cells = double((1 << kLevels) - 1) / extent;
  for (size_t i = 0; i < rows.size(); ++i) {
    const Eigen::Vector3d p = (g.mean[size_t(rows[i])].cast<double>() - box.min()) * cells;
    codes[i] = zOrderCode(uint64_t(p.x()), uint64_t(p.y()), uint64_t(p.z()));
  }
  tbb::parallel_sort(codes.begin(), codes.end());
  std::array<double, kLevels + 1> occupied{};  // by level; level l has cells of extent / 2^l
  for (size_t i = 1; i < codes.size(); ++i) {
    const uint64_t differing = codes[i - 1] ^ codes[i];
    if (!differing) continue;
    const int highest = 63 - __builtin_clzll(differing);
    occupied[size_t(kLevels - highest / 3)] += 1;
  }
  occupied[0] = 1;
  std::partial_sum(occupied.begin(), occupied.end(), occupied.begin());
  const double wanted = std::max(1.0, double(rows.size()) / 8);
  int level = 0;
  while (level < kLevels && occupied[size_t(level) + 1] <= wanted) ++level;
  double fraction = 0;
  if (level < kLevels) {
    const double low = occupied[size_t(level)], high = occupied[size_t(level) + 1];
    fraction = std::log(wanted / low) / std::log(high / low);
  }
  return std::max(smallest, extent * std::exp2(-(level + fraction)));
}

float sigmoid(float logit) { return 1.f / (1.f + std::exp(-logit)); }

float logitOf(float probability) {
  // GS_Alpha has steps of 1/65535: 0 and 1 stand for what rounds to them.
  const float p = std::clamp(probability, 0.25f * kFixedStep, 1 - 0.25f * kFixedStep);
  return std::log(p / (1 - p));
}

/// To the nearest float with 16 significant bits. OpenVDB has no codec for quaternions, but its
/// compression takes bytes of equal significance together, so that last bytes of 0 cost nothing.
float rounded16(float value) {
  uint32_t bits;
  std::memcpy(&bits, &value, sizeof(bits));
  bits = (bits + 0x7f + (bits >> 8 & 1)) & ~0xffu;
  float result;
  std::memcpy(&result, &bits, sizeof(result));
  return std::isfinite(result) ? result : value;
}

Eigen::Vector3f sigmaOf(const Gaussians& g, int64_t row) {
  return g.log_scale[size_t(row)].array().exp();
}

/// Whether half floats hold the sigmas of these rows to their 11 bits.
bool fitHalf(const Gaussians& g, const std::vector<int64_t>& rows) {
  return std::all_of(rows.begin(), rows.end(), [&](int64_t row) {
    const Eigen::Vector3f sigma = sigmaOf(g, row);
    return sigma.minCoeff() >= kMinNormalHalf && sigma.maxCoeff() <= kMaxHalf;
  });
}

void fillGaussianLeaf(const Gaussians& g, const Provenance& provenance,
                      const std::vector<int64_t>& sorted, const LeafRows& range,
                      const openvdb::math::Transform& transform) {
  PointLeaf& leaf = *range.leaf;
  auto position = writeHandle<Vec3f, PositionCodec>(leaf, "P");
  openvdb::points::AttributeWriteHandle<Vec3f> scale(leaf.attributeArray("scale"));
  auto orient = writeHandle<Quats, ExactCodec>(leaf, "orient");
  auto alpha = writeHandle<float, UnitCodec>(leaf, "GS_Alpha");
  auto colour = writeHandle<Vec3f, HalfCodec>(leaf, "Cd");
  auto probability = writeHandle<float, ExactCodec>(leaf, "probability");
  auto completed = leaf.groupWriteHandle("completed");
  const size_t coefficients = size_t(g.shCoefficients());
  for (size_t i = range.begin; i < range.end; ++i) {
    const size_t row = size_t(sorted[i]);
    const auto n = openvdb::Index(i - range.begin);
    const Eigen::Vector3f& mean = g.mean[row];
    const openvdb::Vec3d p_index =
        transform.worldToIndex(openvdb::Vec3d(mean.x(), mean.y(), mean.z()));
    position.set(n, Vec3f(p_index - openvdb::Coord::round(p_index).asVec3d() + 0.5 * kFixedStep));
    const Eigen::Vector3f sigma = sigmaOf(g, sorted[i]).unaryExpr(&rounded16);
    scale.set(n, Vec3f(sigma.x(), sigma.y(), sigma.z()));
    const Eigen::Vector4f q = unitRotation(g.rotation[row]).unaryExpr(&rounded16);
    orient.set(n, Quats(q[1], q[2], q[3], q[0]));  // ours are w x y z, Houdini's x y z w
    alpha.set(n, sigmoid(g.opacity_logit[row]) + 0.5f * kFixedStep);
    const float* sh = g.sh.data() + row * coefficients * 3;
    const auto linear = [&](int c) {
      return std::clamp(linearFromSrgb(0.5f + kSh0 * sh[c]), -kMaxHalf, kMaxHalf);
    };
    colour.set(n, Vec3f(linear(0), linear(1), linear(2)));
    probability.set(n, provenance.probability.empty() ? 1.f : provenance.probability[row]);
    completed.set(n, !provenance.generated.empty() && provenance.generated[row] != 0);
  }
  for (size_t c = 0; c < 3 && g.sh_degree > 0; ++c) {
    auto values = writeHandle<float, HalfCodec>(leaf, kShNames[c]);
    for (size_t i = range.begin; i < range.end; ++i) {
      const float* sh = g.sh.data() + size_t(sorted[i]) * coefficients * 3;
      for (size_t k = 0; k < coefficients; ++k) {
        values.set(openvdb::Index(i - range.begin), openvdb::Index(k),
                   std::clamp(sh[3 * k + c], -kMaxHalf, kMaxHalf));
      }
    }
  }
}

/// Sorts the rows into leaves and writes their attributes; leaves are independent of each other.
PointTree::Ptr buildPointTree(const Gaussians& g, const Provenance& provenance,
                              const std::vector<int64_t>& rows,
                              const openvdb::math::Transform& transform) {
  std::vector<openvdb::Coord> voxels(rows.size());
  tbb::parallel_for(size_t(0), rows.size(), [&](size_t i) {
    const Eigen::Vector3f& mean = g.mean[size_t(rows[i])];
    voxels[i] =
        openvdb::Coord::round(transform.worldToIndex(openvdb::Vec3d(mean.x(), mean.y(), mean.z())));
  });
  auto [tree, sorted, leaves] = layOutPoints(
      voxels, openvdb::points::TypedAttributeArray<Vec3f, PositionCodec>::attributeType());
  for (int64_t& row : sorted) row = rows[size_t(row)];
  if (leaves.empty()) return tree;
  if (fitHalf(g, rows)) {
    openvdb::points::appendAttribute<Vec3f, HalfCodec>(*tree, "scale");
  } else {
    openvdb::points::appendAttribute<Vec3f, ExactCodec>(*tree, "scale");
  }
  openvdb::points::appendAttribute<Quats, ExactCodec>(*tree, "orient");
  openvdb::points::appendAttribute<float, UnitCodec>(*tree, "GS_Alpha");
  openvdb::points::appendAttribute<Vec3f, HalfCodec>(*tree, "Cd");
  for (const char* name : kShNames) {  // Cd is all there is of degree 0
    if (g.sh_degree == 0) break;
    openvdb::points::appendAttribute<float, HalfCodec>(*tree, name, 0.f,
                                                       openvdb::Index(g.shCoefficients()));
  }
  openvdb::points::appendAttribute<float, ExactCodec>(*tree, "probability");
  openvdb::points::appendGroup(*tree, "completed");
  tbb::parallel_for(size_t(0), leaves.size(), [&, &sorted = sorted, &leaves = leaves](size_t l) {
    fillGaussianLeaf(g, provenance, sorted, leaves[l], transform);
  });
  openvdb::points::compactAttributes(*tree);
  return tree;
}

/// Attributes of one leaf of the splat grid, checked, and where its points go in the result.
struct SplatLeaf {
  const PointLeaf* leaf;
  size_t first_row;
  openvdb::Index count;
};

/// The highest degree with a coefficient other than zero: what files by others leave to be found
/// out.
int usedShDegree(const std::vector<SplatLeaf>& leaves) {
  int used = 0;
  for (const SplatLeaf& l : leaves) {
    for (const char* name : kShNames) {
      const auto values = readHandle<float>(*l.leaf, name);
      const auto stride = std::min<openvdb::Index>(values.stride(), kMaxShSlots);
      for (openvdb::Index n = 0; n < values.size(); ++n) {
        for (openvdb::Index k = stride; k > openvdb::Index(used + 1) * openvdb::Index(used + 1);
             --k) {
          if (values.get(n, k - 1) == 0) continue;
          while ((used + 1) * (used + 1) < int(k)) ++used;
          break;
        }
      }
    }
  }
  return used;
}

void readShapes(const SplatLeaf& source, const openvdb::math::Transform& transform, Gaussians* g) {
  const PointLeaf& leaf = *source.leaf;
  const auto position = readHandle<Vec3f>(leaf, "P");
  const auto scale = readHandle<Vec3f>(leaf, "scale");
  const auto orient = readHandle<Quats>(leaf, "orient");
  const auto alpha = readHandle<float>(leaf, "GS_Alpha");
  openvdb::Index begin = 0;
  for (openvdb::Index v = 0; v < PointLeaf::SIZE; ++v) {
    const openvdb::Index end = openvdb::Index(leaf.getValue(v));
    const openvdb::Vec3d voxel = leaf.offsetToGlobalCoord(v).asVec3d();
    for (openvdb::Index n = begin; n < end; ++n) {
      const size_t row = source.first_row + n;
      const openvdb::Vec3d p = transform.indexToWorld(voxel + openvdb::Vec3d(position.get(n)));
      g->mean[row] = (Eigen::Vector3d(p.x(), p.y(), p.z()) - g->origin).cast<float>();
      const Vec3f sigma = scale.get(n);
      g->log_scale[row] = {std::log(sigma.x()), std::log(sigma.y()), std::log(sigma.z())};
      const Quats q = orient.get(n);
      g->rotation[row] = {q[3], q[0], q[1], q[2]};
      g->opacity_logit[row] = logitOf(alpha.get(n));
    }
    begin = end;
  }
}

void readColours(const SplatLeaf& source, bool has_sh, Gaussians* g) {
  const size_t coefficients = size_t(g->shCoefficients());
  float* sh = g->sh.data() + source.first_row * coefficients * 3;
  if (!has_sh) {
    const auto colour = readHandle<Vec3f>(*source.leaf, "Cd");
    for (openvdb::Index n = 0; n < source.count; ++n) {
      const Vec3f linear = colour.get(n);
      for (int c = 0; c < 3; ++c)
        sh[n * coefficients * 3 + size_t(c)] = (srgbFromLinear(linear[c]) - 0.5f) / kSh0;
    }
    return;
  }
  for (size_t c = 0; c < 3; ++c) {
    const auto values = readHandle<float>(*source.leaf, kShNames[c]);
    for (openvdb::Index n = 0; n < source.count; ++n)
      for (size_t k = 0; k < coefficients; ++k)
        sh[(n * coefficients + k) * 3 + c] = values.get(n, openvdb::Index(k));
  }
}

void readProvenance(const SplatLeaf& source, Provenance* provenance) {
  const PointLeaf& leaf = *source.leaf;
  if (hasAttribute(leaf, "probability")) {
    const auto probability = readHandle<float>(leaf, "probability");
    for (openvdb::Index n = 0; n < source.count; ++n)
      provenance->probability[source.first_row + n] = probability.get(n);
  }
  if (leaf.attributeSet().descriptor().hasGroup("completed")) {
    const auto completed = leaf.groupHandle("completed");
    for (openvdb::Index n = 0; n < source.count; ++n)
      provenance->generated[source.first_row + n] = completed.get(n) ? 1 : 0;
  }
}

/// The points grid `splats`, or else the first points grid.
PointGrid::Ptr findSplats(const openvdb::GridPtrVec& grids, const std::string& path) {
  PointGrid::Ptr chosen;
  std::string found;
  for (const openvdb::GridBase::Ptr& grid : grids) {
    if (!grid) continue;
    found += (found.empty() ? "" : ", ") + grid->getName() + " (" + grid->type() + ")";
    if (grid->isType<PointGrid>() && (!chosen || grid->getName() == "splats")) {
      chosen = openvdb::gridPtrCast<PointGrid>(grid);
    }
  }
  require(bool(chosen), "readPointsVdb: ", path, ": no splats: expected a points grid, found ",
          found.empty() ? "no grid" : found);
  return chosen;
}

/// Where means are measured from: the grid's own origin as we write it, or, in files that keep
/// their points far from it, the first of their voxels.
Eigen::Vector3d originOf(const PointGrid& grid, const std::vector<SplatLeaf>& leaves) {
  constexpr double kFar = 10000;  // metres: 1 mm in single precision
  if (leaves.empty()) return Eigen::Vector3d::Zero();
  const openvdb::Vec3d grid_origin = grid.transform().indexToWorld(openvdb::Vec3d(0)),
                       first = grid.transform().indexToWorld(leaves[0].leaf->origin());
  const openvdb::Vec3d near = (first - grid_origin).length() < kFar ? grid_origin : first;
  return {near.x(), near.y(), near.z()};
}

Gaussians gatherPoints(const PointGrid& grid, const std::string& path, Provenance* provenance) {
  std::vector<SplatLeaf> leaves;
  size_t count = 0;
  bool has_sh = true;
  for (auto leaf = grid.tree().cbeginLeaf(); leaf; ++leaf) {
    const auto has = [&](const char* name) { return hasAttribute(*leaf, name); };
    for (const char* name : {"P", "scale", "orient", "GS_Alpha"}) {
      require(has(name), "readPointsVdb: ", path, ": no splats: points grid ", grid.getName(),
              " has no attribute ", name,
              " (expected P scale orient GS_Alpha and GS_SPH_R/G/B or Cd)");
    }
    has_sh = has_sh && has(kShNames[0]) && has(kShNames[1]) && has(kShNames[2]);
    require(has_sh || has("Cd"), "readPointsVdb: ", path, ": no splats: points grid ",
            grid.getName(), " has no colour (expected GS_SPH_R/G/B or Cd)");
    const size_t points = checkedPointCount("readPointsVdb", *leaf, path);
    leaves.push_back({&*leaf, count, openvdb::Index(points)});
    count += points;
  }
  int degree = 0;
  if (has_sh && !leaves.empty()) {
    const auto stored = grid.getMetadata<openvdb::Int32Metadata>("sh_degree");
    degree = stored ? stored->value() : usedShDegree(leaves);
    require(degree >= 0 && degree <= 3, "readPointsVdb: ", path, ": expected sh_degree 0-3, found ",
            degree);
    for (const SplatLeaf& l : leaves)
      for (const char* name : kShNames) {
        const openvdb::Index values = l.leaf->constAttributeArray(name).stride();
        require(int(values) >= (degree + 1) * (degree + 1), "readPointsVdb: ", path,
                ": expected at least ", (degree + 1) * (degree + 1), " values of ", name,
                " for its sh_degree ", degree, ", found ", values);
      }
  }
  Gaussians g;
  g.resize(int64_t(count), degree);
  const auto mode = grid.getMetadata<openvdb::StringMetadata>(kModeKey);
  g.antialias = mode && mode->value() == kAntialiasedMode;
  if (provenance) {
    const PointLeaf* first = leaves.empty() ? nullptr : leaves[0].leaf;
    provenance->recorded = first && (first->attributeSet().descriptor().hasGroup("completed") ||
                                     hasAttribute(*first, "probability"));
    provenance->generated.assign(count, 0);
    provenance->probability.assign(count, 1.f);
  }
  g.origin = originOf(grid, leaves);
  tbb::parallel_for(size_t(0), leaves.size(), [&](size_t i) {
    readShapes(leaves[i], grid.transform(), &g);
    readColours(leaves[i], has_sh, &g);
    if (provenance) readProvenance(leaves[i], provenance);
  });
  const std::vector<int64_t> rows = finiteRows(g);
  if (int64_t(rows.size()) == g.size()) return g;
  if (provenance) *provenance = selectRows(std::move(*provenance), rows);
  return selectRows(std::move(g), rows);
}

}  // namespace

void writePointsVdb(const Gaussians& g, const Provenance& provenance, const std::string& path) {
  constexpr const char* kOperation = "writePointsVdb";
  requireConsistent(g);
  const auto matches = [&](size_t n) { return n == 0 || n == size_t(g.size()); };
  require(matches(provenance.generated.size()) && matches(provenance.probability.size()),
          kOperation, ": ", path, ": expected provenance of ", g.size(), " Gaussians, found ",
          provenance.generated.size(), " and ", provenance.probability.size());
  std::vector<int64_t> rows = writableRows(g);
  rows.erase(std::remove_if(rows.begin(), rows.end(),
                            [&](int64_t row) {  // sigma is stored, not its logarithm
                              const Eigen::Vector3f sigma = sigmaOf(g, row);
                              return !sigma.allFinite() || !(sigma.minCoeff() > 0);
                            }),
             rows.end());
  openvdb::initialize();
  PointGrid::Ptr grid;
  try {
    const auto transform =
        openvdb::math::Transform::createLinearTransform(pointsVoxelSize(g, rows));
    grid = PointGrid::create(buildPointTree(g, provenance, rows, *transform));
    transform->postTranslate(openvdb::Vec3d(g.origin.x(), g.origin.y(), g.origin.z()));
    grid->setTransform(transform);
    grid->setName("splats");
    grid->setCreator("vdb_complete");
    grid->insertMeta("point_count", openvdb::Int64Metadata(int64_t(rows.size())));
    grid->insertMeta("point_attributes", openvdb::StringMetadata(joinText(
                                             "P scale orient GS_Alpha Cd ",
                                             g.sh_degree > 0 ? "GS_SPH_R GS_SPH_G GS_SPH_B " : "",
                                             "probability group:completed")));
    grid->insertMeta("sh_degree", openvdb::Int32Metadata(g.sh_degree));
    grid->insertMeta(kModeKey, openvdb::StringMetadata(renderMode(g)));
  } catch (const openvdb::Exception& error) {
    throw Error(joinText(kOperation, ": ", path, ": cannot encode: ", error.what()));
  }
  writeVdb(kOperation, path, {grid}, {});
}

Gaussians readPointsVdb(const std::string& path, Provenance* provenance) {
  const openvdb::GridPtrVec grids = readVdb("readPointsVdb", path, kMaxGaussianBytes).grids;
  try {
    return gatherPoints(*findSplats(grids, path), path, provenance);
  } catch (const Error&) {
    throw;
  } catch (const std::exception& error) {  // OpenVDB's own
    std::string message = error.what();
    std::replace(message.begin(), message.end(), '\n', ' ');
    throw Error(joinText("readPointsVdb: ", path, ": corrupt or unreadable: ", message));
  }
}

}  // namespace vdbc
