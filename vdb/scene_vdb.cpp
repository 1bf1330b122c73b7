// Slow to compile, like everything that walks several types of trees.
#include "vdb/scene_vdb.h"

#include <openvdb/openvdb.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "vdb/fuse.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

constexpr int kBandVoxels = 3;  // half width of `surface`

// Grids beside those that SceneVoxels::columns() names.
constexpr const char* kSurface = "surface";
constexpr const char* kGenerated = "generated";
constexpr const char* kSeenEmpty = "seen_empty";
constexpr const char* kSeenDistance = "seen_distance";

// The grid that holds a column, and its values as the grid has them and back.
template <typename Value>
struct GridOf;
template <>
struct GridOf<float> {
  using Grid = FloatGrid;
};
template <>
struct GridOf<int32_t> {
  using Grid = FloatGrid;
};
template <>
struct GridOf<uint8_t> {
  using Grid = BoolGrid;
};
template <>
struct GridOf<Eigen::Vector3f> {
  using Grid = Vec3SGrid;
};
template <typename Value>
Value toGrid(const Value& value) {
  return value;
}
openvdb::Vec3f toGrid(const Eigen::Vector3f& v) { return {v.x(), v.y(), v.z()}; }
// False where the grid's value is none that the column can have.
bool fromGrid(bool from, uint8_t* to) { return *to = from, true; }
bool fromGrid(float from, float* to) { return *to = from, std::isfinite(from); }
bool fromGrid(float from, int32_t* to) {
  const bool is_count = from >= 0 && from <= float(1 << 24);
  return *to = is_count ? int32_t(from) : 0, is_count;
}
bool fromGrid(const openvdb::Vec3f& from, Eigen::Vector3f* to) {
  return *to = {from.x(), from.y(), from.z()}, std::isfinite(from.lengthSqr());
}

/// Exact signed distance (world units, negative inside) to the boundary of the union of the active
/// voxels that are solid, in a band of kBandVoxels at both sides. Squared distances to boxes add up
/// over the axes, so three one-dimensional minima per leaf do it (Felzenszwalb and Huttenlocher
/// 2012, sec. 2.1, with the distance to a cell instead of a point).
FloatGrid::Ptr boundaryLevelSet(const SceneVoxels& v) {
  const auto voxel_m = double(v.frame.voxel_m);
  MaskTree solid;
  openvdb::tree::ValueAccessor<MaskTree, false> set(solid);
  for (const Coord& ijk : solidVoxels(v)) set.setValueOn(ijk);

  using Leaf = FloatTree::LeafNodeType;
  constexpr int kReach = kBandVoxels;  // a cell further off is outside the band
  constexpr int kSide = int(Leaf::DIM) + 2 * kReach;
  constexpr float kFar = 1e9f;
  constexpr std::array<float, kReach + 1> kCell2 = {0.f, 0.25f, 2.25f, 6.25f};  // (d - 1/2)^2

  std::vector<Coord> origins;  // of all leaves that the band can touch
  for (auto leaf = solid.cbeginLeaf(); leaf; ++leaf) {
    const CoordBBox box = leaf->getNodeBoundingBox();
    CoordBBox active;
    leaf->evalActiveBoundingBox(active, false);
    active.expand(kReach);
    for (int x = -1; x <= 1; ++x)
      for (int y = -1; y <= 1; ++y)
        for (int z = -1; z <= 1; ++z) {
          const Coord shift(x * int(Leaf::DIM), y * int(Leaf::DIM), z * int(Leaf::DIM));
          if (CoordBBox(box.min() + shift, box.max() + shift).hasOverlap(active))
            origins.push_back(box.min() + shift);
        }
  }
  std::sort(origins.begin(), origins.end());
  origins.erase(std::unique(origins.begin(), origins.end()), origins.end());

  const auto half_width = float(kBandVoxels * voxel_m);
  std::vector<Leaf*> leaves(origins.size());
  tbb::parallel_for(size_t(0), origins.size(), [&](size_t i) {
    using Block = std::array<float, kSide * kSide * kSide>;
    Block out, in, swap;  // squared distances, voxels: to solid cells, to open cells
    const openvdb::tree::ValueAccessor<const MaskTree, false> cells(solid);
    const Coord corner = origins[i].offsetBy(-kReach);
    for (int x = 0, k = 0; x < kSide; ++x)
      for (int y = 0; y < kSide; ++y)
        for (int z = 0; z < kSide; ++z, ++k) {
          const bool on = cells.isValueOn(corner.offsetBy(x, y, z));
          out[size_t(k)] = on ? 0.f : kFar;
          in[size_t(k)] = on ? kFar : 0.f;
        }
    for (Block* block : {&out, &in}) {
      // Each axis in turn, for the leaf's own range of that axis: all neighbours are in the block.
      Coord low(0), high(kSide);
      for (int axis = 0, step = kSide * kSide; axis < 3; ++axis, step /= kSide) {
        low[axis] = kReach;
        high[axis] = kReach + int(Leaf::DIM);
        for (int x = low[0]; x < high[0]; ++x)
          for (int y = low[1]; y < high[1]; ++y)
            for (int z = low[2], k = (x * kSide + y) * kSide + z; z < high[2]; ++z, ++k) {
              const float* near = block->data() + k;
              float best = near[0];
              for (int d = 1; d <= kReach; ++d)
                best =
                    std::min(best, std::min(near[-d * step], near[d * step]) + kCell2[size_t(d)]);
              swap[size_t(k)] = best;
            }
        std::swap(*block, swap);
      }
    }
    auto* leaf = new Leaf(origins[i], half_width, false);
    for (openvdb::Index offset = 0; offset < Leaf::SIZE; ++offset) {
      const Coord p = Leaf::offsetToLocalCoord(offset).offsetBy(kReach);
      const size_t k = size_t((p.x() * kSide + p.y()) * kSide + p.z());
      const bool solid_here = out[k] == 0.f;
      const float distance = std::sqrt(solid_here ? in[k] : out[k]) * float(voxel_m);
      if (distance < half_width)
        leaf->setValueOn(offset, solid_here ? -distance : distance);
      else if (solid_here)
        leaf->setValueOff(offset, -half_width);
    }
    leaves[i] = leaf;
  });
  auto grid = FloatGrid::create(half_width);
  for (Leaf* leaf : leaves) grid->tree().addLeaf(leaf);
  grid->setGridClass(openvdb::GRID_LEVEL_SET);
  return grid;
}

