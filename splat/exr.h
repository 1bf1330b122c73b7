#pragma once
// OpenEXR pictures with their camera.
#include <cstddef>
#include <string>
#include <vector>

#include "vdb/camera.h"

namespace vdbc {

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
