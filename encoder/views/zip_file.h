#pragma once
// Private: zip archives, read as hostile files.
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <string>

struct zip;

namespace vdbc {

/// A zip archive open for reading; entries may be read from several threads. `operation` opens the
/// message of every Error.
class ZipFile {
 public:
  /// Throws Error if the file is missing or no zip archive.
  ZipFile(const char* operation, const std::string& path);

  const std::string& path() const { return path_; }
  /// Numbers by name.
  const std::map<std::string, uint64_t>& entries() const { return index_; }
  bool has(const std::string& name) const { return index_.count(name) > 0; }
  /// All bytes of an entry. Throws Error if it is missing, larger than `max_bytes` or corrupt.
  std::string read(const std::string& name, uint64_t max_bytes) const;
  /// Its size as the archive states it, and its first bytes, at most `count`.
  std::string readStart(const std::string& name, uint64_t count, uint64_t* size) const;

 private:
  struct Discard {
    void operator()(zip* archive) const;
  };
  std::string readBytes(const std::string& name, uint64_t count, uint64_t* size, bool whole) const;

  const char* operation_;
  std::string path_;
  uint64_t file_bytes_ = 0;
  std::unique_ptr<zip, Discard> zip_;
  std::map<std::string, uint64_t> index_;
  mutable std::mutex mutex_;  // libzip archives are not for several threads
};

}  // namespace vdbc
