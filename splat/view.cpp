#include "splat/view.h"

// OpenEXR's headers include each other by bare name; its CMake target provides the folder.
#include <ImfChannelList.h>
#include <ImfCompression.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfInputPart.h>
#include <ImfMatrixAttribute.h>
#include <ImfMultiPartInputFile.h>
#include <ImfOutputFile.h>
#include <ImfPartType.h>

#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>

#include "splat/view_reading.h"
#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

constexpr const char* kRead = kReadViews;
constexpr uint64_t kMaxJsonBytes = uint64_t(1) << 28;
constexpr uint64_t kMaxPixels = kMaxViewPixels;
constexpr double kRigidTolerance = 5e-3;
constexpr uint16_t kNoDepth16 = 65535;  // Kinect captures mark unmeasured pixels so

}  // namespace

Eigen::Isometry3d rigid(const Eigen::Matrix4d& m, const std::string& path,
                        const std::string& what) {
  Eigen::Matrix3d r = m.topLeftCorner<3, 3>();
  require(m.allFinite(), kRead, ": ", path, ": ", what, " is not finite");
  const double skew = (r.transpose() * r - Eigen::Matrix3d::Identity()).cwiseAbs().maxCoeff();
  require(skew <= kRigidTolerance, kRead, ": ", path, ": ", what,
          " is singular or not rigid (expected a rotation, found R^T R off identity by ", skew,
          ")");
  const double determinant = r.determinant();
  require(determinant > 0, kRead, ": ", path, ": ", what,
          " mirrors (expected determinant 1, found ", determinant, ")");
  const Eigen::RowVector4d last(0, 0, 0, 1);
  require((m.row(3) - last).cwiseAbs().maxCoeff() <= 1e-6, kRead, ": ", path, ": ", what,
          " is not affine (expected last row 0 0 0 1)");
  for (int i = 0; i < 4; ++i) r = 0.5 * (r + r.inverse().transpose()).eval();  // Newton, quadratic
  Eigen::Isometry3d result = Eigen::Isometry3d::Identity();
  result.linear() = r;
  result.translation() = m.topRightCorner<3, 1>();
  return result;
}

std::vector<float> depthFromPositions(const Image& positions, const Camera& camera) {
  std::vector<float> depth(size_t(camera.width) * size_t(camera.height), 0.f);
  const Eigen::Isometry3d camera_from_world = camera.world_from_camera.inverse();
  constexpr double kHalfPixel = 0.5 + 1e-3;  // float rounding of a position at the pixel's border
  for (int y = 0; y < camera.height; ++y) {
    for (int x = 0; x < camera.width; ++x) {
      const Eigen::Vector3d world(positions.at(x, y, 0), positions.at(x, y, 1),
                                  positions.at(x, y, 2));
      if (!world.allFinite()) continue;
      const Eigen::Vector3d p = camera_from_world * world;
      if (!(p.z() > 0 && p.z() < double(kFarDepth))) continue;
      const double u = camera.fx * p.x() / p.z() + camera.cx;
      const double v = camera.fy * p.y() / p.z() + camera.cy;
      if (std::abs(u - (x + 0.5)) > kHalfPixel || std::abs(v - (y + 0.5)) > kHalfPixel) continue;
      depth[size_t(y) * size_t(camera.width) + size_t(x)] = float(p.z());
    }
  }
  return depth;
}

