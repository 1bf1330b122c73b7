#pragma once
// Scratch folders, whole files and other programs, for tests of files.
#include <array>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>

namespace vdbc {

struct TemporaryFolder {
  std::filesystem::path path;
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "vdbc_test.XXXXXX").string();
    path = mkdtemp(name.data());
  }
  ~TemporaryFolder() { std::filesystem::remove_all(path); }
  std::string operator/(const std::string& name) const { return (path / name).string(); }
};

/// The networks that come with the program.
inline const std::string kWeights = VDBC_SOURCE_DIR "/weights/indoor";

inline std::string bytesOf(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}
inline void writeBytes(const std::string& path, const std::string& bytes) {
  std::filesystem::remove(path);  // ext4 flushes a file that is truncated and written again
  std::ofstream(path, std::ios::binary) << bytes;
}

/// Data that is too large for the repository, or "" where it is not on this machine.
inline std::string sharedFile(const std::string& name) {
  const char* shared = std::getenv("VDBC_SHARED");
  const std::string path = std::string(shared ? shared : VDBC_SOURCE_DIR "/../shared") + "/" + name;
  return std::filesystem::exists(path) ? path : "";
}

/// Standard output and error of a command, or nothing where it failed.
inline std::string outputOf(const std::string& command) {
  std::string text;
  FILE* pipe = popen((command + " 2>&1").c_str(), "r");
  if (!pipe) return {};
  std::array<char, 4096> buffer;
  while (size_t n = fread(buffer.data(), 1, buffer.size(), pipe)) text.append(buffer.data(), n);
  return pclose(pipe) == 0 ? text : std::string();
}

inline bool installed(const std::string& program) {
  return !outputOf("command -v " + program).empty();
}

}  // namespace vdbc
