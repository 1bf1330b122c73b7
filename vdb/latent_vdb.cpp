#include "vdb/latent_vdb.h"

#include <openvdb/openvdb.h>
#include <openvdb/points/PointAttribute.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>

#include "vdb/point_leaves.h"
#include "vdb/scene_volume.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

constexpr const char* kWrite = "writeLatentVdb";
constexpr const char* kRead = "readLatentVdb";
constexpr uint64_t kMaxBytes = uint64_t(1) << 34;
constexpr int kMaxDim = 1024;                     // as the encoder's configuration
constexpr int64_t kMaxValues = int64_t(1) << 30;  // of all latents: 4 GiB

// Names of the grids, their attributes and metadata: the format, shared by writer and reader.
constexpr const char* kLatent = "latent";
constexpr const char* kFilled = "filled";
constexpr const char* kEmpty = "empty";
constexpr const char* kZ = "z";
constexpr const char* kProbability = "probability";
constexpr const char* kBfsLevel = "bfs_level";
constexpr const char* kGenerated = "generated";
constexpr const char* kRow = "row";
constexpr const char* kLevel = "latent_level";
constexpr const char* kDim = "latent_dim";
constexpr const char* kHash = "encoder_hash";
constexpr const char* kGrowth = "growth";
constexpr const char* kFrame = "world_from_grid";

/// Throws unless every token makes sense; for writer and reader.
void requireTokens(const char* operation, const LatentGrid& g, const std::string& path) {
  const CoordBBox nodes(tokenCoord(g.frame.bounds.min(), g.level),
                        tokenCoord(g.frame.bounds.max(), g.level));
  for (size_t i = 0; i < g.ijk.size(); ++i) {
    require(nodes.isInside(g.ijk[i]), operation, ": ", path, ": node ", g.ijk[i],
            " lies outside the volume ", nodes);
    const auto z = g.z.begin() + std::ptrdiff_t(i * size_t(g.dim));
    const bool fit = std::all_of(z, z + g.dim, [](float v) { return std::abs(v) <= kMaxHalf; });
    require(fit && g.probability[i] >= 0 && g.probability[i] <= 1 && g.bfs_level[i] >= 0, operation,
            ": ", path, ": node ", g.ijk[i], " has a value that makes no sense");
  }
}

void requireWritable(const LatentFile& file, const std::string& path) {
  const LatentGrid& g = file.latents;
  const size_t n = g.ijk.size();
  require(g.level >= 0 && g.level < kTokenLevels && g.dim > 0 && g.dim <= kMaxDim &&
              std::isfinite(g.frame.voxel_m) && g.frame.voxel_m > 0,
          kWrite, ": ", path, ": expected level 0-2, dim 1-", kMaxDim,
          " and a voxel size, found level ", g.level, ", dim ", g.dim, ", ", g.frame.voxel_m, " m");
  require(g.z.size() == n * size_t(g.dim) && g.observed.size() == n && g.probability.size() == n &&
              g.bfs_level.size() == n,
          kWrite, ": ", path, ": arrays of different lengths (expected ", n, ")");
  require(int64_t(n) * g.dim <= kMaxValues, kWrite, ": ", path, ": expected at most ", kMaxValues,
          " values, found ", n, " x ", g.dim);
  requireTokens(kWrite, g, path);
  for (const TokenMask* mask : {&file.seen.filled, &file.seen.empty}) {
    CoordBBox box;
    require(!mask->evalActiveVoxelBoundingBox(box) || g.frame.bounds.isInside(box), kWrite, ": ",
            path, ": voxels ", box, " lie outside the volume ", g.frame.bounds);
  }
}

void fillLeaf(const LatentGrid& g, const std::vector<int64_t>& sorted, const LeafRows& range) {
  PointLeaf& leaf = *range.leaf;
  auto position = writeHandle<openvdb::Vec3f, ExactCodec>(leaf, "P");
  auto z = writeHandle<float, HalfCodec>(leaf, kZ);
  auto probability = writeHandle<float, ExactCodec>(leaf, kProbability);
  auto bfs_level = writeHandle<int32_t, ExactCodec>(leaf, kBfsLevel);
  auto generated = writeHandle<bool, ExactCodec>(leaf, kGenerated);
  auto number = writeHandle<int32_t, ExactCodec>(leaf, kRow);
  for (size_t i = range.begin; i < range.end; ++i) {
    const size_t row = size_t(sorted[i]), dim = size_t(g.dim);
    const auto n = openvdb::Index(i - range.begin);
    position.set(n, openvdb::Vec3f(0));  // the node's centre
    for (size_t c = 0; c < dim; ++c) z.set(n, openvdb::Index(c), g.z[row * dim + c]);
    probability.set(n, g.probability[row]);
    bfs_level.set(n, g.bfs_level[row]);
    generated.set(n, g.observed[row] == 0);
    number.set(n, int32_t(row));
  }
}