/// A grid with one active voxel per entry of `ijk`; value(i) is its value.
template <typename GridType, typename Value>
typename GridType::Ptr voxelGrid(const std::vector<Coord>& ijk, const Value& value) {
  auto grid = GridType::create();
  auto accessor = grid->getUnsafeAccessor();
  for (size_t i = 0; i < ijk.size(); ++i)
    accessor.setValueOn(ijk[i], typename GridType::ValueType(value(i)));
  return grid;
}

void requireWritableVoxels(const SceneVoxels& v, const std::string& path) {
  requireRows(v, joinText("writeSceneVdb: ", path));
  require(std::isfinite(v.frame.voxel_m) && v.frame.voxel_m > 0, "writeSceneVdb: ", path,
          ": expected a positive voxel size, found ", v.frame.voxel_m);
  for (size_t i = 0; i < v.ijk.size(); ++i) {
    require(v.frame.bounds.isInside(v.ijk[i]), "writeSceneVdb: ", path, ": voxel ", v.ijk[i],
            " lies outside the volume ", v.frame.bounds);
    require(v.colour_linear[i].allFinite() && std::isfinite(v.density[i]) &&
                std::isfinite(v.probability[i]),
            "writeSceneVdb: ", path, ": voxel ", v.ijk[i], " has a value that is not finite");
  }
}

// How many voxels of a grid lie along a voxel of the frame; throws where it is not in the frame.
int checkedParts(const char* operation, const openvdb::GridBase& grid, const VoxelFrame& frame,
                 const std::string& path) {
  const int parts = detailPartsOf(frame, grid);
  VoxelFrame detail = frame;
  detail.voxel_m = frame.voxel_m / float(parts);
  const openvdb::Mat4d expected = fileTransform(detail)->baseMap()->getAffineMap()->getMat4(),
                       found = grid.transform().baseMap()->getAffineMap()->getMat4();
  double off = 0;
  for (int row = 0; row < 4; ++row)
    for (int col = 0; col < 4; ++col)
      off = std::max(off, std::abs(expected[row][col] - found[row][col]));
  require(off < 1e-6 * std::max(1., frame.world_from_grid.translation().cwiseAbs().maxCoeff()),
          operation, ": ", path, ": grid '", grid.getName(),
          "' does not lie in the volume's frame");
  return parts;
}

