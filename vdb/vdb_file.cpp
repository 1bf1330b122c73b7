#include "vdb/vdb_file.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/Stream.h>
#include <openvdb/math/Maps.h>
#include <openvdb/openvdb.h>

#include <algorithm>
#include <cmath>
#include <sstream>

#include "vdb/file_io.h"

namespace vdbc {
namespace {

constexpr const char* kVoxelM = "voxel_m";
constexpr const char* kVolumeMin = "volume_min";
constexpr const char* kVolumeMax = "volume_max";

/// Writes to any stream; OpenVDB's File does not look whether everything arrived on the disk.
class SeekableArchive : public openvdb::io::Archive {
 public:
  void writeTo(std::ostream& out, const openvdb::GridCPtrVec& grids,
               const openvdb::MetaMap& metadata) const {
    openvdb::io::Archive::write(out, grids, /*seekable=*/true, metadata);
  }
};

/// A view of bytes as a stream, without a copy.
class MemoryBuffer : public std::streambuf {
 public:
  explicit MemoryBuffer(const std::vector<uint8_t>& bytes) {
    char* begin = reinterpret_cast<char*>(const_cast<uint8_t*>(bytes.data()));  // only read
    setg(begin, begin, begin + bytes.size());
  }

 protected:
  pos_type seekoff(off_type offset, std::ios_base::seekdir from, std::ios_base::openmode) override {
    const off_type base = from == std::ios_base::beg   ? 0
                          : from == std::ios_base::cur ? gptr() - eback()
                                                       : egptr() - eback();
    if (base + offset < 0 || base + offset > egptr() - eback()) return pos_type(off_type(-1));
    setg(eback(), eback() + base + offset, egptr());
    return base + offset;
  }
  pos_type seekpos(pos_type position, std::ios_base::openmode mode) override {
    return seekoff(off_type(position), std::ios_base::beg, mode);
  }
};

/// OpenVDB names each file by a random UUID. Ours are named by their content: the same place gives
/// the same bytes.
void nameByContent(std::string* archive) {
  constexpr size_t kUuidAt = 21, kUuidBytes = 36;  // behind magic, three versions and a flag; ASCII
  archive->replace(kUuidAt, kUuidBytes, kUuidBytes, '0');
  const std::string sum = hexOf(fnv1a(archive->data(), archive->size()));
  std::string name;
  for (size_t i = 0; name.size() < kUuidBytes; ++i) {
    const bool dash =
        name.size() == 8 || name.size() == 13 || name.size() == 18 || name.size() == 23;
    if (dash) name += '-';
    name += sum[i % sum.size()];
  }
  archive->replace(kUuidAt, kUuidBytes, name);
}

}  // namespace

void writeVdb(const char* operation, const std::string& path, const openvdb::GridCPtrVec& grids,
              const openvdb::MetaMap& metadata) {
  std::ostringstream archive;
  SeekableArchive().writeTo(archive, grids, metadata);
  std::string bytes = archive.str();
  nameByContent(&bytes);
  bytes += checksumTrailer(bytes.data(), bytes.size());
  writeFile(operation, path, bytes.data(), bytes.size());
}

VdbFile readVdb(const char* operation, const std::string& path, uint64_t max_bytes) {
  openvdb::initialize();
  const std::vector<uint8_t> bytes = readFile(operation, path, max_bytes);
  // OpenVDB trusts the sizes inside a file: flipped bits make it write outside its buffers.
  require(checksumMatches(bytes), operation, ": ", path, ": corrupt (its checksum does not match)");
  try {
    MemoryBuffer buffer(bytes);
    std::istream in(&buffer);
    // OpenVDB does not look whether a read succeeded; a stream that throws at its end does.
    in.exceptions(std::ios::failbit | std::ios::badbit | std::ios::eofbit);
    openvdb::io::Stream stream(in, /*delayLoad=*/false);
    return {*stream.getGrids(), *stream.getMetadata()};
  } catch (const std::exception& e) {
    std::string message = e.what();
    std::replace(message.begin(), message.end(), '\n', ' ');
    throw Error(joinText(operation, ": ", path,
                         ": expected a complete OpenVDB file, found one that is cut off, corrupt "
                         "or of another kind (",
                         message, ")"));
  }
}

openvdb::math::Transform::Ptr fileTransform(const VoxelFrame& frame, int level) {
  const double edge = double(frame.voxel_m) * (1 << level);
  const Eigen::Matrix3d scaled = frame.world_from_grid.linear() * edge;
  const Eigen::Vector3d centre = frame.toWorld(Eigen::Vector3d::Constant(0.5 * (1 << level)));
  openvdb::Mat4d m = openvdb::Mat4d::identity();
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) m[row][col] = scaled(col, row);
    m[3][row] = centre[row];
  }
  // simplify(): without rotation it is a plain scale and translation, which more tools understand.
  return std::make_shared<openvdb::math::Transform>(
      openvdb::math::simplify(std::make_shared<openvdb::math::AffineMap>(m)));
}

