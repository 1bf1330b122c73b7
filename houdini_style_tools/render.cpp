#include "houdini_style_tools/render.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <numeric>

#include "encoder/views/read_views.h"
#include "houdini_style_tools/complete.h"
#include "splat/exr.h"
#include "splat/image_files.h"
#include "splat/ply.h"
#include "splat/rasterize.h"
#include "splat/view.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

constexpr int kTurntableWidth = 960, kTurntableHeight = 540;
constexpr double kTurntableFov = 60, kTurntableElevation = 20;  // degrees
constexpr double kTrimmed =
    .02;  // share of the Gaussians at each side that are no part of the bulk

double radians(double degrees) { return degrees * M_PI / 180; }

Eigen::AlignedBox3d bulk(const Gaussians& g) {
  Eigen::AlignedBox3d box;
  box.min().setZero(), box.max().setOnes();
  if (g.size() == 0) return box;
  std::vector<float> values(g.mean.size());
  for (int axis = 0; axis < 3; ++axis) {
    std::transform(g.mean.begin(), g.mean.end(), values.begin(),
                   [&](const auto& m) { return m[axis]; });
    const auto low = values.begin() + std::ptrdiff_t(double(values.size() - 1) * kTrimmed);
    std::nth_element(values.begin(), low, values.end());
    box.min()[axis] = g.origin[axis] + double(*low);
    const auto high = values.begin() + std::ptrdiff_t(double(values.size() - 1) * (1 - kTrimmed));
    std::nth_element(values.begin(), high, values.end());
    box.max()[axis] = g.origin[axis] + double(*high);
  }
  return box;
}

/// The camera with the size and field the settings ask for. Pixels stay as they are in shape, and
/// the principal point as far from the middle.
Camera fitted(Camera c, const RenderSettings& s) {
  const double aspect = double(c.height) / c.width;
  const int width = s.width ? s.width : c.width;
  const int height = s.height  ? s.height
                     : s.width ? std::max(1, int(std::lround(width * aspect)))
                               : c.height;
  double scale = double(width) / c.width;
  if (s.fov_degrees > 0) scale = width / (2 * std::tan(radians(s.fov_degrees) / 2)) / c.fx;
  c.cx = width / 2. + (c.cx - c.width / 2.) * scale;
  c.cy = height / 2. + (c.cy - c.height / 2.) * scale;
  c.fx *= scale, c.fy *= scale;
  c.width = width, c.height = height;
  return c;
}

struct Frame {
  int number = 0;
  Camera camera;
  std::string view;
};

/// The frames of a sequence of cameras that `frames` names.
std::vector<Frame> numbered(const std::vector<Camera>& cameras, std::vector<int> frames) {
  if (frames.empty()) {
    frames.resize(cameras.size());
    std::iota(frames.begin(), frames.end(), 0);
  }
  std::vector<Frame> result;
  for (int f : frames) {
    if (f < 0 || f >= int(cameras.size()))
      throw UsageError(joinText("frames: expected numbers below ", cameras.size(), ", found ", f));
    result.push_back({f, cameras[size_t(f)], ""});
  }
  return result;
}

std::vector<Frame> framesToRender(const RenderSettings& s, const Gaussians& g) {
  if (s.turntable > 0) {
    return numbered(turntableCameras(g, s.turntable, s.width ? s.width : kTurntableWidth,
                                     s.height ? s.height : kTurntableHeight,
                                     s.fov_degrees > 0 ? s.fov_degrees : kTurntableFov, s.up),
                    s.frames);
  }
  ReadViewsSettings reading;
  reading.cameras_only = true;
  reading.metres_per_unit = s.scale;
  if (!s.flythrough) reading.frames = s.frames;
  const std::vector<View> views = readViews(s.cameras, reading);
  if (s.flythrough > 0) {
    require(views.size() > 1, s.cameras, ": expected at least 2 cameras, found ", views.size());
    std::vector<Camera> through;
    for (const View& v : views) through.push_back(fitted(v.camera, s));
    return numbered(flythroughCameras(through, s.flythrough), s.frames);
  }
  std::vector<Frame> frames;
  for (size_t i = 0; i < views.size(); ++i)
    frames.push_back(
        {s.frames.empty() ? int(i) : s.frames[i], fitted(views[i].camera, s), views[i].name});
  return frames;
}

