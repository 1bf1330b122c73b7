#include "vdb/latent_vdb.h"

#include <openvdb/openvdb.h>
#include <openvdb/points/PointAttribute.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>
#include <sstream>

#include "vdb/point_leaves.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

constexpr const char* kWriteLatent = "writeLatentVdb";
constexpr const char* kReadLatent = "readLatentVdb";
constexpr uint64_t kMaxLatentBytes = uint64_t(1) << 34;
constexpr int kMaxLatentDim = 1024;               // as the encoder's configuration
constexpr int64_t kMaxValues = int64_t(1) << 30;  // of all latents: 4 GiB

// Names of the grids, of attributes beside Place::columns(), and of metadata: the format, shared by
// writer and reader.
constexpr const char* kLatent = "latent";
constexpr const char* kFilled = "filled";
constexpr const char* kEmpty = "empty";
constexpr const char* kRow = "row";
constexpr const char* kLevel = "latent_level";
constexpr const char* kLatentDim = "latent_dim";
constexpr const char* kHash = "encoder_hash";
constexpr const char* kGrowth = "growth";
constexpr const char* kGridFrame = "world_from_grid";
constexpr const char* kCamera = "camera_";  // and a number: width height fx fy cx cy, pose by rows
constexpr int kMaxCameras = 65536;

// Calls visit(column, value type, codec) for each column that is an attribute: all but the
// coordinates, which are where the points lie. Flags are bool in files.
template <typename PlaceType, typename Visit>
void forEachAttribute(PlaceType& place, const Visit& visit) {
  forEachColumn(
      [&](auto c) {
        using Value = typename decltype(c)::Value;
        if constexpr (!std::is_same_v<Value, Coord>)
          visit(c, std::conditional_t<std::is_same_v<Value, uint8_t>, bool, Value>(),
                std::conditional_t<decltype(c)::is_half, HalfCodec, ExactCodec>());
      },
      place);
}

/// Throws unless every token makes sense; for writer and reader.
void requireTokens(const char* operation, const Place& g, const std::string& path) {
  const CoordBBox nodes = nodesIn(g.frame.bounds, g.level);
  for (size_t i = 0; i < g.ijk.size(); ++i) {
    require(nodes.isInside(g.ijk[i]), operation, ": ", path, ": node ", g.ijk[i],
            " lies outside the volume ", nodes);
    const auto z = g.z.begin() + std::ptrdiff_t(i * size_t(g.dim));
    const bool fit = std::all_of(z, z + g.dim, [](float v) { return std::abs(v) <= kMaxHalf; });
    require(fit && g.probability[i] >= 0 && g.probability[i] <= 1 && g.bfs_level[i] >= 0, operation,
            ": ", path, ": node ", g.ijk[i], " has a value that makes no sense");
  }
}

void requireWritablePlace(const Place& g, const std::string& path) {
  require(g.level >= 0 && g.level < kTokenLevels && g.dim > 0 && g.dim <= kMaxLatentDim &&
              std::isfinite(g.frame.voxel_m) && g.frame.voxel_m > 0,
          kWriteLatent, ": ", path, ": expected level 0-2, dim 1-", kMaxLatentDim,
          " and a voxel size, found level ", g.level, ", dim ", g.dim, ", ", g.frame.voxel_m, " m");
  requireRows(g, joinText(kWriteLatent, ": ", path));
  require(g.size() * g.dim <= kMaxValues, kWriteLatent, ": ", path, ": expected at most ",
          kMaxValues, " values, found ", g.size(), " x ", g.dim);
  requireTokens(kWriteLatent, g, path);
  for (const TokenMask* mask : {&g.seen->filled, &g.seen->empty}) {
    CoordBBox box;
    require(!mask->evalActiveVoxelBoundingBox(box) || g.frame.bounds.isInside(box), kWriteLatent,
            ": ", path, ": voxels ", box, " lie outside the volume ", g.frame.bounds);
  }
}

