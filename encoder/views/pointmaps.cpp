// Views from pointmaps of feed-forward reconstruction (VGGT's predictions.npz): docs/formats.md.
#include <algorithm>
#include <cmath>
#include <filesystem>
#include <optional>

#include "encoder/views/npz.h"
#include "encoder/views/view_reading.h"

namespace vdbc {
namespace {

using Poses = std::vector<Eigen::Isometry3d>;

constexpr double kMinBaselineM = 0.01;  // spread of metric cameras that still tells a scale
// A pixel whose confidence is below this share of the file's median has no depth.
constexpr float kMedianShare = 0.5f;

std::string shapeText(const std::vector<int64_t>& shape) {
  std::string text;
  for (int64_t d : shape)
    text += (text.empty() ? "" : ", ") + (d < 0 ? std::string("any") : std::to_string(d));
  return "(" + text + ")";
}

/// -1 in `expected` is any number.
void requireShape(const NpzFile& npz, const NpyArray& array, const std::vector<int64_t>& expected,
                  const char* described) {
  bool equal = array.shape.size() == expected.size();
  for (size_t i = 0; equal && i < expected.size(); ++i)
    equal = expected[i] < 0 || array.shape[i] == expected[i];
  require(equal, kReadViews, ": ", npz.path(), ": ", array.name, ": expected shape ", described,
          " = ", shapeText(expected), ", found ", shapeText(array.shape));
}

/// The poses of an array (S, 3, 4) or (S, 4, 4); none if it is not there.
Poses posesOf(const NpzFile& npz, const char* name) {
  const auto array = npz.read(name);
  if (!array) return {};
  const int64_t rows = array->shape.size() == 3 && array->shape[1] == 4 ? 4 : 3;
  requireShape(npz, *array, {-1, rows, 4}, "(S, 3, 4)");
  Poses poses;
  for (int64_t s = 0; s < array->shape[0]; ++s) {
    Eigen::Matrix4d m = Eigen::Matrix4d::Identity();
    for (int64_t r = 0; r < rows; ++r)
      for (int64_t c = 0; c < 4; ++c) m(r, c) = array->at(size_t((s * rows + r) * 4 + c));
    poses.push_back(rigid(m, npz.path(), joinText(name, " ", s)));
  }
  return poses;
}

/// Cameras of the file. `local` has the pointmaps' own frame and units; `world` is metric, and the
/// same as `local` where the file has no metric poses.
struct PointmapPoses {
  Poses local, world;  // camera to frame, [S]
  PointmapScale scale;
};

/// Root mean square distance of the cameras from their mean place.
double spread(const Poses& poses) {
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const auto& p : poses) mean += p.translation() / double(poses.size());
  double sum = 0;
  for (const auto& p : poses) sum += (p.translation() - mean).squaredNorm();
  return std::sqrt(sum / double(poses.size()));
}

PointmapScale scaleOf(const Poses& extrinsic, const Poses& c2w, double given,
                      const std::string& path) {
  require(std::isfinite(given) && given >= 0, kReadViews, ": ", path,
          ": expected a positive scale, found ", given);
  if (given > 0) return {given, "given"};
  if (extrinsic.empty()) return {1, "c2w"};
  require(!c2w.empty(), kReadViews, ": ", path,
          ": pointmaps of unknown scale (expected metres per ",
          "unit, or metric poses `c2w` besides `extrinsic`)");
  const double metres = spread(c2w), units = spread(extrinsic);
  require(metres >= kMinBaselineM && units > 1e-9 && std::isfinite(metres / units), kReadViews,
          ": ", path, ": ", c2w.size(), " cameras with a baseline of ", metres,
          " m do not tell the pointmaps' scale (expected metres per unit)");
  return {metres / units, "camera baseline"};
}

/// Both kinds of poses as the file has them, extrinsic inverted.
std::pair<Poses, Poses> readPoses(const NpzFile& npz) {
  Poses extrinsic = posesOf(npz, "extrinsic"), c2w = posesOf(npz, "c2w");
  require(!extrinsic.empty() || !c2w.empty(), kReadViews, ": ", npz.path(),
          ": no cameras (expected arrays extrinsic or c2w)");
  require(extrinsic.empty() || c2w.empty() || extrinsic.size() == c2w.size(), kReadViews, ": ",
          npz.path(), ": expected as many c2w as extrinsic, found ", c2w.size(), " and ",
          extrinsic.size());
  for (auto& pose : extrinsic) pose = pose.inverse();
  return {std::move(extrinsic), std::move(c2w)};
}

PointmapPoses pointmapPoses(const NpzFile& npz, double given) {
  auto [extrinsic, c2w] = readPoses(npz);
  PointmapPoses poses;
  poses.scale = scaleOf(extrinsic, c2w, given, npz.path());
  const double scale = poses.scale.metres_per_unit;
  poses.world = c2w.empty() ? extrinsic : c2w;
  poses.local = extrinsic.empty() ? c2w : extrinsic;
  if (c2w.empty())
    for (auto& pose : poses.world) pose.translation() *= scale;
  if (extrinsic.empty())
    for (auto& pose : poses.local) pose.translation() /= scale;
  return poses;
}

/// Cameras of all frames in their metric world; width and height are the pointmaps'.
std::vector<Camera> camerasOf(const NpzFile& npz, const Poses& poses, int width, int height) {
  const auto intrinsic = npz.read("intrinsic");
  require(bool(intrinsic), kReadViews, ": ", npz.path(), ": no array intrinsic");
  requireShape(npz, *intrinsic, {int64_t(poses.size()), 3, 3}, "(S, 3, 3)");
  std::vector<Camera> cameras;
  for (size_t s = 0; s < poses.size(); ++s) {
    Eigen::Matrix3d k;
    for (int i = 0; i < 9; ++i) k(i / 3, i % 3) = intrinsic->at(9 * s + size_t(i));
    const bool pinhole = k.allFinite() && k(0, 0) > 0 && k(1, 1) > 0 && k(2, 2) == 1 &&
                         std::abs(k(0, 1)) <= 1e-6 * k(0, 0) && k(1, 0) == 0 && k(2, 0) == 0 &&
                         k(2, 1) == 0;
    require(pinhole, kReadViews, ": ", npz.path(), ": intrinsic ", s,
            ": expected fx 0 cx, 0 fy cy, 0 0 1 with focal lengths above 0");
    cameras.push_back({width, height, k(0, 0), k(1, 1), k(0, 2), k(1, 2), poses[s]});
  }
  return cameras;
}

/// What of the file holds the geometry.
struct Geometry {
  std::optional<NpyArray> depth;       // (S, H, W, 1) or (S, H, W), or else
  std::optional<NpyArray> points;      // (S, H, W, 3)
  std::optional<NpyArray> confidence;  // (S, H, W)
  int64_t width = 0, height = 0;

