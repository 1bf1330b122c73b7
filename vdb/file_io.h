#pragma once
// Whole files in, whole files out: sizes are checked before memory is taken, and a file appears
// under its name only when it is complete.
#include <unistd.h>

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <string>
#include <system_error>
#include <vector>

#include "vdb/error.h"

namespace vdbc {

/// All bytes of a regular file. `operation` opens the message of the Error that is thrown when it
/// is missing, not a file, larger than `max_bytes`, or unreadable.
inline std::vector<uint8_t> readFile(const char* operation, const std::string& path,
                                     uint64_t max_bytes) {
  std::error_code failure;
  const auto status = std::filesystem::status(path, failure);
  require(std::filesystem::exists(status), operation, ": ", path, ": no such file");
  require(std::filesystem::is_regular_file(status), operation, ": ", path,
          ": not a file (expected a regular file)");
  const uint64_t size = std::filesystem::file_size(path, failure);
  require(!failure, operation, ": ", path, ": ", failure.message());
  require(size <= max_bytes, operation, ": ", path, ": file is too large (expected at most ",
          max_bytes, " bytes, found ", size, ")");
  std::ifstream in(path, std::ios::binary);
  require(bool(in), operation, ": ", path, ": cannot open for reading");
  std::vector<uint8_t> bytes(size);
  in.read(reinterpret_cast<char*>(bytes.data()), std::streamsize(size));
  require(uint64_t(in.gcount()) == size, operation, ": ", path, ": cannot read (expected ", size,
          " bytes, found ", in.gcount(), ")");
  return bytes;
}

/// A name beside `path` to write to. commit() renames it to `path`; without commit() it is removed.
class TemporaryFile {
 public:
  TemporaryFile(const char* operation, const std::string& path)
      : operation_(operation), target_(path), path_(path + ".tmp" + std::to_string(getpid())) {}
  TemporaryFile(const TemporaryFile&) = delete;
  TemporaryFile& operator=(const TemporaryFile&) = delete;
  ~TemporaryFile() {
    std::error_code ignored;
    if (!committed_) std::filesystem::remove(path_, ignored);
  }

  const std::string& path() const { return path_; }

  void commit() {
    std::error_code failure;
    std::filesystem::rename(path_, target_, failure);
    require(!failure, operation_, ": ", target_, ": cannot rename from ", path_, ": ",
            failure.message());
    committed_ = true;
  }

 private:
  const char* operation_;
  std::string target_, path_;
  bool committed_ = false;
};

/// Writes all bytes under a temporary name, then renames. Throws Error naming `path`.
inline void writeFile(const char* operation, const std::string& path, const void* bytes,
                      size_t size) {
  TemporaryFile file(operation, path);
  std::ofstream out(file.path(), std::ios::binary);
  require(bool(out), operation, ": ", path, ": cannot create (is the folder there and writable?)");
  out.write(static_cast<const char*>(bytes), std::streamsize(size));
  out.close();
  require(bool(out), operation, ": ", path, ": cannot write ", size, " bytes (is the disk full?)");
  file.commit();
}

// OpenVDB's reader trusts sizes inside the file: flipped bits there make it write outside its
// buffers or abort. So our .vdb files end with a checksum, behind everything that OpenVDB looks at.
// Programs that write the file again drop it; such files are read without this check.
constexpr char kTrailerMagic[] = "vdbcsum1";
constexpr size_t kTrailerBytes = sizeof(kTrailerMagic) - 1 + sizeof(uint64_t);

/// FNV-1a, 64 bits; `hash`: of the bytes before these.
inline uint64_t fnv1a(const void* bytes, size_t size, uint64_t hash = 0xcbf29ce484222325u) {
  for (size_t i = 0; i < size; ++i)
    hash = (hash ^ static_cast<const uint8_t*>(bytes)[i]) * 0x100000001b3u;
  return hash;
}

/// 16 hexadecimal digits.
inline std::string hexOf(uint64_t number) {
  std::string text;
  for (int shift = 60; shift >= 0; shift -= 4) text += "0123456789abcdef"[number >> shift & 15];
  return text;
}

/// The magic word and fnv1a() of the bytes, little-endian.
inline std::string checksumTrailer(const void* bytes, size_t size) {
  const uint64_t hash = fnv1a(bytes, size);
  std::string trailer(kTrailerMagic);
  for (int byte = 0; byte < 8; ++byte) trailer.push_back(char(hash >> (8 * byte)));
  return trailer;
}

/// False if `bytes` end with a trailer that does not match what is before it.
inline bool checksumMatches(const std::vector<uint8_t>& bytes) {
  if (bytes.size() < kTrailerBytes) return true;
  const size_t end = bytes.size() - kTrailerBytes;
  const std::string found(bytes.begin() + std::ptrdiff_t(end), bytes.end());
  if (found.compare(0, sizeof(kTrailerMagic) - 1, kTrailerMagic) != 0) return true;
  return found == checksumTrailer(bytes.data(), end);
}

}  // namespace vdbc