PointGrid::Ptr latentGrid(const LatentGrid& g, const std::string& path) {
  using openvdb::points::appendAttribute;
  const auto layout = layOutPoints(
      g.ijk, openvdb::points::TypedAttributeArray<openvdb::Vec3f, ExactCodec>::attributeType());
  for (size_t i = 1; i < layout.rows.size(); ++i) {
    const Coord& ijk = g.ijk[size_t(layout.rows[i])];
    require(ijk != g.ijk[size_t(layout.rows[i - 1])], kWrite, ": ", path, ": node ", ijk,
            " is there twice");
  }
  if (!layout.leaves.empty()) {
    PointTree& tree = *layout.tree;
    appendAttribute<float, HalfCodec>(tree, kZ, 0.f, openvdb::Index(g.dim));
    appendAttribute<float, ExactCodec>(tree, kProbability);
    appendAttribute<int32_t, ExactCodec>(tree, kBfsLevel);
    appendAttribute<bool, ExactCodec>(tree, kGenerated);
    appendAttribute<int32_t, ExactCodec>(tree, kRow);
    tbb::parallel_for(size_t(0), layout.leaves.size(),
                      [&](size_t l) { fillLeaf(g, layout.rows, layout.leaves[l]); });
    openvdb::points::compactAttributes(tree);
  }
  auto grid = PointGrid::create(layout.tree);
  grid->setTransform(fileTransform(g.frame, g.level));
  grid->insertMeta("point_count", openvdb::Int64Metadata(g.size()));
  grid->insertMeta("point_attributes",
                   openvdb::StringMetadata("P z probability bfs_level generated row"));
  return grid;
}

openvdb::MetaMap metadataOf(const LatentFile& file) {
  const LatentGrid& g = file.latents;
  openvdb::MetaMap metadata;
  metadata.insertMeta("creator", openvdb::StringMetadata("vdb_complete"));
  metadata.insertMeta(kHash, openvdb::StringMetadata(file.encoder_hash));
  if (!file.growth.empty()) metadata.insertMeta(kGrowth, openvdb::StringMetadata(file.growth));
  metadata.insertMeta(kLevel, openvdb::Int32Metadata(g.level));
  metadata.insertMeta(kDim, openvdb::Int32Metadata(g.dim));
  insertVolume(g.frame, &metadata);
  openvdb::Mat4d frame;  // row vectors, as OpenVDB has them
  for (int row = 0; row < 4; ++row)
    for (int col = 0; col < 4; ++col) frame[row][col] = g.frame.world_from_grid.matrix()(col, row);
  metadata.insertMeta(kFrame, openvdb::Mat4DMetadata(frame));
  const auto observed =
      std::count_if(g.observed.begin(), g.observed.end(), [](uint8_t value) { return value != 0; });
  metadata.insertMeta("observed_count", openvdb::Int64Metadata(int64_t(observed)));
  metadata.insertMeta("generated_count", openvdb::Int64Metadata(g.size() - observed));
  return metadata;
}

/// The frame bit for bit: a transform holds it as products, good to 15 digits only.
VoxelFrame exactFrame(const openvdb::MetaMap& metadata, const VoxelFrame& approximate,
                      const std::string& path) {
  const auto m = findMetadata<openvdb::Mat4d>(kRead, metadata, kFrame, path);
  VoxelFrame frame = approximate;
  for (int row = 0; row < 4; ++row)
    for (int col = 0; col < 4; ++col) frame.world_from_grid.matrix()(col, row) = m[row][col];
  const Eigen::Matrix4d& expected = approximate.world_from_grid.matrix();
  const double error = (frame.world_from_grid.matrix() - expected).cwiseAbs().maxCoeff();
  require(error <= 1e-6 * std::max(1., expected.cwiseAbs().maxCoeff()), kRead, ": ", path,
          ": expected the transform of the metadata '", kFrame, "', found one ", error, " off");
  return frame;
}

/// Leaves in tree order and the number of their points, at most one a node.
std::vector<const PointLeaf*> checkedLeaves(const PointGrid& grid, int dim, size_t* count,
                                            const std::string& path) {
  std::vector<const PointLeaf*> leaves;
  *count = 0;
  for (auto leaf = grid.tree().cbeginLeaf(); leaf; ++leaf) {
    const size_t points = checkedPointCount(kRead, *leaf, path);
    for (const char* name : {kZ, kProbability, kBfsLevel, kGenerated, kRow})
      require(points == 0 || hasAttribute(*leaf, name), kRead, ": ", path,
              ": grid 'latent' has no attribute ", name);
    openvdb::Index before = 0;
    for (openvdb::Index v = 0; v < PointLeaf::SIZE; ++v) {
      const auto end = openvdb::Index(leaf->getValue(v));
      require(end - before <= 1, kRead, ": ", path, ": expected one point a node, found ",
              end - before, " at ", leaf->offsetToGlobalCoord(v));
      before = end;
    }
    if (points == 0) continue;
    const auto stride = leaf->constAttributeArray(kZ).stride();
    require(int64_t(stride) == dim, kRead, ": ", path, ": expected z with ", dim, " values, found ",
            stride);
    *count += points;
    require(int64_t(*count) * dim <= kMaxValues, kRead, ": ", path, ": expected at most ",
            kMaxValues, " values, found more");
    leaves.push_back(&*leaf);
  }
  return leaves;
}

