// Views from OpenEXR files of renderers (docs/formats.md, Views).
// OpenEXR's headers include each other by bare name; its CMake target provides the folder.
#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfInputPart.h>
#include <ImfMatrixAttribute.h>
#include <ImfMultiPartInputFile.h>
#include <ImfPartType.h>

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <optional>

#include "encoder/views/view_reading.h"

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

bool isFlat(const Imf::Header& header) {
  return !header.hasType() || header.type() == Imf::SCANLINEIMAGE ||
         header.type() == Imf::TILEDIMAGE;
}

/// The first of `patterns` that any part has, with each of `suffixes` appended. A pattern "*.Layer"
/// takes any layer whose name ends in ".Layer" (view layers of Blender and others).
ChannelSet findChannels(const Imf::MultiPartInputFile& file,
                        const std::vector<std::string>& patterns,
                        const std::vector<std::string>& suffixes) {
  for (const std::string& pattern : patterns) {
    for (int part = 0; part < file.parts(); ++part) {
      if (!isFlat(file.header(part))) continue;
      const Imf::ChannelList& channels = file.header(part).channels();
      std::vector<std::string> stems;
      if (pattern[0] == '*') {
        const std::string ending = pattern.substr(1) + suffixes[0];
        for (auto c = channels.begin(); c != channels.end(); ++c) {
          const std::string name = c.name();
          if (endsWith(name, ending))
            stems.push_back(name.substr(0, name.size() - suffixes[0].size()));
        }
      } else {
        // X, Y, Z of a part of positions or normals are coordinates, not depth.
        const bool vectors = channels.findChannel("X") && channels.findChannel("Y");
        if (pattern != "Z" || !vectors) stems.push_back(pattern);
      }
      for (const std::string& stem : stems) {
        ChannelSet set{part, {}};
        for (const std::string& suffix : suffixes) {
          if (channels.findChannel(stem + suffix)) set.names.push_back(stem + suffix);
        }
        if (set.names.size() == suffixes.size()) return set;
      }
    }
  }
  return {};
}

/// Values of the set's channels over the display window, [height, width, channels]; `outside` where
/// the data window does not reach.
Image readChannels(Imf::MultiPartInputFile& file, const ChannelSet& set, uint64_t file_bytes,
                   float outside, const std::string& path) {
  const Imf::Header& header = file.header(set.part);
  const Imath::Box2i data = header.dataWindow(), display = header.displayWindow();
  const auto extent = [](int low, int high) { return int64_t(high) - low + 1; };
  const int64_t w = extent(data.min.x, data.max.x), h = extent(data.min.y, data.max.y);
  require(w > 0 && h > 0 && uint64_t(w) <= kMaxViewPixels && uint64_t(h) <= kMaxViewPixels &&
              uint64_t(w) * uint64_t(h) <= kMaxViewPixels,
          kReadViews, ": ", path, ": data window of ", w, " x ", h,
          " pixels (expected at most 2^28)");
  // No codec of OpenEXR packs a picture this tightly: the header lies, take no memory for it.
  require(uint64_t(w) * uint64_t(h) / 2048 <= file_bytes, kReadViews, ": ", path, ": ", file_bytes,
          " bytes are too few for ", w, " x ", h, " pixels");
  const size_t n = set.names.size();
  std::vector<float> values(size_t(w) * size_t(h) * n, outside);
  Imf::FrameBuffer buffer;
  for (size_t c = 0; c < n; ++c) {
    const Imf::Channel& channel = header.channels()[set.names[c]];
    require(channel.xSampling == 1 && channel.ySampling == 1, kReadViews, ": ", path, ": channel ",
            set.names[c], " is subsampled (expected full resolution)");
    buffer.insert(set.names[c], Imf::Slice::Make(Imf::FLOAT, values.data() + c, data,
                                                 n * sizeof(float), size_t(w) * n * sizeof(float)));
  }
  Imf::InputPart part(file, set.part);
  part.setFrameBuffer(buffer);
  part.readPixels(data.min.y, data.max.y);

  Image image(int(extent(display.min.x, display.max.x)), int(extent(display.min.y, display.max.y)),
              int(n), outside);
  const int x0 = std::max(data.min.x, display.min.x), x1 = std::min(data.max.x, display.max.x);
  for (int y = std::max(data.min.y, display.min.y); y <= std::min(data.max.y, display.max.y); ++y) {
    if (x1 < x0) break;
    const float* from =
        values.data() +
        (size_t(int64_t(y) - data.min.y) * size_t(w) + size_t(int64_t(x0) - data.min.x)) * n;
    std::copy(from, from + size_t(int64_t(x1) - x0 + 1) * n,
              &image.at(int(int64_t(x0) - display.min.x), int(int64_t(y) - display.min.y), 0));
  }
  return image;
}

