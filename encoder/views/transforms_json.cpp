// Views from and to nerfstudio's transforms.json (docs/formats.md, Views).
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <optional>

#include "encoder/views/view_reading.h"
#include "splat/image_files.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

constexpr uint64_t kMaxJsonBytes = uint64_t(1) << 28;
constexpr uint16_t kNoDepth16 = 65535;  // Kinect captures mark unmeasured pixels so

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
    require(value->is_number(), kReadViews, ": ", where, ": ", key, ": expected a number, found ",
            value->type_name());
    const double number = value->get<double>();
    require(std::isfinite(number), kReadViews, ": ", where, ": ", key,
            ": expected a finite number");
    return number;
  }
  std::optional<std::string> text(const char* key) const {
    const Json* value = find(key);
    if (!value) return {};
    require(value->is_string(), kReadViews, ": ", where, ": ", key, ": expected a string, found ",
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
  require(ok, kReadViews, ": ", where, ": ", key, ": expected 4 rows of 4 numbers");
  return m;
}

Json parseTransforms(const std::string& path) {
  const std::vector<uint8_t> bytes = readFile(kReadViews, path, kMaxJsonBytes);
  Json json;
  try {
    json = Json::parse(bytes.begin(), bytes.end());
  } catch (const Json::exception& error) {
    std::string message = error.what();
    std::replace(message.begin(), message.end(), '\n', ' ');
    throw Error(joinText(kReadViews, ": ", path, ": not valid JSON: ", message));
  }
  require(json.is_object(), kReadViews, ": ", path, ": expected a JSON object, found ",
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
  require(applied.scale > 0, kReadViews, ": ", path,
          ": applied_scale: expected more than 0, found ", applied.scale);
  return applied;
}

void requirePinhole(const Keys& keys) {
  const std::string model = keys.text("camera_model").value_or("OPENCV");
  require(model == "OPENCV" || model == "PINHOLE" || model == "SIMPLE_PINHOLE", kReadViews, ": ",
          keys.where, ": camera_model ", model,
          " is not supported (expected OPENCV, PINHOLE or SIMPLE_PINHOLE)");
  const Json* fisheye = keys.find("is_fisheye");
  require(!fisheye || *fisheye == false, kReadViews, ": ", keys.where,
          ": fisheye cameras are not supported");
  for (const char* key : {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}) {
    const double value = keys.number(key).value_or(0);
    require(value == 0, kReadViews, ": ", keys.where,
            ": lens distortion is not supported (expected ", key, " = 0, found ", value,
            "): undistort the images first");
  }
  if (const Json* distortion = keys.find("distortion_params")) {
    bool zero = distortion->is_array();
    for (size_t i = 0; zero && i < distortion->size(); ++i) zero = (*distortion)[i] == 0;
    require(zero, kReadViews, ": ", keys.where,
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
  require(w == image_width && h == image_height, kReadViews, ": ", image, ": expected ", w, " x ",
          h, " pixels (", keys.where, "), found ", image_width, " x ", image_height);
  camera.cx = keys.number("cx").value_or(0.5 * w);
  camera.cy = keys.number("cy").value_or(0.5 * h);
  const auto focal = [&](const char* length, const char* angle, double size) -> double {
    if (const auto f = keys.number(length)) {
      require(*f > 0, kReadViews, ": ", keys.where, ": ", length, ": expected more than 0, found ",
              *f);
      return *f;
    }
    const auto a = keys.number(angle);
    if (!a) return 0;
    require(*a > 0 && *a < M_PI, kReadViews, ": ", keys.where, ": ", angle,
            ": expected an angle in (0, pi), found ", *a);
    return 0.5 * size / std::tan(0.5 * *a);
  };
  camera.fx = focal("fl_x", "camera_angle_x", w);
  camera.fy = focal("fl_y", "camera_angle_y", h);
  require(camera.fx > 0 || camera.fy > 0, kReadViews, ": ", keys.where,
          ": no focal length (expected fl_x or camera_angle_x)");
  if (camera.fx == 0) camera.fx = camera.fy;  // square pixels
  if (camera.fy == 0) camera.fy = camera.fx;
  return camera;
}

/// The keys w and h, if they are there.
std::optional<std::pair<int, int>> statedSize(const Keys& keys) {
  const auto w = keys.number("w"), h = keys.number("h");
  if (!w || !h) return {};
  require(*w >= 1 && *h >= 1 && *w * *h <= double(kMaxImagePixels) && *w == std::floor(*w) &&
              *h == std::floor(*h),
          kReadViews, ": ", keys.where, ": expected 1 to 2^28 pixels, found ", *w, " x ", *h);
  return std::pair(int(*w), int(*h));
}

/// The frame's pose, camera to the world before nerfstudio's export.
Eigen::Isometry3d jsonPose(const Keys& keys, const Applied& applied) {
  const auto matrix = keys.frame.find("transform_matrix");
  require(matrix != keys.frame.end(), kReadViews, ": ", keys.where, ": no transform_matrix");
  Eigen::Isometry3d pose =
      rigid(jsonMatrix(*matrix, keys.where, "transform_matrix"), keys.where, "transform_matrix");
  pose.translation() /= applied.scale;
  pose.linear().rightCols<2>() *= -1;  // OpenGL (y up, looks along -z) to OpenCV axes
  return applied.file_from_source.inverse() * pose;
}

/// Throws Error unless a picture that belongs to another has its size.
void requireSizeOfImage(const std::string& file, const char* what, int width, int height,
                        const Camera& camera, const std::string& image_file) {
  require(width == camera.width && height == camera.height, kReadViews, ": ", file, ": ", what,
          " and colour differ in size (expected ", camera.width, " x ", camera.height, " as ",
          image_file, ", found ", width, " x ", height, ")");
}

/// Planar depth in metres [height * width], 0 where there is none or the frame's mask is black.
std::vector<float> jsonDepth(const Keys& keys, const fs::path& folder, const Camera& camera,
                             const std::string& image_file) {
  const auto path = keys.text("depth_file_path");
  require(path && !path->empty(), kReadViews, ": ", keys.where, " (",
          keys.text("file_path").value_or(""), "): no depth (expected depth_file_path)");
  const std::string depth_file = imagePath(folder, *path);
  int width = 0, height = 0;
  const std::vector<uint16_t> stored = readPng16(depth_file, &width, &height);
  requireSizeOfImage(depth_file, "depth", width, height, camera, image_file);
  const double unit = keys.number("depth_unit_scale_factor").value_or(1e-3);
  require(unit > 0, kReadViews, ": ", keys.where,
          ": depth_unit_scale_factor: expected more than 0, found ", unit);
  std::vector<float> depth(stored.size());
  for (size_t i = 0; i < stored.size(); ++i)
    depth[i] = stored[i] == kNoDepth16 ? 0.f : float(stored[i] * unit);

  const auto mask_path = keys.text("mask_path");
  if (!mask_path || mask_path->empty()) return depth;
  const std::string mask_file = imagePath(folder, *mask_path);
  const Image mask = readImage(mask_file);
  requireSizeOfImage(mask_file, "mask", mask.width, mask.height, camera, image_file);
  const size_t channels = size_t(mask.channels);
  for (size_t i = 0; i < depth.size(); ++i) {
    const float* m = mask.data.data() + i * channels;
    if (std::all_of(m, m + channels, [](float v) { return v == 0; })) depth[i] = 0;
  }
  return depth;
}

View readJsonFrame(const Json& json, size_t index, const Applied& applied, const std::string& path,
                   const ReadViewsSettings& settings) {
  const fs::path folder = fs::path(path).parent_path();
  const Json& frame = json["frames"][index];
  const Keys keys{frame, json, joinText(path, ": frame ", index)};
  require(frame.is_object(), kReadViews, ": ", keys.where, ": expected an object, found ",
          frame.type_name());
  requirePinhole(keys);
  const auto file_path = keys.text("file_path");
  require(file_path && !file_path->empty(), kReadViews, ": ", keys.where, ": no file_path");

  View view;
  view.name = *file_path;
  const std::string image_file = imagePath(folder, *file_path);
  const auto size = settings.cameras_only ? statedSize(keys) : std::nullopt;
  if (!size) view.colour = threeChannels(readImage(image_file));
  view.camera = jsonCamera(keys, size ? size->first : view.colour.width,
                           size ? size->second : view.colour.height, image_file);
  view.camera.world_from_camera = jsonPose(keys, applied);
  if (settings.cameras_only) {
    view.colour = {};
    return view;
  }
  view.depth = jsonDepth(keys, folder, view.camera, image_file);
  requireDepth(view, path);
  return view;
}

}  // namespace
std::vector<View> readTransforms(const std::string& path, const ReadViewsSettings& settings) {
  const Json json = parseTransforms(path);
  const auto frames = json.find("frames");
  require(frames != json.end() && frames->is_array(), kReadViews, ": ", path,
          ": expected an array `frames`");
  const Applied applied = appliedTransform(json, path);
  return readAll(selectFrames(settings, frames->size(), path),
                 [&](size_t i) { return readJsonFrame(json, i, applied, path, settings); });
}

Eigen::Vector3d transformsUp(const std::string& path) {
  const Applied applied = appliedTransform(parseTransforms(path), path);
  return applied.file_from_source.linear().transpose() * Eigen::Vector3d::UnitZ();
}

namespace {

void requireWritableView(const char* operation, const std::string& path, const View& view) {
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
    requireWritableView(kOperation, folder, view);
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

}  // namespace vdbc
