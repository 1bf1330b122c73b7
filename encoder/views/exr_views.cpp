// Views from OpenEXR files of renderers (docs/formats.md, Views).
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>

#include "encoder/views/view_reading.h"
#include "splat/exr.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

/// Channels of one part that belong together.
struct ChannelSet {
  int part = -1;
  std::vector<std::string> names;
  bool found() const { return part >= 0; }
};

bool endsWith(const std::string& text, const std::string& ending) {
  return text.size() >= ending.size() &&
         text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

/// What stands before a suffix in the names of a part that `pattern` takes.
std::vector<std::string> stemsOf(const ExrFile& file, int part, const std::string& pattern,
                                 const std::string& suffix) {
  if (pattern[0] != '*') {
    // X, Y, Z of a part of positions or normals are coordinates, not depth.
    const bool vectors = file.hasChannel(part, "X") && file.hasChannel(part, "Y");
    if (pattern == "Z" && vectors) return {};
    return {pattern};
  }
  std::vector<std::string> stems;
  for (const std::string& name : file.channels(part))
    if (endsWith(name, pattern.substr(1) + suffix))
      stems.push_back(name.substr(0, name.size() - suffix.size()));
  return stems;
}

/// The first of `patterns` that any part has, with each of `suffixes` appended. A pattern "*.Layer"
/// takes any layer whose name ends in ".Layer" (view layers of Blender and others).
ChannelSet findChannels(const ExrFile& file, const std::vector<std::string>& patterns,
                        const std::vector<std::string>& suffixes) {
  for (const std::string& pattern : patterns) {
    for (int part = 0; part < file.parts(); ++part) {
      for (const std::string& stem : stemsOf(file, part, pattern, suffixes[0])) {
        ChannelSet set{part, {}};
        for (const std::string& suffix : suffixes)
          if (file.hasChannel(part, stem + suffix)) set.names.push_back(stem + suffix);
        if (set.names.size() == suffixes.size()) return set;
      }
    }
  }
  return {};
}

/// What of a file makes a view; sets that it lacks are not found.
struct ViewChannels {
  ChannelSet colour;    // R, G, B or Y
  ChannelSet alpha;     // of the colour
  ChannelSet position;  // world
  ChannelSet z;         // planar depth
};

ViewChannels findViewChannels(const ExrFile& file) {
  ViewChannels c;
  c.colour = findChannels(file, {"", "*.Combined.", "rgba.", "beauty.", "C."}, {"R", "G", "B"});
  if (!c.colour.found()) c.colour = findChannels(file, {"Y"}, {""});
  if (c.colour.found()) {
    const std::string& red = c.colour.names[0];
    c.alpha = findChannels(file, {red.substr(0, red.size() - 1) + "A"}, {""});
  }
  c.position = findChannels(file, {"P.", "*.Position."}, {"X", "Y", "Z"});
  const ChannelSet lower = findChannels(file, {"P."}, {"x", "y", "z"});
  if (lower.found() && (!c.position.found() || c.position.names[0] != "P.X")) c.position = lower;
  c.z = findChannels(file, {"Z", "depth.Z", "*.Depth.Z", "depth", "Pz"}, {""});
  return c;
}

/// Sets the intrinsics of a camera of known size. `p` is the NDC of the camera's own axes (x right,
/// y up, z forward): u = (a x + b z) / z, v = (c y + d z) / z. NDC ends in [0, 1] from the upper
/// left by the specification, in [-1, 1] with y up by several renderers.
void setIntrinsics(const Eigen::Matrix4d& p, const std::string& path, Camera* camera) {
  const double s = p(3, 2), a = p(0, 0) / s, b = p(0, 2) / s, c = p(1, 1) / s, d = p(1, 2) / s;
  const double sign_a = a < 0 ? -1 : 1, sign_c = c < 0 ? -1 : 1;
  // By the specification u grows with x and v falls with y. [-1, 1] ranges have y up, so both
  // grow (or, where w = -z, both fall), or at least a principal point near 0.
  if (sign_a == sign_c || (std::abs(b) < 0.25 && std::abs(d) < 0.25)) {
    camera->fx = std::abs(a) * camera->width / 2, camera->cx = (1 + b * sign_a) * camera->width / 2;
    camera->fy = std::abs(c) * camera->height / 2;
    camera->cy = (1 - d * sign_c) * camera->height / 2;
  } else {
    camera->fx = a * camera->width, camera->cx = b * camera->width;
    camera->fy = -c * camera->height, camera->cy = d * camera->height;
  }
  require(std::isfinite(camera->fx + camera->fy + camera->cx + camera->cy) && camera->fx > 1e-6 &&
              camera->fy > 1e-6,
          kReadViews, ": ", path, ": worldToNDC gives no focal length (found ", camera->fx, ", ",
          camera->fy, " pixels)");
  // A worldToNDC made for another camera would move points sideways with x and y, or lose them in
  // w.
  const double stray =
      std::max({std::abs(p(0, 1)), std::abs(p(1, 0)), std::abs(p(3, 0)), std::abs(p(3, 1))}) /
      std::abs(s);
  require(stray < 1e-3 * std::max({1.0, std::abs(a), std::abs(c)}), kReadViews, ": ", path,
          ": worldToCamera and worldToNDC belong to different cameras (skew of ", stray, ")");
}

/// The camera of worldToCamera, whose axes are x right, y up, z forward (left-handed), and
/// worldToNDC.
Camera exrCamera(const ExrFile& file, int width, int height, const std::string& path) {
  const auto view = file.matrix("worldToCamera"), ndc = file.matrix("worldToNDC");
  require(view && ndc, kReadViews, ": ", path,
          ": no camera (expected attributes worldToCamera and worldToNDC, found ",
          view  ? "only worldToCamera"
          : ndc ? "only worldToNDC"
                : "neither",
          ")");
  require(view->allFinite() && ndc->allFinite(), kReadViews, ": ", path,
          ": worldToCamera or worldToNDC is not finite");
  const bool is_left_handed = view->topLeftCorner<3, 3>().determinant() < 0;
  Eigen::Matrix4d cv_from_world = *view;
  cv_from_world.row(1) *= -1;                       // y down
  if (!is_left_handed) cv_from_world.row(2) *= -1;  // OpenGL's: the same axes but looking along -z

  Camera camera;
  camera.width = width, camera.height = height;
  camera.world_from_camera = rigid(cv_from_world, path, "worldToCamera").inverse();
  Eigen::Matrix4d world_from_axes = camera.world_from_camera.matrix();
  world_from_axes.col(1) *= -1;
  const Eigen::Matrix4d ndc_from_axes = *ndc * world_from_axes;
  const double s = ndc_from_axes(3, 2);
  require(std::abs(s) > 1e-6, kReadViews, ": ", path,
          ": worldToNDC is not a perspective projection that fits worldToCamera");
  require(
      s > 0 || is_left_handed, kReadViews, ": ", path,
      ": worldToCamera is right-handed but looks along +z (expected OpenEXR's left-handed axes)");
  setIntrinsics(ndc_from_axes, path, &camera);
  return camera;
}

/// Planar depth [height * width], 0 where there is none.
template <typename ReadChannels>
std::vector<float> exrDepth(const ViewChannels& channels, const Camera& camera,
                            const ReadChannels& read) {
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  std::vector<float> depth;
  if (channels.position.found()) depth = depthFromPositions(read(channels.position, kNaN), camera);
  // Some renderers' P is in camera space: then no point falls into its pixel, and Z has to serve.
  const auto isMeasured = [](float z) { return z > 0; };
  if (channels.z.found() && std::none_of(depth.begin(), depth.end(), isMeasured)) {
    depth = read(channels.z, 0.f).data;
    for (float& z : depth)
      if (!(z > 0 && z < kFarDepth)) z = 0;
  }
  // Depth of a partly covered pixel mixes the object's with the background's.
  if (channels.alpha.found()) {
    const Image coverage = read(channels.alpha, 0.f);
    for (size_t i = 0; i < depth.size(); ++i)
      if (!(coverage.data[i] >= 0.999f)) depth[i] = 0;
  }
  return depth;
}

}  // namespace