/// Transposed: OpenEXR multiplies row vectors from the left.
std::optional<Eigen::Matrix4d> columnMatrix(const Imf::MultiPartInputFile& file, const char* name) {
  for (int part = 0; part < file.parts(); ++part) {
    Eigen::Matrix4d m;
    if (const auto* f = file.header(part).findTypedAttribute<Imf::M44fAttribute>(name)) {
      for (int r = 0; r < 4; ++r)
        for (int c = 0; c < 4; ++c) m(c, r) = double(f->value()[r][c]);
      return m;
    }
    if (const auto* d = file.header(part).findTypedAttribute<Imf::M44dAttribute>(name)) {
      for (int r = 0; r < 4; ++r)
        for (int c = 0; c < 4; ++c) m(c, r) = d->value()[r][c];
      return m;
    }
  }
  return {};
}

/// worldToCamera has axes x right, y up, z forward (left-handed); worldToNDC ends
/// in [0, 1] from the upper left by the specification, in [-1, 1] with y up by several renderers.
Camera exrCamera(const Imf::MultiPartInputFile& file, int width, int height,
                 const std::string& path) {
  const auto view = columnMatrix(file, "worldToCamera"), ndc = columnMatrix(file, "worldToNDC");
  require(view && ndc, kReadViews, ": ", path,
          ": no camera (expected attributes worldToCamera and ", "worldToNDC, found ",
          view  ? "only worldToCamera"
          : ndc ? "only worldToNDC"
                : "neither",
          ")");
  require(view->allFinite() && ndc->allFinite(), kReadViews, ": ", path,
          ": worldToCamera or worldToNDC is not finite");
  Eigen::Matrix4d camera_from_world = *view;
  // det +1 is an OpenGL camera: the same axes but looking along -z.
  if (view->topLeftCorner<3, 3>().determinant() > 0) camera_from_world.row(2) *= -1;
  Eigen::Matrix4d cv_from_world = camera_from_world;
  cv_from_world.row(1) *= -1;  // y down

  Camera camera;
  camera.width = width, camera.height = height;
  camera.world_from_camera = rigid(cv_from_world, path, "worldToCamera").inverse();
  Eigen::Matrix4d world_from_axes = camera.world_from_camera.matrix();
  world_from_axes.col(1) *= -1;
  // ndc_from_axes (x right, y up, z forward): u = (a x + b z) / z, v = (c y + d z) / z.
  const Eigen::Matrix4d p = *ndc * world_from_axes;
  const double s = p(3, 2);
  require(std::abs(s) > 1e-6, kReadViews, ": ", path,
          ": worldToNDC is not a perspective projection that fits worldToCamera");
  require(
      s > 0 || view->topLeftCorner<3, 3>().determinant() < 0, kReadViews, ": ", path,
      ": worldToCamera is right-handed but looks along +z (expected OpenEXR's left-handed axes)");
  const double a = p(0, 0) / s, b = p(0, 2) / s, c = p(1, 1) / s, d = p(1, 2) / s;
  const double sign_a = a < 0 ? -1 : 1, sign_c = c < 0 ? -1 : 1;
  // By the specification u grows with x and v falls with y. [-1, 1] ranges have y up, so both
  // grow (or, where w = -z, both fall), or at least a principal point near 0.
  if (sign_a == sign_c || (std::abs(b) < 0.25 && std::abs(d) < 0.25)) {
    camera.fx = std::abs(a) * width / 2, camera.cx = (1 + b * sign_a) * width / 2;
    camera.fy = std::abs(c) * height / 2, camera.cy = (1 - d * sign_c) * height / 2;
  } else {
    camera.fx = a * width, camera.cx = b * width;
    camera.fy = -c * height, camera.cy = d * height;
  }
  require(std::isfinite(camera.fx + camera.fy + camera.cx + camera.cy) && camera.fx > 1e-6 &&
              camera.fy > 1e-6,
          kReadViews, ": ", path, ": worldToNDC gives no focal length (found ", camera.fx, ", ",
          camera.fy, " pixels)");
  // A worldToNDC made for another camera would move points sideways with x and y, or lose them in
  // w.
  const double stray =
      std::max({std::abs(p(0, 1)), std::abs(p(1, 0)), std::abs(p(3, 0)), std::abs(p(3, 1))}) /
      std::abs(s);
  require(stray < 1e-3 * std::max({1.0, std::abs(a), std::abs(c)}), kReadViews, ": ", path,
          ": worldToCamera and worldToNDC belong to different cameras (skew of ", stray, ")");
  return camera;
}

