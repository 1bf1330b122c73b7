#include "encoder/views/zip_file.h"

#include <zip.h>

#include <algorithm>
#include <filesystem>

#include "vdb/error.h"

namespace vdbc {

void ZipFile::Discard::operator()(zip* archive) const { zip_discard(archive); }

ZipFile::ZipFile(const char* operation, const std::string& path)
    : operation_(operation), path_(path) {
  std::error_code failure;
  file_bytes_ = std::filesystem::file_size(path, failure);
  require(!failure, operation, ": ", path, ": ", failure.message());
  int code = 0;
  zip_.reset(zip_open(path.c_str(), ZIP_RDONLY, &code));
  if (!zip_) {
    zip_error_t error;
    zip_error_init_with_code(&error, code);
    const std::string reason = zip_error_strerror(&error);
    zip_error_fini(&error);
    throw Error(joinText(operation, ": ", path, ": expected a zip file, found: ", reason));
  }
  const zip_int64_t count = zip_get_num_entries(zip_.get(), 0);
  for (zip_int64_t i = 0; i < count; ++i)
    if (const char* name = zip_get_name(zip_.get(), zip_uint64_t(i), 0))
      index_.emplace(name, zip_uint64_t(i));
}

std::string ZipFile::read(const std::string& name, uint64_t max_bytes) const {
  uint64_t size = 0;
  return readBytes(name, max_bytes, &size, true);
}

std::string ZipFile::readStart(const std::string& name, uint64_t count, uint64_t* size) const {
  return readBytes(name, count, size, false);
}

std::string ZipFile::readBytes(const std::string& name, uint64_t count, uint64_t* size,
                               bool whole) const {
  const auto entry = index_.find(name);
  require(entry != index_.end(), operation_, ": ", path_, ": no entry ", name);
  const std::lock_guard<std::mutex> lock(mutex_);
  zip_stat_t stat;
  const bool has_size =
      zip_stat_index(zip_.get(), entry->second, 0, &stat) == 0 && (stat.valid & ZIP_STAT_SIZE) != 0;
  require(has_size, operation_, ": ", path_, ": ", name, ": no size");
  *size = stat.size;
  require(!whole || stat.size <= count, operation_, ": ", path_, ": ", name,
          ": entry is too large (expected at most ", count, " bytes, found ", stat.size, ")");
  // Deflate packs 1,032 bytes into one at best: where the directory lies, take no memory for it.
  require(stat.size / 1032 <= file_bytes_, operation_, ": ", path_, ": ", name, ": ", file_bytes_,
          " bytes are too few for an entry of ", stat.size);
  const std::unique_ptr<zip_file_t, int (*)(zip_file_t*)> file(
      zip_fopen_index(zip_.get(), entry->second, 0), zip_fclose);
  require(bool(file), operation_, ": ", path_, ": ", name, ": ", zip_strerror(zip_.get()));
  std::string bytes(std::min<uint64_t>(stat.size, count), '\0');
  const zip_int64_t got = zip_fread(file.get(), bytes.data(), bytes.size());
  char more = 0;  // only reading up to the end checks the checksum
  require(got == zip_int64_t(bytes.size()) && (!whole || zip_fread(file.get(), &more, 1) == 0),
          operation_, ": ", path_, ": ", name, ": corrupt entry (expected ", bytes.size(),
          " bytes, found ", got, ")");
  return bytes;
}

}  // namespace vdbc
