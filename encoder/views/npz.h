#pragma once
// Private: arrays of NumPy's .npz files (a zip archive of .npy members, stored or deflated).
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "encoder/views/zip_file.h"

namespace vdbc {

/// Numbers in C order: value i of the flattened array.
struct NpyArray {
  std::string name;
  std::vector<int64_t> shape;
  int word = 4;       // bytes a value: 2, 4, 8 of a float; 1 is uint8
  std::string bytes;  // little-endian values, from `begin` on
  size_t begin = 0;

  double at(size_t i) const;
};

/// An .npz file. Throws Error, always with the operation and the path in front.
class NpzFile {
 public:
  NpzFile(const char* operation, const std::string& path)
      : zip_(operation, path), operation_(operation) {}

  const std::string& path() const { return zip_.path(); }
  /// Type and shape of an array without its values; nothing if it is not there or holds pickled
  /// objects, which are never read. Throws unless it is float16, 32, 64 or uint8, little-endian, in
  /// C order, and as long as its shape says.
  std::optional<NpyArray> describe(const std::string& name) const;
  /// The same with its values.
  std::optional<NpyArray> read(const std::string& name) const;

 private:
  ZipFile zip_;
  const char* operation_;
};

}  // namespace vdbc