View decodeExr(const std::string& path, const std::string& name,
               const ReadViewsSettings& settings) {
  const uint64_t file_bytes = std::filesystem::file_size(path);
  Imf::MultiPartInputFile file(path.c_str());
  const ChannelSet rgb = [&] {
    ChannelSet set =
        findChannels(file, {"", "*.Combined.", "rgba.", "beauty.", "C."}, {"R", "G", "B"});
    return set.found() ? set : findChannels(file, {"Y"}, {""});
  }();
  require(rgb.found() || settings.cameras_only, kReadViews, ": ", path,
          ": no colour (expected channels R, G, B)");
  ChannelSet position = findChannels(file, {"P.", "*.Position."}, {"X", "Y", "Z"});
  const ChannelSet lower = findChannels(file, {"P."}, {"x", "y", "z"});
  if (lower.found() && (!position.found() || position.names[0] != "P.X")) position = lower;
  const ChannelSet z = findChannels(file, {"Z", "depth.Z", "*.Depth.Z", "depth", "Pz"}, {""});
  require(position.found() || z.found() || settings.cameras_only, kReadViews, ": ", path,
          ": no depth (expected channels P.X P.Y P.Z or Z)");

  const Imath::Box2i display = file.header(std::max(0, rgb.part)).displayWindow();
  const int64_t w = int64_t(display.max.x) - display.min.x + 1;
  const int64_t h = int64_t(display.max.y) - display.min.y + 1;
  require(w > 0 && h > 0 && uint64_t(w) <= kMaxViewPixels && uint64_t(h) <= kMaxViewPixels &&
              uint64_t(w) * uint64_t(h) <= kMaxViewPixels &&
              uint64_t(w) * uint64_t(h) / 2048 <= file_bytes,
          kReadViews, ": ", path, ": display window of ", w, " x ", h, " pixels in ", file_bytes,
          " bytes (expected at most 2^28, and a file to match)");

  View view;
  view.name = name;
  view.camera = exrCamera(file, int(w), int(h), path);
  if (settings.cameras_only) return view;
  const auto read = [&](const ChannelSet& set, float outside) {
    const Imath::Box2i window = file.header(set.part).displayWindow();
    require(window == display, kReadViews, ": ", path, ": channels ", rgb.names[0], " and ",
            set.names[0], " have different display windows");
    return readChannels(file, set, file_bytes, outside, path);
  };
  view.colour = threeChannels(read(rgb, 0.f));
  for (float& v : view.colour.data) {
    v = v > 0 ? srgbFromLinear(std::min(v, 1.f)) : 0.f;  // NaN: 0
  }
  const auto measured = [](const std::vector<float>& depth) {
    return std::any_of(depth.begin(), depth.end(), [](float d) { return d > 0; });
  };
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  if (position.found()) view.depth = depthFromPositions(read(position, kNaN), view.camera);
  // Some renderers' P is in camera space: then no point falls into its pixel, and Z has to serve.
  if (z.found() && !measured(view.depth)) {
    view.depth = read(z, 0.f).data;
    for (float& d : view.depth) {
      if (!(d > 0 && d < kFarDepth)) d = 0;
    }
  }
  // Depth of a partly covered pixel mixes the object's with the background's.
  const std::string& red = rgb.names[0];
  const ChannelSet alpha = findChannels(file, {red.substr(0, red.size() - 1) + "A"}, {""});
  if (alpha.found()) {
    const Image coverage = read(alpha, 0.f);
    for (size_t i = 0; i < view.depth.size(); ++i) {
      if (!(coverage.data[i] >= 0.999f)) view.depth[i] = 0;
    }
  }
  finishView(&view, settings, path);
  return view;
}

}  // namespace

View readExrView(const std::string& path, const std::string& name,
                 const ReadViewsSettings& settings) {
  try {
    return decodeExr(path, name, settings);
  } catch (const Error&) {
    throw;
  } catch (const std::exception& error) {  // OpenEXR's own
    std::string message = error.what();
    std::replace(message.begin(), message.end(), '\n', ' ');
    throw Error(joinText(kReadViews, ": ", path, ": corrupt EXR: ", message));
  }
}

}  // namespace vdbc