void requireSettings(const RenderSettings& s) {
  if (s.turntable && s.flythrough)
    throw UsageError("turntable: expected no flight through cameras beside it");
  if (s.turntable && !s.cameras.empty())
    throw UsageError("turntable: expected no cameras beside it");
  if (!s.turntable && s.cameras.empty())
    throw UsageError("cameras: expected views, or a turntable");
  if (s.preview && fs::path(s.output).extension() != ".exr")
    throw UsageError(joinText("preview: expected an output that ends in .exr, found ", s.output));
}

/// Where frames go: a pattern with #. Makes the folder.
std::string outputPattern(const std::string& output, size_t frames) {
  const std::string extension = fs::path(output).extension().string();
  const bool is_file = extension == ".png" || extension == ".exr";
  if (!is_file) {
    if (output.find('#') != std::string::npos)
      throw UsageError(
          joinText("output: ", output, ": expected a name with # that ends in .png or .exr"));
    std::error_code error;
    fs::create_directories(output, error);
    require(!error && fs::is_directory(output), "render: ", output, ": cannot create the folder");
  } else if (frames > 1 && fs::path(output).filename().string().find('#') == std::string::npos) {
    throw UsageError(
        joinText("output: ", output, ": expected #### in the name of ", frames, " frames"));
  }
  const std::string pattern = is_file ? output : output + "/####.png";
  requireCreatable(framePath(pattern, 0));
  return pattern;
}

/// Generated or not and probability, [N, 2]; empty where the file records none.
std::vector<float> provenanceChannels(const Provenance& p) {
  std::vector<float> values;
  if (!p.recorded) return values;
  for (size_t i = 0; i < p.generated.size(); ++i)
    values.insert(values.end(), {float(p.generated[i]), p.probability[i]});
  return values;
}

void writeFrameExr(const RasterOutput& out, const Camera& camera, const std::string& path) {
  // Splats are blended as displayed values: linear becomes the colour of what they cover.
  std::vector<float> linear(out.colour.data.size());
  for (size_t i = 0; i < linear.size(); ++i) {
    const float alpha = out.alpha.data[i / 3];
    linear[i] = alpha > 0 ? alpha * linearFromSrgb(out.colour.data[i] / alpha) : 0.f;
  }
  std::vector<float> depth = out.depth.data, median = out.median_depth.data;
  for (std::vector<float>* values : {&depth, &median})
    for (float& d : *values) d = d > 0 ? d : kNoDepth;
  std::vector<ExrChannel> channels = {
      {"R", linear.data(), 3, true},     {"G", linear.data() + 1, 3, true},
      {"B", linear.data() + 2, 3, true}, {"A", out.alpha.data.data(), 1, true},
      {"Z", depth.data(), 1, false},     {"depth.median", median.data(), 1, false}};
  if (!out.channels.data.empty()) {
    channels.push_back({"provenance", out.channels.data.data(), 2, true});
    channels.push_back({"confidence", out.channels.data.data() + 1, 2, true});
  }
  writeExr(camera, channels, path);
}

}  // namespace

std::vector<Camera> turntableCameras(const Gaussians& gaussians, int count, int width, int height,
                                     double fov_degrees, const Eigen::Vector3d& up) {
  Camera c;
  c.width = width, c.height = height;
  c.fx = c.fy = width / (2 * std::tan(radians(fov_degrees) / 2));
  c.cx = width / 2., c.cy = height / 2.;
  const Eigen::AlignedBox3d box = bulk(gaussians);
  const Eigen::Vector3d centre = box.center(), axis = up.normalized();
  // The sphere around the box touches the picture's nearer edges.
  const double narrower = std::atan(std::min(width, height) / (2 * c.fx));
  const double distance = std::max(.5 * box.diagonal().norm(), 1e-3) / std::sin(narrower);
  const Eigen::Vector3d start = axis.unitOrthogonal() * std::cos(radians(kTurntableElevation)) +
                                axis * std::sin(radians(kTurntableElevation));
  std::vector<Camera> cameras;
  for (int i = 0; i < count; ++i) {
    const Eigen::AngleAxisd turn(2 * M_PI * i / count, axis);
    c.world_from_camera = lookAt(centre + distance * (turn * start), centre, axis);
    cameras.push_back(c);
  }
  return cameras;
}