  size_t pixels() const { return size_t(width) * size_t(height); }
};

/// Types and shapes only, checked against each other.
Geometry describeGeometry(const NpzFile& npz, int64_t views) {
  Geometry g;
  g.depth = npz.describe("depth");
  if (!g.depth) g.points = npz.describe("world_points");
  require(g.depth || g.points, kReadViews, ": ", npz.path(),
          ": no depth (expected arrays depth or world_points)");
  if (g.depth && g.depth->shape.size() == 3)
    requireShape(npz, *g.depth, {views, -1, -1}, "(S, H, W)");
  else if (g.depth)
    requireShape(npz, *g.depth, {views, -1, -1, 1}, "(S, H, W, 1)");
  else
    requireShape(npz, *g.points, {views, -1, -1, 3}, "(S, H, W, 3)");
  const NpyArray& array = g.depth ? *g.depth : *g.points;
  g.height = array.shape[1], g.width = array.shape[2];
  require(g.width > 0 && g.height > 0 && g.pixels() <= kMaxImagePixels, kReadViews, ": ",
          npz.path(), ": expected 1 to 2^28 pixels, found ", g.width, " x ", g.height);
  for (const char* name : {g.depth ? "depth_conf" : "world_points_conf", "conf"})
    if (!g.confidence) g.confidence = npz.describe(name);
  if (g.confidence) requireShape(npz, *g.confidence, {views, g.height, g.width}, "(S, H, W)");
  return g;
}

/// The least confidence of a pixel with depth: half the median of the file, so that neither the
/// scale of a network's confidences nor their offset has to be known; constant ones drop nothing.
float leastConfidence(const NpyArray& confidence) {
  std::vector<float> values;
  const size_t n = (confidence.bytes.size() - confidence.begin) / size_t(confidence.word);
  for (size_t i = 0; i < n; ++i)
    if (const auto v = float(confidence.at(i)); std::isfinite(v)) values.push_back(v);
  if (values.empty()) return 0;
  const auto middle = values.begin() + std::ptrdiff_t(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return kMedianShare * *middle;
}

/// Planar depth of a frame in the file's units, by its camera in the pointmaps' frame.
std::vector<float> depthOf(const Geometry& g, size_t frame, const Camera& local) {
  const size_t n = g.pixels();
  if (!g.depth) {
    Image positions(local.width, local.height, 3);
    for (size_t i = 0; i < 3 * n; ++i) positions.data[i] = float(g.points->at(3 * frame * n + i));
    return depthFromPositions(positions, local);
  }
  std::vector<float> depth(n);
  for (size_t i = 0; i < n; ++i) {
    const auto z = float(g.depth->at(frame * n + i));
    depth[i] = z > 0 && z < kFarDepth ? z : 0.f;
  }
  return depth;
}

Image colourOf(const NpyArray& images, size_t frame, int width, int height) {
  Image colour(width, height, 3);
  const size_t n = size_t(width) * size_t(height);
  const float scale = images.word == 1 ? 1.f / 255 : 1.f;
  for (size_t c = 0; c < 3; ++c)
    for (size_t i = 0; i < n; ++i) {
      const float v = scale * float(images.at((frame * 3 + c) * n + i));
      colour.data[3 * i + c] = v > 0 ? std::min(v, 1.f) : 0.f;  // NaN: 0
    }
  return colour;
}

}  // namespace

std::vector<View> readPointmaps(const std::string& path, const ReadViewsSettings& settings) {
  const NpzFile npz(kReadViews, path);
  const PointmapPoses poses = pointmapPoses(npz, settings.metres_per_unit);
  const auto scale = float(poses.scale.metres_per_unit);
  const auto count = int64_t(poses.world.size());
  Geometry g = describeGeometry(npz, count);
  const std::vector<Camera> cameras = camerasOf(npz, poses.world, int(g.width), int(g.height));
  const std::vector<size_t> frames = selectFrames(settings, size_t(count), path);
  const auto viewOf = [&](size_t s) {
    View view;
    view.name = joinText("view ", s);
    view.camera = cameras[s];
    return view;
  };
  if (settings.cameras_only) return readAll(frames, viewOf);

  auto images = npz.describe("images");
  require(bool(images), kReadViews, ": ", path, ": no colour (expected an array images)");
  requireShape(npz, *images, {count, 3, g.height, g.width}, "(S, 3, H, W)");
  images = npz.read("images");
  for (auto* array : {&g.depth, &g.points, &g.confidence})
    if (*array) *array = npz.read((*array)->name);
  const float least = g.confidence ? leastConfidence(*g.confidence) : 0;
  return readAll(frames, [&](size_t s) {
    View view = viewOf(s);
    view.colour = colourOf(*images, s, view.camera.width, view.camera.height);
    Camera local = view.camera;
    local.world_from_camera = poses.local[s];
    view.depth = depthOf(g, s, local);
    for (size_t i = 0; i < view.depth.size(); ++i) {
      const bool sure = !g.confidence || float(g.confidence->at(s * g.pixels() + i)) >= least;
      view.depth[i] = sure ? view.depth[i] * scale : 0.f;
    }
    requireDepth(view, path);
    return view;
  });
}

PointmapScale pointmapScale(const std::string& npz_path, double given) {
  return pointmapPoses(NpzFile(kReadViews, npz_path), given).scale;
}

Eigen::Vector3d pointmapUp(const std::string& path) {
  const auto [extrinsic, c2w] = readPoses(NpzFile(kReadViews, path));
  Eigen::Vector3d up = Eigen::Vector3d::Zero();
  for (const auto& pose : c2w.empty() ? extrinsic : c2w) up -= pose.linear().col(1);
  const auto count = double(std::max(extrinsic.size(), c2w.size()));
  require(up.norm() > 0.1 * count, kReadViews, ": ", path,
          ": the cameras do not tell where up is (expected the direction that points up)");
  return up.normalized();
}

}  // namespace vdbc