void finishView(View* view, const ReadViewsSettings& settings, const std::string& path) {
  const bool measured =
      std::any_of(view->depth.begin(), view->depth.end(), [](float z) { return z > 0; });
  require(measured, kRead, ": ", path, ": depth of ", view->name, " has no valid pixel");
  const int w = view->camera.width, h = view->camera.height, longer = std::max(w, h);
  if (settings.max_side <= 0 || longer <= settings.max_side) return;
  const double scale = double(settings.max_side) / longer;
  const int new_w = std::max(1, int(std::lround(w * scale)));
  const int new_h = std::max(1, int(std::lround(h * scale)));
  std::vector<float> depth(size_t(new_w) * size_t(new_h));
  for (int y = 0; y < new_h; ++y) {
    const int from_y = std::min(h - 1, int((y + 0.5) * h / new_h));
    for (int x = 0; x < new_w; ++x) {
      const int from_x = std::min(w - 1, int((x + 0.5) * w / new_w));
      depth[size_t(y) * size_t(new_w) + size_t(x)] =
          view->depth[size_t(from_y) * size_t(w) + size_t(from_x)];
    }
  }
  require(std::any_of(depth.begin(), depth.end(), [](float z) { return z > 0; }), kRead, ": ", path,
          ": depth of ", view->name, " has no valid pixel once shrunk to ", new_w, " x ", new_h);
  view->depth = std::move(depth);
  view->colour = resizeImage(view->colour, new_w, new_h);
  view->camera = resized(view->camera, new_w, new_h);
}

std::vector<size_t> selectFrames(const ReadViewsSettings& settings, size_t count,
                                 const std::string& path) {
  require(count > 0, kRead, ": ", path, ": no frames");
  std::vector<size_t> selected;
  for (int frame : settings.frames) {
    require(frame >= 0 && size_t(frame) < count, kRead, ": ", path, ": frame ", frame,
            " is out of range (expected 0 to ", count - 1, ")");
    selected.push_back(size_t(frame));
  }
  if (selected.empty()) {
    for (size_t i = 0; i < count; ++i) selected.push_back(i);
  }
  return selected;
}

namespace {

Image threeChannels(Image image) {
  if (image.channels == 3) return image;
  Image rgb(image.width, image.height, 3);
  for (size_t i = 0; i < image.data.size(); ++i) {
    for (size_t c = 0; c < 3; ++c) rgb.data[3 * i + c] = image.data[i];
  }
  return rgb;
}

// ---- nerfstudio transforms.json

/// A frame's keys before the file's, with type checks that name the key.
struct Keys {
  const Json& frame;
  const Json& top;
  std::string where;  // "PATH: frame 3", for messages