View readExrView(const std::string& path, const std::string& name,
                 const ReadViewsSettings& settings) {
  const ExrFile file(kReadViews, path, readFile(kReadViews, path, kMaxImageBytes));
  const ViewChannels channels = findViewChannels(file);
  require(channels.colour.found() || settings.cameras_only, kReadViews, ": ", path,
          ": no colour (expected channels R, G, B)");
  require(channels.position.found() || channels.z.found() || settings.cameras_only, kReadViews,
          ": ", path, ": no depth (expected channels P.X P.Y P.Z or Z)");
  int width = 0, height = 0;
  const int part = std::max(0, channels.colour.part);
  file.size(part, &width, &height);

  View view;
  view.name = name;
  view.camera = exrCamera(file, width, height, path);
  if (settings.cameras_only) return view;
  const auto read = [&](const ChannelSet& set, float outside) {
    require(file.sameWindow(set.part, part), kReadViews, ": ", path, ": channels ",
            channels.colour.names[0], " and ", set.names[0], " have different display windows");
    return file.read(set.part, set.names, outside);
  };
  view.colour = threeChannels(read(channels.colour, 0.f));
  for (float& v : view.colour.data) v = v > 0 ? srgbFromLinear(std::min(v, 1.f)) : 0.f;  // NaN: 0
  view.depth = exrDepth(channels, view.camera, read);
  requireDepth(view, path);
  return view;
}

}  // namespace vdbc
