#include "encoder/views/read_views.h"

#include <algorithm>
#include <filesystem>

#include "encoder/views/view_reading.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

/// What a path given to readViews() holds.
struct Source {
  std::string transforms;      // the transforms.json, or
  std::vector<fs::path> exrs;  // EXR files, sorted by name, or
  std::string pointmaps;       // the .npz, or
  std::string volume;          // the .vdb
};

Source findSource(const std::string& path) {
  std::error_code failure;
  const auto status = fs::status(path, failure);
  require(fs::exists(status), kReadViews, ": ", path, ": no such file or folder");
  Source source;
  if (fs::is_directory(status)) {
    const fs::path transforms = fs::path(path) / "transforms.json";
    if (fs::exists(transforms, failure)) {
      source.transforms = transforms.string();
      return source;
    }
    for (const auto& entry : fs::directory_iterator(path, failure)) {
      if (entry.path().extension() == ".exr") source.exrs.push_back(entry.path());
    }
    require(!failure, kReadViews, ": ", path, ": ", failure.message());
    std::sort(source.exrs.begin(), source.exrs.end());
    require(!source.exrs.empty(), kReadViews, ": ", path,
            ": no views (expected transforms.json or .exr files in the folder)");
    return source;
  }
  const std::string extension = fs::path(path).extension().string();
  if (extension == ".json") {
    source.transforms = path;
  } else if (extension == ".exr") {
    source.exrs.push_back(path);
  } else if (extension == ".npz") {
    source.pointmaps = path;
  } else if (extension == ".vdb") {
    source.volume = path;
  } else {
    throw Error(
        joinText(kReadViews, ": ", path,
                 ": expected a folder, a transforms.json, an .exr, an .npz or a .vdb file"));
  }
  return source;
}

}  // namespace

std::vector<View> readViews(const std::string& path, const ReadViewsSettings& settings) {
  const Source source = findSource(path);
  if (!source.pointmaps.empty()) return readPointmaps(path, settings);
  require(settings.metres_per_unit == 0, kReadViews, ": ", path,
          ": is in metres already (expected a scale for .npz only)");
  if (!source.volume.empty()) return readVolumeViews(path, settings);
  if (!source.transforms.empty()) return readTransforms(source.transforms, settings);
  return readAll(selectFrames(settings, source.exrs.size(), path), [&](size_t i) {
    return readExrView(source.exrs[i].string(), source.exrs[i].filename().string(), settings);
  });
}

Eigen::Vector3d conventionalUp(const std::string& path) {
  const Source source = findSource(path);
  if (!source.pointmaps.empty()) return pointmapUp(path);
  if (!source.volume.empty()) return volumeUp(path);
  if (source.transforms.empty()) return Eigen::Vector3d::UnitY();
  return transformsUp(source.transforms);
}

}  // namespace vdbc