void fillLatentLeaf(const Place& g, const std::vector<int64_t>& sorted, const LeafRows& range) {
  PointLeaf& leaf = *range.leaf;
  auto position = writeHandle<openvdb::Vec3f, ExactCodec>(leaf, "P");
  auto number = writeHandle<int32_t, ExactCodec>(leaf, kRow);
  for (size_t i = range.begin; i < range.end; ++i) {
    const auto n = openvdb::Index(i - range.begin);
    position.set(n, openvdb::Vec3f(0));  // the node's centre
    number.set(n, int32_t(sorted[i]));
  }
  forEachAttribute(g, [&](const auto& c, auto value, auto codec) {
    auto handle = writeHandle<decltype(value), decltype(codec)>(leaf, c.name);
    for (size_t i = range.begin; i < range.end; ++i)
      for (size_t k = 0; k < c.width; ++k)
        handle.set(openvdb::Index(i - range.begin), openvdb::Index(k),
                   decltype(value)(c.values[size_t(sorted[i]) * c.width + k]));
  });
}

PointGrid::Ptr latentGrid(const Place& g, const std::string& path) {
  using openvdb::points::appendAttribute;
  const auto layout = layOutPoints(
      g.ijk, openvdb::points::TypedAttributeArray<openvdb::Vec3f, ExactCodec>::attributeType());
  for (size_t i = 1; i < layout.rows.size(); ++i) {
    const Coord& ijk = g.ijk[size_t(layout.rows[i])];
    require(ijk != g.ijk[size_t(layout.rows[i - 1])], kWriteLatent, ": ", path, ": node ", ijk,
            " is there twice");
  }
  if (!layout.leaves.empty()) {
    PointTree& tree = *layout.tree;
    forEachAttribute(g, [&](const auto& c, auto value, auto codec) {
      appendAttribute<decltype(value), decltype(codec)>(tree, c.name, value,
                                                        openvdb::Index(c.width));
    });
    appendAttribute<int32_t, ExactCodec>(tree, kRow);
    tbb::parallel_for(size_t(0), layout.leaves.size(),
                      [&](size_t l) { fillLatentLeaf(g, layout.rows, layout.leaves[l]); });
    openvdb::points::compactAttributes(tree);
  }
  auto grid = PointGrid::create(layout.tree);
  grid->setTransform(fileTransform(g.frame, g.level));
  grid->insertMeta("point_count", openvdb::Int64Metadata(g.size()));
  std::string names = "P";
  forEachAttribute(g, [&](const auto& c, auto, auto) { names += joinText(" ", c.name); });
  grid->insertMeta("point_attributes", openvdb::StringMetadata(joinText(names, " ", kRow)));
  return grid;
}

std::string textOf(const Camera& c) {
  std::ostringstream out;
  out.precision(17);
  out << c.width << ' ' << c.height << ' ' << c.fx << ' ' << c.fy << ' ' << c.cx << ' ' << c.cy;
  for (int row = 0; row < 3; ++row)
    for (int col = 0; col < 4; ++col) out << ' ' << c.world_from_camera(row, col);
  return out.str();
}

Camera cameraOf(const std::string& text, const std::string& path) {
  Camera c;
  std::istringstream in(text);
  in >> c.width >> c.height >> c.fx >> c.fy >> c.cx >> c.cy;
  for (int row = 0; row < 3; ++row)
    for (int col = 0; col < 4; ++col) in >> c.world_from_camera.matrix()(row, col);
  const Eigen::Matrix3d turn = c.world_from_camera.linear();
  const bool sane = !in.fail() && c.width > 0 && c.height > 0 && c.width <= 32768 &&
                    c.height <= 32768 && c.fx > 0 && c.fy > 0 && c.fx < 1e9 && c.fy < 1e9 &&
                    std::abs(c.cx) < 1e9 && std::abs(c.cy) < 1e9 &&
                    (turn.transpose() * turn - Eigen::Matrix3d::Identity()).norm() < .01 &&
                    c.world_from_camera.translation().norm() < kMaxWorldM;
  require(sane, kReadLatent, ": ", path, ": expected a camera of 18 numbers, found '", text, "'");
  return c;
}