void insertVolume(const VoxelFrame& frame, openvdb::MetaMap* metadata) {
  metadata->insertMeta(kVoxelM, openvdb::FloatMetadata(frame.voxel_m));
  metadata->insertMeta(kVolumeMin, openvdb::Vec3IMetadata(frame.bounds.min().asVec3i()));
  metadata->insertMeta(kVolumeMax, openvdb::Vec3IMetadata(frame.bounds.max().asVec3i()));
}

VoxelFrame readVolume(const char* operation, const openvdb::MetaMap& metadata,
                      const openvdb::math::Transform& transform, int level,
                      const std::string& path) {
  VoxelFrame frame;
  frame.voxel_m = findMetadata<float>(operation, metadata, kVoxelM, path);
  require(std::isfinite(frame.voxel_m) && frame.voxel_m > 0, operation, ": ", path,
          ": expected a positive voxel size, found ", frame.voxel_m);
  require(transform.isLinear(), operation, ": ", path, ": expected a linear transform");
  const double edge = double(frame.voxel_m) * (1 << level);
  const openvdb::Mat4d m = transform.baseMap()->getAffineMap()->getMat4();  // row vectors
  Eigen::Matrix3d rotation;
  Eigen::Vector3d centre;
  for (int row = 0; row < 3; ++row) {
    for (int col = 0; col < 3; ++col) rotation(col, row) = m[row][col] / edge;
    centre[row] = m[3][row];
  }
  const double error = (rotation.transpose() * rotation - Eigen::Matrix3d::Identity()).norm();
  require(error < 1e-4 && rotation.determinant() > 0 && centre.allFinite(), operation, ": ", path,
          ": expected a rotation with voxels of ", edge, " m, found another transform");
  frame.world_from_grid.linear() = rotation;
  frame.world_from_grid.translation() = centre - rotation * Eigen::Vector3d::Constant(0.5 * edge);

  const Coord low(findMetadata<openvdb::Vec3i>(operation, metadata, kVolumeMin, path));
  const Coord high(findMetadata<openvdb::Vec3i>(operation, metadata, kVolumeMax, path));
  for (int axis = 0; axis < 3; ++axis)
    require(std::abs(int64_t(low[axis])) <= kMaxVolumeIndex && int64_t(low[axis]) <= high[axis] &&
                int64_t(high[axis]) - low[axis] < kMaxVolumeSide,
            operation, ": ", path, ": expected a volume of 1 to ", kMaxVolumeSide,
            " voxels a side, found ", low, " to ", high);
  frame.bounds = CoordBBox(low, high);
  return frame;
}

BoolGrid::Ptr gridOfMask(const TokenMask& mask) {
  auto grid = BoolGrid::create();
  auto accessor = grid->getUnsafeAccessor();
  for (auto value = mask.cbeginValueOn(); value; ++value) {
    CoordBBox box;
    value.getBoundingBox(box);
    if (value.isVoxelValue())
      accessor.setValueOn(box.min(), true);
    else
      grid->tree().sparseFill(box, true, true);
  }
  grid->tree().prune();
  return grid;
}

TokenMask maskOfGrid(const char* operation, const BoolGrid& grid, const CoordBBox& bounds,
                     const std::string& path) {
  TokenMask mask;
  for (auto value = grid.cbeginValueOn(); value; ++value) {
    CoordBBox box;
    value.getBoundingBox(box);
    require(bounds.isInside(box), operation, ": ", path, ": voxels ", box, " of grid '",
            grid.getName(), "' lie outside the volume ", bounds);
    mask.sparseFill(box, true, true);
  }
  return mask;
}

}  // namespace vdbc