// A distance grid of another program's making may hold anything.
FloatGrid::ConstPtr checkedDistance(const char* operation, const FloatGrid::Ptr& grid,
                                    const VoxelFrame& frame, const std::string& path) {
  const float edge = frame.voxel_m / float(checkedParts(operation, *grid, frame, path));
  const float most = 1.01f * float(kDetailBand) * edge;
  for (auto value = grid->cbeginValueOn(); value; ++value)
    require(std::abs(*value) <= most, operation, ": ", path, ": voxel ", value.getCoord(), " of '",
            kSeenDistance, "' has a value that makes no sense");
  return grid;
}

// The value of a voxel of the frame: the grid's own or, in detail voxels, the mean of those there.
template <typename GridType>
class VoxelValues {
 public:
  VoxelValues(const GridType& grid, int parts)
      : values_(grid.getConstUnsafeAccessor()), parts_(parts) {}
  typename GridType::ValueType at(const Coord& ijk) const {
    if (parts_ == 1) return values_.getValue(ijk);
    typename GridType::ValueType sum(0);
    int n = 0;
    const Coord low(ijk.x() * parts_, ijk.y() * parts_, ijk.z() * parts_);
    for (const Coord& c : CoordBBox::createCube(low, parts_))
      if (values_.isValueOn(c)) sum += values_.getValue(c), ++n;
    return n > 0 ? typename GridType::ValueType(sum / float(n)) : sum;
  }

 private:
  typename GridType::ConstUnsafeAccessor values_;
  int parts_;
};

}  // namespace

std::vector<Coord> solidVoxels(const SceneVoxels& v) {
  std::vector<Coord> solid;
  const openvdb::tree::ValueAccessor<const TokenMask, false> empty(v.empty);
  for (size_t i = 0; i < v.ijk.size(); ++i)
    if (v.observed[i] || !empty.isValueOn(v.ijk[i])) solid.push_back(v.ijk[i]);
  return solid;
}

void writeSceneVdb(const SceneVoxels& v, const std::string& path, const DetailGrids& detail) {
  requireWritableVoxels(v, path);
  openvdb::initialize();
  std::vector<std::pair<const char*, openvdb::GridBase::Ptr>> named = {
      {kSurface, detail.surface ? detail.surface : boundaryLevelSet(v)}};
  forEachColumn(
      [&](const auto& c) {
        using Value = typename std::decay_t<decltype(c)>::Value;
        if constexpr (!std::is_same_v<Value, Coord>) {
          const auto grid = voxelGrid<typename GridOf<Value>::Grid>(
              v.ijk, [&](size_t i) { return toGrid(c.values[i]); });
          require(grid->activeVoxelCount() == v.ijk.size(), "writeSceneVdb: ", path, ": expected ",
                  v.ijk.size(), " different voxels, found ", grid->activeVoxelCount());
          if constexpr (std::is_same_v<Value, Eigen::Vector3f>)
            grid->setVectorType(openvdb::VEC_INVARIANT);
          named.emplace_back(c.name, grid);
        }
      },
      v);
  named[1].second->setGridClass(openvdb::GRID_FOG_VOLUME);  // `density` is the first column
  std::vector<openvdb::GridBase::Ptr> fine;                 // in detail voxels
  if (detail.surface) {
    named[1].second = detail.density, named[2].second = detail.colour;
    fine = {detail.surface, detail.density, detail.colour};
  }
  if (v.seen_distance) {
    fine.push_back(v.seen_distance->deepCopy());
    named.emplace_back(kSeenDistance, fine.back());
  }
  // Where a tool wants to mask by what was made up, it should not have to invert a grid.
  named.insert(
      named.begin() + 4,
      {kGenerated, voxelGrid<BoolGrid>(v.ijk, [&](size_t i) { return v.observed[i] == 0; })});
  named.emplace_back(kSeenEmpty, gridOfMask(v.empty));
  openvdb::GridCPtrVec grids;
  const auto transform = fileTransform(v.frame);
  for (const auto& [name, grid] : named) {
    grid->setName(name);
    grid->setCreator("vdb_complete");
    // One object: OpenVDB keeps it by pointer. The detail voxels' grids have their own.
    const bool is_fine = std::find(fine.begin(), fine.end(), grid) != fine.end();
    if (!is_fine) grid->setTransform(transform);
    grids.push_back(grid);
  }
  const auto observed =
      std::count_if(v.observed.begin(), v.observed.end(), [](uint8_t value) { return value != 0; });
  openvdb::MetaMap metadata;
  metadata.insertMeta("creator", openvdb::StringMetadata("vdb_complete"));
  insertVolume(v.frame, &metadata);
  metadata.insertMeta("observed_count", openvdb::Int64Metadata(int64_t(observed)));
  metadata.insertMeta("generated_count", openvdb::Int64Metadata(int64_t(v.ijk.size()) - observed));

  writeVdb("writeSceneVdb", path, grids, metadata);
}