openvdb::MetaMap metadataOf(const Place& g) {
  openvdb::MetaMap metadata;
  metadata.insertMeta("creator", openvdb::StringMetadata("vdb_complete"));
  metadata.insertMeta(kHash, openvdb::StringMetadata(g.encoder_hash));
  if (!g.growth.empty()) metadata.insertMeta(kGrowth, openvdb::StringMetadata(g.growth));
  metadata.insertMeta(kLevel, openvdb::Int32Metadata(g.level));
  metadata.insertMeta(kLatentDim, openvdb::Int32Metadata(g.dim));
  insertVolume(g.frame, &metadata);
  openvdb::Mat4d frame;  // row vectors, as OpenVDB has them
  for (int row = 0; row < 4; ++row)
    for (int col = 0; col < 4; ++col) frame[row][col] = g.frame.world_from_grid.matrix()(col, row);
  metadata.insertMeta(kGridFrame, openvdb::Mat4DMetadata(frame));
  for (size_t i = 0; g.detail && i < g.cameras.size(); ++i)
    metadata.insertMeta(joinText(kCamera, i), openvdb::StringMetadata(textOf(g.cameras[i])));
  const auto observed = std::count(g.generated.begin(), g.generated.end(), uint8_t(0));
  metadata.insertMeta("observed_count", openvdb::Int64Metadata(int64_t(observed)));
  metadata.insertMeta("generated_count", openvdb::Int64Metadata(g.size() - observed));
  return metadata;
}

/// The frame bit for bit: a transform holds it as products, good to 15 digits only.
VoxelFrame exactFrame(const openvdb::MetaMap& metadata, const VoxelFrame& approximate,
                      const std::string& path) {
  const auto m = findMetadata<openvdb::Mat4d>(kReadLatent, metadata, kGridFrame, path);
  VoxelFrame frame = approximate;
  for (int row = 0; row < 4; ++row)
    for (int col = 0; col < 4; ++col) frame.world_from_grid.matrix()(col, row) = m[row][col];
  const Eigen::Matrix4d& expected = approximate.world_from_grid.matrix();
  const double error = (frame.world_from_grid.matrix() - expected).cwiseAbs().maxCoeff();
  require(error <= 1e-6 * std::max(1., expected.cwiseAbs().maxCoeff()), kReadLatent, ": ", path,
          ": expected the transform of the metadata '", kGridFrame, "', found one ", error, " off");
  return frame;
}

/// Leaves in tree order and the number of their points, at most one a node.
std::vector<const PointLeaf*> checkedLeaves(const PointGrid& grid, const Place& g, size_t* count,
                                            const std::string& path) {
  std::vector<const PointLeaf*> leaves;
  *count = 0;
  const auto requireAttribute = [&](const PointLeaf& leaf, const char* name, size_t width) {
    require(hasAttribute(leaf, name), kReadLatent, ": ", path, ": grid 'latent' has no attribute ",
            name);
    const auto stride = leaf.constAttributeArray(name).stride();
    require(size_t(stride) == width, kReadLatent, ": ", path, ": expected ", name, " with ", width,
            " values, found ", stride);
  };
  for (auto leaf = grid.tree().cbeginLeaf(); leaf; ++leaf) {
    const size_t points = checkedPointCount(kReadLatent, *leaf, path);
    openvdb::Index before = 0;
    for (openvdb::Index v = 0; v < PointLeaf::SIZE; ++v) {
      const auto end = openvdb::Index(leaf->getValue(v));
      require(end - before <= 1, kReadLatent, ": ", path, ": expected one point a node, found ",
              end - before, " at ", leaf->offsetToGlobalCoord(v));
      before = end;
    }
    if (points == 0) continue;
    forEachAttribute(g,
                     [&](const auto& c, auto, auto) { requireAttribute(*leaf, c.name, c.width); });
    requireAttribute(*leaf, kRow, 1);
    *count += points;
    require(int64_t(*count) * g.dim <= kMaxValues, kReadLatent, ": ", path, ": expected at most ",
            kMaxValues, " values, found more");
    leaves.push_back(&*leaf);
  }
  return leaves;
}