  const Json* find(const char* key) const {
    for (const Json* object : {&frame, &top}) {
      const auto found = object->find(key);
      if (found != object->end() && !found->is_null()) return &*found;
    }
    return nullptr;
  }
  std::optional<double> number(const char* key) const {
    const Json* value = find(key);
    if (!value) return {};
    require(value->is_number(), kRead, ": ", where, ": ", key, ": expected a number, found ",
            value->type_name());
    const double number = value->get<double>();
    require(std::isfinite(number), kRead, ": ", where, ": ", key, ": expected a finite number");
    return number;
  }
  std::optional<std::string> text(const char* key) const {
    const Json* value = find(key);
    if (!value) return {};
    require(value->is_string(), kRead, ": ", where, ": ", key, ": expected a string, found ",
            value->type_name());
    return value->get<std::string>();
  }
};

/// A 4 x 4 or 3 x 4 matrix, row-major.
Eigen::Matrix4d jsonMatrix(const Json& rows, const std::string& where, const char* key) {
  Eigen::Matrix4d m = Eigen::Matrix4d::Identity();
  bool ok = rows.is_array() && (rows.size() == 3 || rows.size() == 4);
  for (size_t r = 0; ok && r < rows.size(); ++r) {
    ok = rows[r].is_array() && rows[r].size() == 4;
    for (size_t c = 0; ok && c < 4; ++c) {
      ok = rows[r][c].is_number();
      if (ok) m(Eigen::Index(r), Eigen::Index(c)) = rows[r][c].get<double>();
    }
  }
  require(ok, kRead, ": ", where, ": ", key, ": expected 4 rows of 4 numbers");
  return m;
}

Json parseTransforms(const std::string& path) {
  const std::vector<uint8_t> bytes = readFile(kRead, path, kMaxJsonBytes);
  Json json;
  try {
    json = Json::parse(bytes.begin(), bytes.end());
  } catch (const Json::exception& error) {
    std::string message = error.what();
    std::replace(message.begin(), message.end(), '\n', ' ');
    throw Error(joinText(kRead, ": ", path, ": not valid JSON: ", message));
  }
  require(json.is_object(), kRead, ": ", path, ": expected a JSON object, found ",
          json.type_name());
  return json;
}

/// applied_transform and applied_scale: what the file's poses have been through since the source.
struct Applied {
  Eigen::Isometry3d file_from_source = Eigen::Isometry3d::Identity();  // then scaled by `scale`
  double scale = 1;
};

Applied appliedTransform(const Json& json, const std::string& path) {
  Applied applied;
  const Keys keys{json, json, path};
  if (const Json* matrix = keys.find("applied_transform")) {
    applied.file_from_source =
        rigid(jsonMatrix(*matrix, path, "applied_transform"), path, "applied_transform");
  }
  applied.scale = keys.number("applied_scale").value_or(1);
  require(applied.scale > 0, kRead, ": ", path, ": applied_scale: expected more than 0, found ",
          applied.scale);
  return applied;
}

void requirePinhole(const Keys& keys) {
  const std::string model = keys.text("camera_model").value_or("OPENCV");
  require(model == "OPENCV" || model == "PINHOLE" || model == "SIMPLE_PINHOLE", kRead, ": ",
          keys.where, ": camera_model ", model,
          " is not supported (expected OPENCV, PINHOLE or SIMPLE_PINHOLE)");
  const Json* fisheye = keys.find("is_fisheye");
  require(!fisheye || *fisheye == false, kRead, ": ", keys.where,
          ": fisheye cameras are not supported");
  for (const char* key : {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}) {
    const double value = keys.number(key).value_or(0);
    require(value == 0, kRead, ": ", keys.where, ": lens distortion is not supported (expected ",
            key, " = 0, found ", value, "): undistort the images first");
  }
  if (const Json* distortion = keys.find("distortion_params")) {
    bool zero = distortion->is_array();
    for (size_t i = 0; zero && i < distortion->size(); ++i) zero = (*distortion)[i] == 0;
    require(zero, kRead, ": ", keys.where,
            ": lens distortion is not supported (expected distortion_params of zeros): undistort "
            "the images first");
  }
}

/// The file named by `relative`; Instant-NGP and Blender leave the extension out.
std::string imagePath(const fs::path& folder, const std::string& relative) {
  const fs::path path = folder / relative;
  std::error_code ignored;
  if (!fs::exists(path, ignored)) {
    for (const char* extension : {".png", ".jpg", ".jpeg"}) {
      fs::path with = path;
      with += extension;
      if (fs::exists(with, ignored)) return with.string();
    }
  }
  return path.string();
}

/// Intrinsics; w, h and the principal point default to the image's size and centre.
Camera jsonCamera(const Keys& keys, int image_width, int image_height, const std::string& image) {
  Camera camera;
  camera.width = image_width, camera.height = image_height;
  const double w = keys.number("w").value_or(image_width);
  const double h = keys.number("h").value_or(image_height);
  require(w == image_width && h == image_height, kRead, ": ", image, ": expected ", w, " x ", h,
          " pixels (", keys.where, "), found ", image_width, " x ", image_height);
  camera.cx = keys.number("cx").value_or(0.5 * w);
  camera.cy = keys.number("cy").value_or(0.5 * h);
  const auto focal = [&](const char* length, const char* angle, double size) -> double {
    if (const auto f = keys.number(length)) {
      require(*f > 0, kRead, ": ", keys.where, ": ", length, ": expected more than 0, found ", *f);
      return *f;
    }
    const auto a = keys.number(angle);
    if (!a) return 0;
    require(*a > 0 && *a < M_PI, kRead, ": ", keys.where, ": ", angle,
            ": expected an angle in (0, pi), found ", *a);
    return 0.5 * size / std::tan(0.5 * *a);
  };
  camera.fx = focal("fl_x", "camera_angle_x", w);
  camera.fy = focal("fl_y", "camera_angle_y", h);
  require(camera.fx > 0 || camera.fy > 0, kRead, ": ", keys.where,
          ": no focal length (expected fl_x or camera_angle_x)");
  if (camera.fx == 0) camera.fx = camera.fy;  // square pixels
  if (camera.fy == 0) camera.fy = camera.fx;
  return camera;
}

/// The keys w and h, if they are there.
std::optional<std::pair<int, int>> statedSize(const Keys& keys) {
  const auto w = keys.number("w"), h = keys.number("h");
  if (!w || !h) return {};
  require(*w >= 1 && *h >= 1 && *w * *h <= double(kMaxPixels) && *w == std::floor(*w) &&
              *h == std::floor(*h),
          kRead, ": ", keys.where, ": expected 1 to 2^28 pixels, found ", *w, " x ", *h);
  return std::pair(int(*w), int(*h));
}

View readJsonFrame(const Json& json, size_t index, const Applied& applied, const std::string& path,
                   const ReadViewsSettings& settings) {
  const fs::path folder = fs::path(path).parent_path();
  const Json& frame = json["frames"][index];
  const Keys keys{frame, json, joinText(path, ": frame ", index)};
  require(frame.is_object(), kRead, ": ", keys.where, ": expected an object, found ",
          frame.type_name());
  requirePinhole(keys);
  const auto file_path = keys.text("file_path");
  require(file_path && !file_path->empty(), kRead, ": ", keys.where, ": no file_path");

  View view;
  view.name = *file_path;
  const std::string image_path = imagePath(folder, *file_path);
  const auto size = settings.cameras_only ? statedSize(keys) : std::nullopt;
  if (!size) view.colour = threeChannels(readImage(image_path));
  const int w = size ? size->first : view.colour.width,
            h = size ? size->second : view.colour.height;
  view.camera = jsonCamera(keys, w, h, image_path);

  const auto matrix = frame.find("transform_matrix");
  require(matrix != frame.end(), kRead, ": ", keys.where, ": no transform_matrix");
  Eigen::Isometry3d pose =
      rigid(jsonMatrix(*matrix, keys.where, "transform_matrix"), keys.where, "transform_matrix");
  pose.translation() /= applied.scale;
  // OpenGL (y up, looks along -z) to OpenCV axes; then back to the frame before nerfstudio's
  // export.
  pose.linear().rightCols<2>() *= -1;
  view.camera.world_from_camera = applied.file_from_source.inverse() * pose;
  if (settings.cameras_only) {
    view.colour = {};
    return view;
  }

  const auto depth_path = keys.text("depth_file_path");
  require(depth_path && !depth_path->empty(), kRead, ": ", keys.where, " (", *file_path,
          "): no depth (expected depth_file_path)");
  const std::string depth_file = imagePath(folder, *depth_path);
  int depth_w = 0, depth_h = 0;
  const std::vector<uint16_t> stored = readPng16(depth_file, &depth_w, &depth_h);
  require(depth_w == w && depth_h == h, kRead, ": ", depth_file,
          ": depth and colour differ in size (expected ", w, " x ", h, " as ", image_path,
          ", found ", depth_w, " x ", depth_h, ")");
  const double unit = keys.number("depth_unit_scale_factor").value_or(1e-3);
  require(unit > 0, kRead, ": ", keys.where,
          ": depth_unit_scale_factor: expected more than 0, found ", unit);
  view.depth.resize(stored.size());
  for (size_t i = 0; i < stored.size(); ++i) {
    view.depth[i] = stored[i] == kNoDepth16 ? 0.f : float(stored[i] * unit);
  }
  if (const auto mask_path = keys.text("mask_path"); mask_path && !mask_path->empty()) {
    const std::string mask_file = imagePath(folder, *mask_path);
    const Image mask = readImage(mask_file);
    require(mask.width == w && mask.height == h, kRead, ": ", mask_file,
            ": mask and colour differ in size (expected ", w, " x ", h, " as ", image_path,
            ", found ", mask.width, " x ", mask.height, ")");
    const size_t channels = size_t(mask.channels);
    for (size_t i = 0; i < view.depth.size(); ++i) {
      const float* m = mask.data.data() + i * channels;
      if (std::all_of(m, m + channels, [](float v) { return v == 0; })) view.depth[i] = 0;
    }
  }
  finishView(&view, settings, path);
  return view;
}

std::vector<View> readTransforms(const std::string& path, const ReadViewsSettings& settings) {
  const Json json = parseTransforms(path);
  const auto frames = json.find("frames");
  require(frames != json.end() && frames->is_array(), kRead, ": ", path,
          ": expected an array `frames`");
  const Applied applied = appliedTransform(json, path);
  return readAll(selectFrames(settings, frames->size(), path),
                 [&](size_t i) { return readJsonFrame(json, i, applied, path, settings); });
}

// ---- OpenEXR

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
  require(w > 0 && h > 0 && uint64_t(w) <= kMaxPixels && uint64_t(h) <= kMaxPixels &&
              uint64_t(w) * uint64_t(h) <= kMaxPixels,
          kRead, ": ", path, ": data window of ", w, " x ", h, " pixels (expected at most 2^28)");
  // No codec of OpenEXR packs a picture this tightly: the header lies, take no memory for it.
  require(uint64_t(w) * uint64_t(h) / 2048 <= file_bytes, kRead, ": ", path, ": ", file_bytes,
          " bytes are too few for ", w, " x ", h, " pixels");
  const size_t n = set.names.size();
  std::vector<float> values(size_t(w) * size_t(h) * n, outside);
  Imf::FrameBuffer buffer;
  for (size_t c = 0; c < n; ++c) {
    const Imf::Channel& channel = header.channels()[set.names[c]];
    require(channel.xSampling == 1 && channel.ySampling == 1, kRead, ": ", path, ": channel ",
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

/// formats.md 3.1. worldToCamera has axes x right, y up, z forward (left-handed); worldToNDC ends
/// in [0, 1] from the upper left by the specification, in [-1, 1] with y up by several renderers.
Camera exrCamera(const Imf::MultiPartInputFile& file, int width, int height,
                 const std::string& path) {
  const auto view = columnMatrix(file, "worldToCamera"), ndc = columnMatrix(file, "worldToNDC");
  require(view && ndc, kRead, ": ", path, ": no camera (expected attributes worldToCamera and ",
          "worldToNDC, found ",
          view  ? "only worldToCamera"
          : ndc ? "only worldToNDC"
                : "neither",
          ")");
  require(view->allFinite() && ndc->allFinite(), kRead, ": ", path,
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
  require(std::abs(s) > 1e-6, kRead, ": ", path,
          ": worldToNDC is not a perspective projection that fits worldToCamera");
  require(
      s > 0 || view->topLeftCorner<3, 3>().determinant() < 0, kRead, ": ", path,
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
          kRead, ": ", path, ": worldToNDC gives no focal length (found ", camera.fx, ", ",
          camera.fy, " pixels)");
  // A worldToNDC made for another camera would move points sideways with x and y, or lose them in
  // w.
  const double stray =
      std::max({std::abs(p(0, 1)), std::abs(p(1, 0)), std::abs(p(3, 0)), std::abs(p(3, 1))}) /
      std::abs(s);
  require(stray < 1e-3 * std::max({1.0, std::abs(a), std::abs(c)}), kRead, ": ", path,
          ": worldToCamera and worldToNDC belong to different cameras (skew of ", stray, ")");
  return camera;
}

View decodeExr(const std::string& path, const std::string& name,
               const ReadViewsSettings& settings) {
  const uint64_t file_bytes = fs::file_size(path);
  Imf::MultiPartInputFile file(path.c_str());
  const ChannelSet rgb = [&] {
    ChannelSet set =
        findChannels(file, {"", "*.Combined.", "rgba.", "beauty.", "C."}, {"R", "G", "B"});
    return set.found() ? set : findChannels(file, {"Y"}, {""});
  }();
  require(rgb.found() || settings.cameras_only, kRead, ": ", path,
          ": no colour (expected channels R, G, B)");
  ChannelSet position = findChannels(file, {"P.", "*.Position."}, {"X", "Y", "Z"});
  const ChannelSet lower = findChannels(file, {"P."}, {"x", "y", "z"});
  if (lower.found() && (!position.found() || position.names[0] != "P.X")) position = lower;
  const ChannelSet z = findChannels(file, {"Z", "depth.Z", "*.Depth.Z", "depth", "Pz"}, {""});
  require(position.found() || z.found() || settings.cameras_only, kRead, ": ", path,
          ": no depth (expected channels P.X P.Y P.Z or Z)");

  const Imath::Box2i display = file.header(std::max(0, rgb.part)).displayWindow();
  const int64_t w = int64_t(display.max.x) - display.min.x + 1;
  const int64_t h = int64_t(display.max.y) - display.min.y + 1;
  require(w > 0 && h > 0 && uint64_t(w) <= kMaxPixels && uint64_t(h) <= kMaxPixels &&
              uint64_t(w) * uint64_t(h) <= kMaxPixels &&
              uint64_t(w) * uint64_t(h) / 2048 <= file_bytes,
          kRead, ": ", path, ": display window of ", w, " x ", h, " pixels in ", file_bytes,
          " bytes (expected at most 2^28, and a file to match)");

  View view;
  view.name = name;
  view.camera = exrCamera(file, int(w), int(h), path);
  if (settings.cameras_only) return view;
  const auto read = [&](const ChannelSet& set, float outside) {
    const Imath::Box2i window = file.header(set.part).displayWindow();
    require(window == display, kRead, ": ", path, ": channels ", rgb.names[0], " and ",
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

View readExr(const std::string& path, const std::string& name, const ReadViewsSettings& settings) {
  try {
    return decodeExr(path, name, settings);
  } catch (const Error&) {
    throw;
  } catch (const std::exception& error) {  // OpenEXR's own
    std::string message = error.what();
    std::replace(message.begin(), message.end(), '\n', ' ');
    throw Error(joinText(kRead, ": ", path, ": corrupt EXR: ", message));
  }
}

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
  require(fs::exists(status), kRead, ": ", path, ": no such file or folder");
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
    require(!failure, kRead, ": ", path, ": ", failure.message());
    std::sort(source.exrs.begin(), source.exrs.end());
    require(!source.exrs.empty(), kRead, ": ", path,
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
        joinText(kRead, ": ", path,
                 ": expected a folder, a transforms.json, an .exr, an .npz or a .vdb file"));
  }
  return source;
}

// ---- writing

void requireWritable(const char* operation, const std::string& path, const View& view) {
  const Camera& c = view.camera;
  const size_t pixels = size_t(std::max(c.width, 0)) * size_t(std::max(c.height, 0));
  require(pixels > 0 && view.colour.width == c.width && view.colour.height == c.height &&
              view.colour.channels == 3 && view.colour.data.size() == 3 * pixels &&
              view.depth.size() == pixels,
          operation, ": ", path, ": inconsistent view ", view.name, " (camera ", c.width, " x ",
          c.height, ", colour ", view.colour.width, " x ", view.colour.height, " x ",
          view.colour.channels, ", ", view.depth.size(), " depths)");
}

Json intrinsicsJson(const Camera& camera) {
  return {{"fl_x", camera.fx}, {"fl_y", camera.fy}, {"cx", camera.cx},
          {"cy", camera.cy},   {"w", camera.width}, {"h", camera.height}};
}

Json poseJson(const Camera& camera) {
  Eigen::Matrix4d m = camera.world_from_camera.matrix();
  m.block<3, 2>(0, 1) *= -1;  // OpenCV to OpenGL axes
  Json rows = Json::array();
  for (int r = 0; r < 4; ++r) rows.push_back({m(r, 0), m(r, 1), m(r, 2), m(r, 3)});
  return rows;
}

}  // namespace

std::vector<View> readViews(const std::string& path, const ReadViewsSettings& settings) {
  const Source source = findSource(path);
  if (!source.pointmaps.empty()) return readPointmaps(path, settings);
  require(settings.metres_per_unit == 0, kRead, ": ", path,
          ": is in metres already (expected a scale for .npz only)");
  if (!source.volume.empty()) return readVolumeViews(path, settings);
  if (!source.transforms.empty()) return readTransforms(source.transforms, settings);
  return readAll(selectFrames(settings, source.exrs.size(), path), [&](size_t i) {
    return readExr(source.exrs[i].string(), source.exrs[i].filename().string(), settings);
  });
}

Eigen::Vector3d conventionalUp(const std::string& path) {
  const Source source = findSource(path);
  if (!source.pointmaps.empty()) return pointmapUp(path);
  if (!source.volume.empty()) return volumeUp(path);
  if (source.transforms.empty()) return Eigen::Vector3d::UnitY();
  const Applied applied = appliedTransform(parseTransforms(source.transforms), source.transforms);
  return applied.file_from_source.linear().transpose() * Eigen::Vector3d::UnitZ();
}

void writeViews(const std::vector<View>& views, const std::string& folder) {
  constexpr const char* kOperation = "writeViews";
  require(!views.empty(), kOperation, ": ", folder, ": no views");
  std::error_code failure;
  for (const char* part : {"color", "depth"}) {
    fs::create_directories(fs::path(folder) / part, failure);
    require(!failure, kOperation, ": ", folder, ": cannot create folder: ", failure.message());
  }
  const Json shared = intrinsicsJson(views[0].camera);
  const bool one_camera = std::all_of(views.begin(), views.end(), [&](const View& view) {
    return intrinsicsJson(view.camera) == shared;
  });
  Json json = {{"camera_model", "OPENCV"}, {"depth_unit_scale_factor", 1e-3}};
  if (one_camera) json.update(shared);
  json["frames"] = Json::array();
  for (size_t i = 0; i < views.size(); ++i) {
    const View& view = views[i];
    requireWritable(kOperation, folder, view);
    char number[32];
    std::snprintf(number, sizeof(number), "%05zu.png", i);
    const std::string colour_path = std::string("color/") + number;
    const std::string depth_path = std::string("depth/") + number;
    std::vector<uint16_t> millimetres(view.depth.size(), 0);
    for (size_t p = 0; p < millimetres.size(); ++p) {
      const double mm = std::round(double(view.depth[p]) * 1e3);
      if (mm > 0 && mm < kNoDepth16) millimetres[p] = uint16_t(mm);  // not NaN, nor too far
    }
    writePng(view.colour, (fs::path(folder) / colour_path).string());
    writePng16(millimetres, view.camera.width, view.camera.height,
               (fs::path(folder) / depth_path).string());
    Json frame = {{"file_path", colour_path},
                  {"depth_file_path", depth_path},
                  {"transform_matrix", poseJson(view.camera)}};
    if (!one_camera) frame.update(intrinsicsJson(view.camera));
    json["frames"].push_back(frame);
  }
  const std::string text = json.dump(1) + "\n";  // last: with it the folder is complete
  writeFile(kOperation, (fs::path(folder) / "transforms.json").string(), text.data(), text.size());
}

void writeExr(const Camera& camera, const std::vector<ExrChannel>& channels,
              const std::string& path) {
  constexpr const char* kOperation = "writeExr";
  require(camera.width > 0 && camera.height > 0 && camera.fx > 0 && camera.fy > 0, kOperation, ": ",
          path, ": expected a camera with pixels, found ", camera.width, " x ", camera.height);
  const size_t w = size_t(camera.width), pixels = w * size_t(camera.height);

  // Axes x right, y up, z forward; NDC from (0, 0) upper left to (1, 1) lower right, z / w in [0,
  // 1] between 1 cm and 1 km, w = z.
  Eigen::Matrix4d axes_from_world = camera.world_from_camera.inverse().matrix();
  axes_from_world.row(1) *= -1;
  constexpr double kNear = 0.01, kFar = 1000;
  Eigen::Matrix4d ndc_from_axes = Eigen::Matrix4d::Zero();
  ndc_from_axes(0, 0) = camera.fx / camera.width;
  ndc_from_axes(0, 2) = camera.cx / camera.width;
  ndc_from_axes(1, 1) = -camera.fy / camera.height;
  ndc_from_axes(1, 2) = camera.cy / camera.height;
  ndc_from_axes(2, 2) = kFar / (kFar - kNear);
  ndc_from_axes(2, 3) = -kFar * kNear / (kFar - kNear);
  ndc_from_axes(3, 2) = 1;
  const Eigen::Matrix4d ndc_from_world = ndc_from_axes * axes_from_world;
  const auto rowMatrix = [](const Eigen::Matrix4d& m) {
    Imath::M44f result;
    for (int r = 0; r < 4; ++r)
      for (int c = 0; c < 4; ++c) result[r][c] = float(m(c, r));
    return result;
  };

  Imf::Header header(camera.width, camera.height);
  header.compression() = Imf::ZIP_COMPRESSION;
  header.insert("worldToCamera", Imf::M44fAttribute(rowMatrix(axes_from_world)));
  header.insert("worldToNDC", Imf::M44fAttribute(rowMatrix(ndc_from_world)));
  Imf::FrameBuffer buffer;
  std::vector<std::vector<half>> halves;
  for (const ExrChannel& c : channels) {
    header.channels().insert(c.name, Imf::Channel(c.is_half ? Imf::HALF : Imf::FLOAT));
    if (!c.is_half) {
      const size_t stride = c.stride * sizeof(float);
      buffer.insert(c.name,
                    Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(const_cast<float*>(c.values)),
                               stride, stride * w));
      continue;
    }
    std::vector<half>& values = halves.emplace_back(pixels);
    for (size_t i = 0; i < pixels; ++i)
      values[i] = half(std::clamp(c.values[i * c.stride], -65504.f, 65504.f));
    buffer.insert(c.name, Imf::Slice(Imf::HALF, reinterpret_cast<char*>(values.data()),
                                     sizeof(half), sizeof(half) * w));
  }
  TemporaryFile temporary(kOperation, path);
  try {
    Imf::OutputFile file(temporary.path().c_str(), header);
    file.setFrameBuffer(buffer);
    file.writePixels(camera.height);
  } catch (const std::exception& error) {
    throw Error(joinText(kOperation, ": ", path, ": cannot write: ", error.what()));
  }
  temporary.commit();
}

void writeViewExr(const View& view, const std::string& path) {
  requireWritable("writeViewExr", path, view);
  std::vector<float> linear(view.colour.data.size()), depth(view.depth.size());
  for (size_t i = 0; i < linear.size(); ++i) linear[i] = linearFromSrgb(view.colour.data[i]);
  for (size_t i = 0; i < depth.size(); ++i)
    depth[i] = view.depth[i] > 0 && view.depth[i] < kFarDepth ? view.depth[i] : kNoDepth;
  writeExr(view.camera,
           {{"R", linear.data(), 3, true},
            {"G", linear.data() + 1, 3, true},
            {"B", linear.data() + 2, 3, true},
            {"Z", depth.data(), 1, false}},
           path);
}

}  // namespace vdbc