void writeOccupancyVdb(const VoxelFrame& frame, const std::vector<std::vector<Coord>>& completions,
                       const std::string& path) {
  require(!completions.empty(), "writeOccupancyVdb: ", path,
          ": expected one completion or more, found none");
  openvdb::initialize();
  const auto mean = FloatGrid::create(), variance = FloatGrid::create();
  auto share = mean->getUnsafeAccessor();
  for (const std::vector<Coord>& voxels : completions)
    for (const Coord& ijk : voxels)
      share.setValueOn(ijk, share.getValue(ijk) + 1);  // counts first: exact
  auto spread = variance->getUnsafeAccessor();
  for (auto value = mean->beginValueOn(); value; ++value) {
    value.setValue(*value / float(completions.size()));
    spread.setValueOn(value.getCoord(), *value * (1 - *value));
  }
  mean->setName("occupancy_mean"), variance->setName("occupancy_variance");
  openvdb::GridCPtrVec grids;
  const auto transform = fileTransform(frame);
  for (const auto& grid : {mean, variance}) {
    grid->setCreator("vdb_complete");
    grid->setGridClass(openvdb::GRID_FOG_VOLUME);
    grid->setTransform(transform);
    grids.push_back(grid);
  }
  openvdb::MetaMap metadata;
  metadata.insertMeta("creator", openvdb::StringMetadata("vdb_complete"));
  metadata.insertMeta("completions", openvdb::Int32Metadata(int32_t(completions.size())));
  insertVolume(frame, &metadata);
  writeVdb("writeOccupancyVdb", path, grids, metadata);
}

SceneVoxels readSceneVdb(const std::string& path) {
  constexpr const char* kOperation = "readSceneVdb";
  constexpr uint64_t kMaxBytes = uint64_t(1) << 32;
  const auto [grids, metadata] = readVdb(kOperation, path, kMaxBytes);
  const auto observed = findGrid<BoolGrid>(kOperation, grids, "observed", path);
  const auto empty = findGrid<BoolGrid>(kOperation, grids, kSeenEmpty, path);
  require(empty->transform() == observed->transform(), kOperation, ": ", path, ": grid '",
          kSeenEmpty, "' has another transform than 'observed'");
  SceneVoxels voxels;
  voxels.frame = readVolume(kOperation, metadata, observed->transform(), 0, path);

  // A few bytes can claim a tile of 4,096^3 voxels: count before taking memory.
  constexpr uint64_t kMaxVoxels = uint64_t(1) << 27;
  const uint64_t count = observed->activeVoxelCount();
  require(count <= kMaxVoxels, "readSceneVdb: ", path, ": expected at most ", kMaxVoxels,
          " voxels, found ", count);
  voxels.ijk.reserve(count);
  for (auto value = observed->cbeginValueOn(); value; ++value) {
    CoordBBox box;
    value.getBoundingBox(box);
    require(voxels.frame.bounds.isInside(box), "readSceneVdb: ", path, ": voxels ", box,
            " lie outside the volume ", voxels.frame.bounds);
    for (const Coord& ijk : box) voxels.ijk.push_back(ijk);
  }
  forEachColumn(
      [&](auto c) {
        using Value = typename std::decay_t<decltype(c)>::Value;
        if constexpr (!std::is_same_v<Value, Coord>) {
          const auto grid = findGrid<typename GridOf<Value>::Grid>(kOperation, grids, c.name, path);
          const VoxelValues<typename GridOf<Value>::Grid> value(
              *grid, checkedParts(kOperation, *grid, voxels.frame, path));
          c.values.resize(voxels.ijk.size());
          for (size_t i = 0; i < voxels.ijk.size(); ++i)
            require(fromGrid(value.at(voxels.ijk[i]), &c.values[i]), kOperation, ": ", path,
                    ": voxel ", voxels.ijk[i], " of '", c.name,
                    "' has a value that makes no sense");
        }
      },
      voxels);
  voxels.empty.root() = maskOfGrid(kOperation, *empty, voxels.frame.bounds, path).root();
  for (const openvdb::GridBase::Ptr& grid : grids)
    if (grid->getName() == kSeenDistance)
      voxels.seen_distance =
          checkedDistance(kOperation, findGrid<FloatGrid>(kOperation, grids, kSeenDistance, path),
                          voxels.frame, path);
  return voxels;
}

}  // namespace vdbc