void readLeaf(const PointLeaf& leaf, std::vector<uint8_t>* taken, Place* g,
              const std::string& path) {
  const auto number = readHandle<int32_t>(leaf, kRow);
  std::vector<size_t> rows;  // of the leaf's points
  for (openvdb::Index v = 0; v < PointLeaf::SIZE; ++v) {
    if (size_t(leaf.getValue(v)) == rows.size()) continue;
    const int64_t row = number.get(openvdb::Index(rows.size()));
    require(row >= 0 && row < int64_t(taken->size()) && !(*taken)[size_t(row)], kReadLatent, ": ",
            path, ": expected each row from 0 to ", taken->size() - 1, " once, found ", row);
    (*taken)[size_t(row)] = 1;
    g->ijk[size_t(row)] = leaf.offsetToGlobalCoord(v);
    rows.push_back(size_t(row));
  }
  forEachAttribute(*g, [&](auto c, auto value, auto) {
    const auto handle = readHandle<decltype(value)>(leaf, c.name);
    for (size_t n = 0; n < rows.size(); ++n)
      for (size_t k = 0; k < c.width; ++k)
        c.values[rows[n] * c.width + k] = handle.get(openvdb::Index(n), openvdb::Index(k));
  });
}

void readTokens(const PointGrid& grid, Place* g, const std::string& path) {
  size_t n = 0;
  const std::vector<const PointLeaf*> leaves = checkedLeaves(grid, *g, &n, path);
  forEachColumn([&](auto c) { c.values.resize(n * c.width); }, *g);
  std::vector<uint8_t> taken(n, 0);
  for (const PointLeaf* leaf : leaves) readLeaf(*leaf, &taken, g, path);
  requireTokens(kReadLatent, *g, path);
}

}  // namespace

void writeLatentVdb(const Place& place, const std::string& path) {
  requireWritablePlace(place, path);
  openvdb::initialize();
  const std::pair<const char*, openvdb::GridBase::Ptr> named[] = {
      {kLatent, latentGrid(place, path)},
      {kFilled, gridOfMask(place.seen->filled)},
      {kEmpty, gridOfMask(place.seen->empty)},
  };
  const auto voxels = fileTransform(place.frame);
  openvdb::GridCPtrVec grids;
  for (const auto& [name, grid] : named) {
    grid->setName(name);
    grid->setCreator("vdb_complete");
    if (name != kLatent) grid->setTransform(voxels);
    grids.push_back(grid);
  }
  writeVdb(kWriteLatent, path, grids, metadataOf(place));
}

Place readLatentVdb(const std::string& path) {
  const auto [grids, metadata] = readVdb(kReadLatent, path, kMaxLatentBytes);
  const auto tokens = findGrid<PointGrid>(kReadLatent, grids, kLatent, path);
  const auto filled = findGrid<BoolGrid>(kReadLatent, grids, kFilled, path);
  const auto empty = findGrid<BoolGrid>(kReadLatent, grids, kEmpty, path);
  Place g;
  g.level = findMetadata<int32_t>(kReadLatent, metadata, kLevel, path);
  g.dim = findMetadata<int32_t>(kReadLatent, metadata, kLatentDim, path);
  require(g.level >= 0 && g.level < kTokenLevels && g.dim > 0 && g.dim <= kMaxLatentDim,
          kReadLatent, ": ", path, ": expected level 0-2 and dim 1-", kMaxLatentDim,
          ", found level ", g.level, ", dim ", g.dim);
  for (const auto& [grid, level] : {std::pair<const openvdb::GridBase*, int>(tokens.get(), g.level),
                                    {filled.get(), 0},
                                    {empty.get(), 0}})
    g.frame = exactFrame(metadata,
                         readVolume(kReadLatent, metadata, grid->transform(), level, path), path);
  g.encoder_hash = findMetadata<std::string>(kReadLatent, metadata, kHash, path);
  if (metadata[kGrowth]) g.growth = findMetadata<std::string>(kReadLatent, metadata, kGrowth, path);
  for (int i = 0; i < kMaxCameras && metadata[joinText(kCamera, i)]; ++i)
    g.cameras.push_back(cameraOf(
        findMetadata<std::string>(kReadLatent, metadata, joinText(kCamera, i).c_str(), path),
        path));
  try {
    readTokens(*tokens, &g, path);
  } catch (const openvdb::Exception& error) {  // an attribute of another type
    throw Error(joinText(kReadLatent, ": ", path, ": corrupt or unreadable: ", error.what()));
  }
  const auto seen = std::make_shared<SeenSpace>();
  seen->box = g.frame.bounds;
  seen->filled.root() = maskOfGrid(kReadLatent, *filled, g.frame.bounds, path).root();
  seen->empty.root() = maskOfGrid(kReadLatent, *empty, g.frame.bounds, path).root();
  g.seen = seen;
  return g;
}

}  // namespace vdbc
