#pragma once
// What every reader of our .vdb files must stand: cut, flipped and foreign files.
#include <gtest/gtest.h>
#include <openvdb/io/File.h>

#include <map>
#include <random>

#include "tests/files.h"
#include "vdb/error.h"

namespace vdbc {

/// Behind what OpenVDB reads; other programs drop it.
constexpr size_t kTrailerBytes = 16;

/// Cuts the file at each of its first 300 and last 8 bytes before the trailer and at every
/// `stride`th between.
template <typename Read>
void expectEveryTruncationThrows(const std::string& file, const std::string& cut, size_t stride,
                                 Read read) {
  const std::string bytes = bytesOf(file);
  ASSERT_GT(bytes.size(), 1000u);
  const size_t grids = bytes.size() - kTrailerBytes;
  for (size_t n = 0; n < grids; n += n < 300 || n + 8 > grids ? 1 : stride) {
    writeBytes(cut, bytes.substr(0, n));
    EXPECT_THROW(read(cut), Error) << n << " of " << bytes.size();
  }
}

/// Flips 300 random bits, one at a time.
template <typename Read>
void expectEveryCorruptionThrows(const std::string& file, const std::string& bad_file, Read read) {
  const std::string bytes = bytesOf(file);
  std::mt19937 random(4);
  for (int i = 0; i < 300; ++i) {
    std::string bad = bytes;
    const size_t at = random() % (bad.size() - kTrailerBytes);
    bad[at] = char(bad[at] ^ (1 << i % 8));
    writeBytes(bad_file, bad);
    EXPECT_THROW(read(bad_file), Error) << "byte " << at;
  }
}

using Grids = std::map<std::string, openvdb::GridBase::Ptr>;

/// The file as another program would write it again after `change`.
template <typename Change>
void rewriteVdb(const std::string& from, const std::string& to, Change change) {
  openvdb::io::File file(from);
  file.open(false);
  openvdb::MetaMap metadata = *file.getMetadata();
  const openvdb::GridPtrVecPtr grids = file.getGrids();
  Grids by_name;
  for (const auto& grid : *grids) by_name[grid->getName()] = grid;
  change(by_name, metadata);
  openvdb::GridPtrVec changed;
  for (const auto& [name, grid] : by_name) changed.push_back(grid);
  openvdb::io::File(to).write(changed, metadata);
}

}  // namespace vdbc
