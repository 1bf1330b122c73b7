#pragma once
// Private: what all readers of views share.
#include <tbb/parallel_for.h>

#include <exception>
#include <string>
#include <vector>

#include "encoder/views/read_views.h"
#include "vdb/error.h"

namespace vdbc {

constexpr const char* kReadViews = "readViews";
constexpr float kFarDepth = 1e9f;  // renderers fill empty pixels with 1e10 and the like

/// The rigid transform nearest to `m`: the rotation of its polar decomposition. Throws Error unless
/// m is rigid up to 5e-3: poses in the wild have as few as four decimals.
Eigen::Isometry3d rigid(const Eigen::Matrix4d& m, const std::string& path, const std::string& what);

/// Planar depth from world positions [H, W, 3]; a point that does not reproject into its own pixel
/// is none.
std::vector<float> depthFromPositions(const Image& positions, const Camera& camera);

/// Throws Error unless some pixel has depth.
void requireDepth(const View& view, const std::string& path);

/// Which of `count` frames to read, checked.
std::vector<size_t> selectFrames(const ReadViewsSettings& settings, size_t count,
                                 const std::string& path);

/// Reads frames in parallel; of several errors the first frame's is thrown, whatever the threads
/// do.
template <typename ReadOne>
std::vector<View> readAll(const std::vector<size_t>& frames, const ReadOne& readOne) {
  std::vector<View> views(frames.size());
  std::vector<std::exception_ptr> errors(frames.size());
  tbb::parallel_for(size_t(0), frames.size(), [&](size_t i) {
    try {
      views[i] = readOne(frames[i]);
    } catch (...) {
      errors[i] = std::current_exception();
    }
  });
  for (const auto& error : errors) {
    if (error) std::rethrow_exception(error);
  }
  return views;
}

/// One or three channels as three.
Image threeChannels(Image image);

/// Views of a transforms.json (transforms_json.cpp).
std::vector<View> readTransforms(const std::string& path, const ReadViewsSettings& settings);
/// +Z of the file's frame in the frame before its applied_transform.
Eigen::Vector3d transformsUp(const std::string& path);

/// The view of one EXR file, named `name` (exr_views.cpp).
View readExrView(const std::string& path, const std::string& name,
                 const ReadViewsSettings& settings);

/// Views of an .npz (pointmaps.cpp; docs/formats.md).
std::vector<View> readPointmaps(const std::string& path, const ReadViewsSettings& settings);
/// Mean of the cameras' up axes.
Eigen::Vector3d pointmapUp(const std::string& path);

/// Up to 12 views of a .vdb's level set or fog volume by casting rays from cameras in its free
/// space, the same ones each time (volume_views.cpp; docs/formats.md). Pixels that meet no surface
/// have no depth. Throws Error also where there is no place for a camera.
std::vector<View> readVolumeViews(const std::string& path, const ReadViewsSettings& settings);
/// What is up in the volume's world by the program that wrote it.
Eigen::Vector3d volumeUp(const std::string& path);

}  // namespace vdbc