void readLeaf(const PointLeaf& leaf, std::vector<uint8_t>* taken, LatentGrid* g,
              const std::string& path) {
  const auto z = readHandle<float>(leaf, kZ);
  const auto probability = readHandle<float>(leaf, kProbability);
  const auto bfs_level = readHandle<int32_t>(leaf, kBfsLevel);
  const auto generated = readHandle<bool>(leaf, kGenerated);
  const auto number = readHandle<int32_t>(leaf, kRow);
  openvdb::Index n = 0;
  for (openvdb::Index v = 0; v < PointLeaf::SIZE; ++v) {
    if (openvdb::Index(leaf.getValue(v)) == n) continue;
    const int64_t row = number.get(n);
    require(row >= 0 && row < g->size() && !(*taken)[size_t(row)], kRead, ": ", path,
            ": expected each row from 0 to ", g->size() - 1, " once, found ", row);
    (*taken)[size_t(row)] = 1;
    const size_t i = size_t(row), dim = size_t(g->dim);
    g->ijk[i] = leaf.offsetToGlobalCoord(v);
    for (size_t c = 0; c < dim; ++c) g->z[i * dim + c] = z.get(n, openvdb::Index(c));
    g->probability[i] = probability.get(n);
    g->bfs_level[i] = bfs_level.get(n);
    g->observed[i] = !generated.get(n);
    ++n;
  }
}

void readTokens(const PointGrid& grid, LatentGrid* g, const std::string& path) {
  size_t n = 0;
  const std::vector<const PointLeaf*> leaves = checkedLeaves(grid, g->dim, &n, path);
  g->ijk.resize(n), g->z.resize(n * size_t(g->dim));
  g->observed.resize(n), g->probability.resize(n), g->bfs_level.resize(n);
  std::vector<uint8_t> taken(n, 0);
  for (const PointLeaf* leaf : leaves) readLeaf(*leaf, &taken, g, path);
  requireTokens(kRead, *g, path);
}

}  // namespace

void writeLatentVdb(const LatentFile& file, const std::string& path) {
  requireWritable(file, path);
  openvdb::initialize();
  const std::pair<const char*, openvdb::GridBase::Ptr> named[] = {
      {kLatent, latentGrid(file.latents, path)},
      {kFilled, gridOfMask(file.seen.filled)},
      {kEmpty, gridOfMask(file.seen.empty)},
  };
  const auto voxels = fileTransform(file.latents.frame);
  openvdb::GridCPtrVec grids;
  for (const auto& [name, grid] : named) {
    grid->setName(name);
    grid->setCreator("vdb_complete");
    if (name != kLatent) grid->setTransform(voxels);
    grids.push_back(grid);
  }
  writeVdb(kWrite, path, grids, metadataOf(file));
}

LatentFile readLatentVdb(const std::string& path) {
  const auto [grids, metadata] = readVdb(kRead, path, kMaxBytes);
  const auto tokens = findGrid<PointGrid>(kRead, grids, kLatent, path);
  const auto filled = findGrid<BoolGrid>(kRead, grids, kFilled, path);
  const auto empty = findGrid<BoolGrid>(kRead, grids, kEmpty, path);
  LatentFile file;
  LatentGrid& g = file.latents;
  g.level = findMetadata<int32_t>(kRead, metadata, kLevel, path);
  g.dim = findMetadata<int32_t>(kRead, metadata, kDim, path);
  require(g.level >= 0 && g.level < kTokenLevels && g.dim > 0 && g.dim <= kMaxDim, kRead, ": ",
          path, ": expected level 0-2 and dim 1-", kMaxDim, ", found level ", g.level, ", dim ",
          g.dim);
  for (const auto& [grid, level] : {std::pair<const openvdb::GridBase*, int>(tokens.get(), g.level),
                                    {filled.get(), 0},
                                    {empty.get(), 0}})
    g.frame =
        exactFrame(metadata, readVolume(kRead, metadata, grid->transform(), level, path), path);
  file.encoder_hash = findMetadata<std::string>(kRead, metadata, kHash, path);
  if (metadata[kGrowth]) file.growth = findMetadata<std::string>(kRead, metadata, kGrowth, path);
  try {
    readTokens(*tokens, &g, path);
  } catch (const openvdb::Exception& error) {  // an attribute of another type
    throw Error(joinText(kRead, ": ", path, ": corrupt or unreadable: ", error.what()));
  }
  file.seen.filled.root() = maskOfGrid(kRead, *filled, g.frame.bounds, path).root();
  file.seen.empty.root() = maskOfGrid(kRead, *empty, g.frame.bounds, path).root();
  return file;
}

}  // namespace vdbc
