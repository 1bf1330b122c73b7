#pragma once
// OpenEXR pictures with their camera. Names of channels and frames of cameras that other programs
// use are for those who read their files (encoder/views/exr_views.cpp).
#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "splat/image.h"
#include "vdb/camera.h"

namespace vdbc {

/// An OpenEXR file in memory. Its parts that are flat pictures (not deep) can be read. Every Error
/// is opened by `operation` and `name`.
class ExrFile {
 public:
  /// Throws Error where the bytes are no EXR.
  ExrFile(const char* operation, const std::string& name, std::vector<uint8_t> bytes);
  ~ExrFile();

  int parts() const;
  /// Names of a part's channels, sorted; none of a deep part.
  const std::vector<std::string>& channels(int part) const;
  bool hasChannel(int part, const std::string& channel) const;

  /// Whether two parts show the same window of the picture's plane.
  bool sameWindow(int part, int other) const;
  /// Pixels of a part's display window. Throws Error where that is none, or more than 2^28 or than
  /// the file could hold.
  void size(int part, int* width, int* height) const;
  /// Values of channels over the display window, [height, width, channels]; `outside` where the
  /// file holds no pixels. Throws Error on corrupt or subsampled channels.
  Image read(int part, const std::vector<std::string>& channels, float outside) const;

  /// A matrix among the attributes of any part, for column vectors (OpenEXR keeps it for rows).
  std::optional<Eigen::Matrix4d> matrix(const char* attribute) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

/// A channel of an EXR: values[i * stride] of pixel i, row-major from the top. Scene-linear for
/// colours, metres for Z.
struct ExrChannel {
  std::string name;  // R, G, B, A, Z, N.X, ...
  const float* values = nullptr;
  size_t stride = 1;
  bool is_half = true;  // stored as half, else as float
};

/// Planar Z of a pixel without depth, as Blender writes it.
constexpr float kNoDepth = 1e10f;

/// One EXR with spec-conforming worldToCamera and worldToNDC. Temporary name, then rename. Throws
/// Error.
void writeExr(const Camera& camera, const std::vector<ExrChannel>& channels,
              const std::string& path);

}  // namespace vdbc