std::vector<Camera> flythroughCameras(const std::vector<Camera>& through, int count) {
  const auto last = std::ptrdiff_t(through.size()) - 1;
  const auto at = [&](std::ptrdiff_t i) -> const Camera& {
    return through[size_t(std::clamp<std::ptrdiff_t>(i, 0, last))];
  };
  std::vector<Camera> cameras;
  for (int i = 0; i < count; ++i) {
    const double along = count > 1 ? double(last) * i / (count - 1) : 0;
    const auto k =
        std::clamp<std::ptrdiff_t>(std::ptrdiff_t(along), 0, std::max<std::ptrdiff_t>(0, last - 1));
    const double t = along - double(k);
    const auto place = [&](std::ptrdiff_t j) { return at(j).world_from_camera.translation(); };
    // Hermite form: the tangent at a camera is half the way from the one before to the one after.
    const Eigen::Vector3d p0 = place(k), p1 = place(k + 1);
    const Eigen::Vector3d m0 = .5 * (p1 - place(k - 1)), m1 = .5 * (place(k + 2) - p0);
    const double t2 = t * t, t3 = t2 * t;
    Camera c = at(0);
    c.fx = at(k).fx + t * (at(k + 1).fx - at(k).fx),
    c.fy = at(k).fy + t * (at(k + 1).fy - at(k).fy);
    c.cx = at(k).cx + t * (at(k + 1).cx - at(k).cx),
    c.cy = at(k).cy + t * (at(k + 1).cy - at(k).cy);
    const Eigen::Quaterniond from(at(k).world_from_camera.linear()),
        to(at(k + 1).world_from_camera.linear());
    c.world_from_camera.linear() = from.slerp(t, to).normalized().toRotationMatrix();
    c.world_from_camera.translation() = (2 * t3 - 3 * t2 + 1) * p0 + (t3 - 2 * t2 + t) * m0 +
                                        (3 * t2 - 2 * t3) * p1 + (t3 - t2) * m1;
    cameras.push_back(c);
  }
  return cameras;
}

std::string framePath(const std::string& pattern, int number) {
  const size_t end = pattern.find_last_of('#');
  if (end == std::string::npos) return pattern;
  const size_t before = pattern.find_last_not_of('#', end);
  const size_t begin = before == std::string::npos ? 0 : before + 1;
  std::string digits = std::to_string(number);
  if (const size_t length = end + 1 - begin; digits.size() < length)
    digits.insert(0, length - digits.size(), '0');
  return pattern.substr(0, begin) + digits + pattern.substr(end + 1);
}

Gaussians readSplats(const std::string& path, Provenance* provenance) {
  if (fs::path(path).extension() == ".ply") return readPly(path);
  if (fs::path(path).extension() == ".vdb") return readPointsVdb(path, provenance);
  throw UsageError(joinText("render: ", path, ": expected .ply or .points.vdb"));
}

void renderFrames(const RenderSettings& s, const std::function<void(const RenderedFrame&)>& written,
                  Progress& progress) {
  requireSettings(s);
  progress.start("read");
  Provenance provenance;
  const Gaussians g = readSplats(s.splats, &provenance);
  const std::vector<Frame> frames = framesToRender(s, g);
  const std::string pattern = outputPattern(s.output, frames.size());
  const bool is_exr = fs::path(pattern).extension() == ".exr";
  RasterSettings settings;
  settings.antialias = s.antialias.value_or(g.antialias);
  settings.median_depth = is_exr;
  const std::vector<float> values = is_exr ? provenanceChannels(provenance) : std::vector<float>();
  const ExtraChannels extra = values.empty() ? ExtraChannels() : ExtraChannels{2, values.data()};
  progress.end();
  progress.start("render");
  for (size_t i = 0; i < frames.size(); ++i) {
    report(progress, int(100 * i / frames.size()));
    const Frame& f = frames[i];
    RenderedFrame done{f.number, framePath(pattern, f.number), "", f.view};
    const RasterOutput out = rasterize(g, f.camera, settings, nullptr, extra);
    if (is_exr) {
      writeFrameExr(out, f.camera, done.image);
      if (s.preview) done.preview = fs::path(done.image).replace_extension(".png").string();
    }
    if (!is_exr || s.preview) writePng(out.colour, is_exr ? done.preview : done.image);
    written(done);
  }
  progress.end();
}

}  // namespace vdbc
