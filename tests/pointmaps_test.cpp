// Laws of pointmaps as views (.npz): an analytic scene comes back at its size, by every key and
// type, from our writer's files and NumPy's; hostile files give one line each.
#include <gtest/gtest.h>
#include <half.h>
#include <zip.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>

#include "encoder/views/read_views.h"
#include "splat/view.h"
#include "tests/files.h"
#include "tests/view_files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Shape = std::vector<int64_t>;
using Eigen::Vector3d;

constexpr int kWidth = 24, kHeight = 16;

/// An array of an .npz: the bytes of its .npy member.
struct Member {
  std::string name, bytes;
  bool deflated = false;
};

std::string npyBytes(const std::string& descr, const std::string& shape, const std::string& values,
                     const char* order = "False") {
  std::string header =
      "{'descr': " + descr + ", 'fortran_order': " + order + ", 'shape': " + shape + ", }";
  header.resize((10 + header.size() + 64) / 64 * 64 - 10, ' ');
  header.back() = '\n';
  const auto length = uint16_t(header.size());
  std::string bytes("\x93NUMPY\x01\x00", 8);
  bytes.append(reinterpret_cast<const char*>(&length), 2);
  return bytes + header + values;
}

std::string shapeText(const Shape& shape) {
  std::string text = "(";
  for (int64_t d : shape) text += std::to_string(d) + ",";
  return text + ")";
}

/// float32 ('<f4'), float16, float64 or uint8, of values 0-1 then.
Member member(const std::string& name, const Shape& shape, const std::vector<double>& values,
              const std::string& type = "<f4") {
  std::string bytes;
  const auto add = [&](auto value) {
    bytes.append(reinterpret_cast<const char*>(&value), sizeof(value));
  };
  for (double v : values) {
    if (type == "<f4") add(float(v));
    if (type == "<f8") add(v);
    if (type == "<f2") add(half(float(v)).bits());
    if (type == "|u1") add(uint8_t(std::lround(255 * v)));
  }
  return {name, npyBytes("'" + type + "'", shapeText(shape), bytes)};
}

void writeNpz(const std::vector<Member>& members, const std::string& path) {
  std::filesystem::remove(path);
  zip_t* zip = zip_open(path.c_str(), ZIP_CREATE | ZIP_EXCL, nullptr);
  ASSERT_NE(zip, nullptr);
  for (const Member& m : members) {
    zip_source_t* source = zip_source_buffer(zip, m.bytes.data(), m.bytes.size(), 0);
    const zip_int64_t i = zip_file_add(zip, (m.name + ".npy").c_str(), source, 0);
    ASSERT_GE(i, 0);
    zip_set_file_compression(zip, zip_uint64_t(i), m.deflated ? ZIP_CM_DEFLATE : ZIP_CM_STORE, 0);
  }
  ASSERT_EQ(zip_close(zip), 0);
}

/// A ball in a box, seen by `count` cameras; metres.
struct Scene {
  std::vector<Camera> cameras;
  std::vector<std::vector<float>> depth;
  std::vector<Image> colour;
};

double planarDepth(const Camera& c, int x, int y) {
  const Vector3d o = c.world_from_camera.translation();
  const Vector3d ray =
      c.world_from_camera.linear() * Vector3d((x + .5 - c.cx) / c.fx, (y + .5 - c.cy) / c.fy, 1);
  double z = 1e9;
  for (int axis = 0; axis < 3; ++axis)  // walls at +-3 m, seen from inside
    if (ray[axis] != 0) z = std::min(z, ((ray[axis] > 0 ? 3 : -3) - o[axis]) / ray[axis]);
  const double a = ray.squaredNorm(), b = o.dot(ray), d = b * b - a * (o.squaredNorm() - 1);
  if (d > 0 && -b - std::sqrt(d) > 0) z = std::min(z, (-b - std::sqrt(d)) / a);  // unit ball
  return z;
}

Scene ballInBox(int count = 3) {
  Scene scene;
  for (int s = 0; s < count; ++s) {
    Camera c{kWidth, kHeight, 20.5 + s, 21.5, 12.25, 7.5, Eigen::Isometry3d::Identity()};
    const Vector3d eye(2.2 * std::cos(.7 * s), 2.2 * std::sin(.7 * s), .4 * s - .3);
    c.world_from_camera = lookAt(eye, Vector3d::Zero(), Vector3d::UnitZ());
    scene.cameras.push_back(c);
    scene.depth.emplace_back();
    scene.colour.emplace_back(kWidth, kHeight, 3);
    for (int y = 0; y < kHeight; ++y)
      for (int i = 0; i < kWidth; ++i) {
        scene.depth.back().push_back(float(planarDepth(c, i, y)));
        for (int k = 0; k < 3; ++k)
          scene.colour.back().at(i, y, k) = float((31 * i + 17 * y + 59 * k + s) % 256) / 255.f;
      }
  }
  return scene;
}

/// The keys of an .npz in units of 1 / scale metres; its world is `file_from_world` of the metres'.
struct Arrays {
  std::map<std::string, Member> members;
  std::vector<Member> list(bool deflated = false) const {
    std::vector<Member> all;
    for (auto [name, m] : members) m.deflated = deflated, all.push_back(m);
    return all;
  }
};

std::vector<double> rowsOf(const Eigen::Isometry3d& pose) {
  std::vector<double> rows;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 4; ++c) rows.push_back(pose.matrix()(r, c));
  return rows;
}

Arrays arraysOf(const Scene& scene, double scale, const std::string& type = "<f4",
                const Eigen::Isometry3d& file_from_world = Eigen::Isometry3d::Identity()) {
  std::vector<double> extrinsic, intrinsic, depth, points, images, c2w;
  const auto n = int64_t(scene.cameras.size());
  for (size_t s = 0; s < scene.cameras.size(); ++s) {
    const Camera& c = scene.cameras[s];
    Eigen::Isometry3d pose = file_from_world * c.world_from_camera;
    pose.translation() /= scale;
    for (double v : rowsOf(pose.inverse())) extrinsic.push_back(v);
    for (double v : rowsOf(c.world_from_camera)) c2w.push_back(v);
    for (double v : {c.fx, 0., c.cx, 0., c.fy, c.cy, 0., 0., 1.}) intrinsic.push_back(v);
    for (int y = 0; y < kHeight; ++y)
      for (int x = 0; x < kWidth; ++x) {
        const double z = double(scene.depth[s][size_t(y * kWidth + x)]);
        depth.push_back(z / scale);
        const Vector3d p = file_from_world * c.unproject(x + .5, y + .5, z) / scale;
        points.insert(points.end(), {p.x(), p.y(), p.z()});
      }
    for (int k = 0; k < 3; ++k)
      for (int y = 0; y < kHeight; ++y)
        for (int x = 0; x < kWidth; ++x) images.push_back(double(scene.colour[s].at(x, y, k)));
  }
  const std::string exact = type == "<f8" ? type : "<f4";
  Arrays a;
  const auto add = [&](const Member& m) { a.members[m.name] = m; };
  add(member("extrinsic", {n, 3, 4}, extrinsic, exact));
  add(member("c2w", {n, 3, 4}, c2w, exact));
  add(member("intrinsic", {n, 3, 3}, intrinsic, exact));
  add(member("depth", {n, kHeight, kWidth, 1}, depth, type == "|u1" ? exact : type));
  add(member("world_points", {n, kHeight, kWidth, 3}, points, exact));
  add(member("images", {n, 3, kHeight, kWidth}, images, type));
  return a;
}

ReadViewsSettings scaled(double metres_per_unit) {
  ReadViewsSettings s;
  s.metres_per_unit = metres_per_unit;
  return s;
}

void expectScene(const std::vector<View>& views, const Scene& scene, double tolerance) {
  ASSERT_EQ(views.size(), scene.cameras.size());
  for (size_t s = 0; s < views.size(); ++s) {
    const Camera &c = views[s].camera, &d = scene.cameras[s];
    EXPECT_NEAR(c.fx, d.fx, 1e-5);
    EXPECT_NEAR(c.cy, d.cy, 1e-5);
    EXPECT_LT((c.world_from_camera.matrix() - d.world_from_camera.matrix()).norm(), 1e-5);
    ASSERT_EQ(views[s].depth.size(), scene.depth[s].size());
    for (size_t i = 0; i < scene.depth[s].size(); ++i)
      ASSERT_NEAR(views[s].depth[i], scene.depth[s][i], tolerance * scene.depth[s][i]);
    ASSERT_EQ(views[s].colour.data.size(), scene.colour[s].data.size());
    for (size_t i = 0; i < views[s].colour.data.size(); ++i)
      ASSERT_NEAR(views[s].colour.data[i], scene.colour[s].data[i], tolerance + 1e-6);
  }
}

TEST(Pointmap, AnalyticDepthComesBackByEveryKeyAndType) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox();
  const std::string path = folder / "a.npz";
  for (const char* type : {"<f4", "<f8", "<f2", "|u1"})
    for (bool deflated : {false, true})
      for (bool points : {false, true}) {
        SCOPED_TRACE(testing::Message()
                     << type << " deflated " << deflated << " points " << points);
        Arrays a = arraysOf(scene, 2.5, type);
        a.members.erase("c2w");
        a.members.erase(points ? "depth" : "world_points");
        writeNpz(a.list(deflated), path);
        expectScene(readViews(path, scaled(2.5)), scene, type == std::string("<f2") ? 1e-3 : 1e-5);
      }
}

TEST(Pointmap, DepthMayLackItsLastDimension) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox(1);
  Arrays a = arraysOf(scene, 1);
  a.members.erase("c2w");
  a.members["depth"] =
      member("depth", {1, kHeight, kWidth}, {scene.depth[0].begin(), scene.depth[0].end()});
  writeNpz(a.list(), folder / "a.npz");
  expectScene(readViews(folder / "a.npz", scaled(1)), scene, 1e-6);
}

/// The message of the Error that reading throws, one line that starts with the path.
std::string errorOf(const std::string& path, const ReadViewsSettings& settings = scaled(1)) {
  try {
    readViews(path, settings);
  } catch (const Error& e) {
    const std::string text = e.what();
    EXPECT_EQ(text.find('\n'), std::string::npos) << text;
    EXPECT_NE(text.find(path), std::string::npos) << text;
    return text;
  }
  return "";
}
#define EXPECT_SAYS(message, part) EXPECT_NE((message).find(part), std::string::npos) << (message)

TEST(Pointmap, ScaleIsGivenOrFromTheBaselineOrRefused) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox();
  const std::string path = folder / "a.npz";
  Eigen::Isometry3d turned = Eigen::Isometry3d::Identity();
  turned.linear() = Eigen::AngleAxisd(.8, Vector3d(1, 2, -1).normalized()).toRotationMatrix();
  turned.translation() = Vector3d(4, -1, 2);
  for (bool points : {false, true}) {  // metric poses in a world of their own
    Arrays a = arraysOf(scene, 3.75, "<f8", turned);
    a.members.erase(points ? "depth" : "world_points");
    writeNpz(a.list(), path);
    expectScene(readViews(path), scene, 1e-5);
  }
  EXPECT_NEAR(pointmapScale(path, 0).metres_per_unit, 3.75, 1e-9);
  EXPECT_EQ(pointmapScale(path, 0).source, "camera baseline");
  EXPECT_EQ(pointmapScale(path, 2).metres_per_unit, 2);
  EXPECT_EQ(pointmapScale(path, 2).source, "given");
  EXPECT_NEAR(readViews(path, scaled(2))[0].depth[0], scene.depth[0][0] * 2 / 3.75, 1e-5);

  Arrays metric = arraysOf(scene, 1);
  metric.members.erase("extrinsic");
  writeNpz(metric.list(), path);
  expectScene(readViews(path), scene, 1e-5);
  EXPECT_EQ(pointmapScale(path, 0).source, "c2w");

  Arrays unknown = arraysOf(scene, 1);
  unknown.members.erase("c2w");
  writeNpz(unknown.list(), path);
  EXPECT_SAYS(errorOf(path, {}), "expected metres per unit");
  writeNpz(arraysOf(ballInBox(1), 1).list(), path);  // one camera has no baseline
  EXPECT_SAYS(errorOf(path, {}), "expected metres per unit");
  expectScene(readViews(path, scaled(1)), ballInBox(1), 1e-5);
  Scene still = ballInBox();
  for (Camera& c : still.cameras) c.world_from_camera = still.cameras[0].world_from_camera;
  writeNpz(arraysOf(still, 1).list(), path);
  EXPECT_SAYS(errorOf(path, {}), "expected metres per unit");
}

TEST(Pointmap, OnlyPointmapsTakeAScale) {
  const TemporaryFolder folder;
  View view;
  view.camera = ballInBox(1).cameras[0];
  view.colour = Image(kWidth, kHeight, 3, .5f);
  view.depth.assign(kWidth * kHeight, 2.f);
  writeViews({view}, folder / "capture");
  writeViewExr(view, folder / "a.exr");
  EXPECT_SAYS(errorOf(folder / "capture", scaled(1)), "metres already");
  EXPECT_SAYS(errorOf(folder / "a.exr", scaled(1)), "metres already");
}

TEST(Pointmap, PointsThatMissTheirPixelAreInvalid) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox(1);
  Arrays a = arraysOf(scene, 1);
  a.members.erase("depth");
  const Camera& c = scene.cameras[0];
  std::vector<double> points;
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x) {
      const double off = x % 2 ? .4 : .6;
      Vector3d p =
          c.unproject(x + .5 + off, y + .5, double(scene.depth[0][size_t(y * kWidth + x)]));
      if (y == 0) p.x() = NAN;
      points.insert(points.end(), {p.x(), p.y(), p.z()});
    }
  a.members["world_points"] = member("world_points", {1, kHeight, kWidth, 3}, points);
  writeNpz(a.list(), folder / "a.npz");
  const View view = readViews(folder / "a.npz", scaled(1))[0];
  for (int y = 0; y < kHeight; ++y)
    for (int x = 0; x < kWidth; ++x)
      EXPECT_EQ(view.depth[size_t(y * kWidth + x)] > 0, y > 0 && x % 2 == 1) << x << " " << y;
}

TEST(Pointmap, ConfidenceBelowHalfOfItsMedianIsNoDepth) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox(2);
  Arrays a = arraysOf(scene, 1);
  const auto pixels = int64_t(kWidth * kHeight);
  std::vector<double> confidence(size_t(2 * pixels), 8.);
  confidence[3] = 3.9, confidence[4] = 4, confidence[5] = NAN, confidence[size_t(pixels)] = 1;
  a.members["conf"] = member("conf", {2, kHeight, kWidth}, confidence);
  writeNpz(a.list(), folder / "a.npz");
  const std::vector<View> views = readViews(folder / "a.npz");
  for (int64_t i = 0; i < pixels; ++i) {
    EXPECT_EQ(views[0].depth[size_t(i)] > 0, i != 3 && i != 5) << i;
    EXPECT_EQ(views[1].depth[size_t(i)] > 0, i != 0) << i;
  }
  // What belongs to depth comes first; constant confidence drops nothing.
  a.members["depth_conf"] =
      member("depth_conf", {2, kHeight, kWidth}, std::vector<double>(size_t(2 * pixels), 1.));
  writeNpz(a.list(), folder / "a.npz");
  expectScene(readViews(folder / "a.npz"), scene, 1e-5);
}

TEST(Pointmap, FramesAndCamerasAlone) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox();
  writeNpz(arraysOf(scene, 1).list(), folder / "a.npz");
  ReadViewsSettings settings;
  settings.frames = {2, 0};
  const std::vector<View> two = readViews(folder / "a.npz", settings);
  ASSERT_EQ(two.size(), 2u);
  EXPECT_NEAR(two[0].depth[5], scene.depth[2][5], 1e-5);
  EXPECT_NEAR(two[1].depth[5], scene.depth[0][5], 1e-5);
  settings.frames = {3};
  EXPECT_SAYS(errorOf(folder / "a.npz", settings), "out of range");

  Arrays bare = arraysOf(scene, 1);
  bare.members.erase("images");
  writeNpz(bare.list(), folder / "a.npz");
  EXPECT_SAYS(errorOf(folder / "a.npz", {}), "images");
  settings = {};
  settings.cameras_only = true;
  const std::vector<View> cameras = readViews(folder / "a.npz", settings);
  ASSERT_EQ(cameras.size(), 3u);
  EXPECT_EQ(cameras[2].camera.width, kWidth);
  EXPECT_TRUE(cameras[2].depth.empty());
  // The cameras look at the ball from around it, upright but for their pitch.
  EXPECT_GT(conventionalUp(folder / "a.npz").z(), .95);
  EXPECT_NEAR(conventionalUp(folder / "a.npz").norm(), 1, 1e-9);
}

// ---- files that cannot be used

TEST(Pointmap, UnusableArraysThrow) {
  const TemporaryFolder folder;
  const Scene scene = ballInBox();
  const std::string path = folder / "a.npz";
  const auto says = [&](const char* part, const std::vector<Member>& changed) {
    Arrays a = arraysOf(scene, 1);
    for (const Member& m : changed) {
      a.members[m.name] = m;
      if (m.bytes.empty()) a.members.erase(m.name);
    }
    writeNpz(a.list(), path);
    EXPECT_SAYS(errorOf(path), part);
  };
  const auto zeros = [](const std::string& name, const Shape& shape) {
    size_t n = 1;
    for (int64_t d : shape) n *= size_t(d);
    return member(name, shape, std::vector<double>(n, 0.));
  };
  const std::string values(3 * kHeight * kWidth * 4, '\0');
  const std::string shape = shapeText({3, kHeight, kWidth, 1});
  const auto depth = [&](const std::string& descr, const std::string& dims,
                         const char* order = "False") {
    return Member{"depth", npyBytes(descr, dims, values, order)};
  };
  says("no cameras", {{"extrinsic", ""}, {"c2w", ""}});
  says("intrinsic", {{"intrinsic", ""}});
  says("no depth", {{"depth", ""}, {"world_points", ""}});
  says("images", {{"images", ""}});
  says("valid pixel", {zeros("depth", {3, kHeight, kWidth, 1})});
  // Shapes that do not fit each other.
  says("intrinsic", {zeros("intrinsic", {2, 3, 3})});
  says("c2w", {zeros("c2w", {3, 3, 3})});
  says("rigid", {zeros("extrinsic", {3, 3, 4})});
  says("focal", {zeros("intrinsic", {3, 3, 3})});
  says("depth", {zeros("depth", {2, kHeight, kWidth, 1})});
  says("depth", {zeros("depth", {3, kHeight, kWidth, 2})});
  says("images", {zeros("images", {3, 3, kHeight, kWidth - 1})});
  says("images", {zeros("images", {3, kHeight, kWidth, 3})});
  says("conf", {zeros("conf", {3, kHeight, 1})});
  // Types and orders.
  says("float32", {depth("'>f4'", shape)});
  says("float32", {depth("'<i4'", shape)});
  says("float32", {depth("[('a', '<f4')]", shape)});
  says("Fortran", {depth("'<f4'", shape, "True")});
  // Headers.
  says("npy array", {{"depth", "no array at all"}});
  says("npy array", {{"depth", std::string("\x93NUMPY\x01\x00\xff\xff{", 11)}});
  says("shape", {depth("'<f4'", "(-1, 3)")});
  says("shape", {depth("'<f4'", "(1, 1, 1, 1, 1, 1, 1, 1, 1)")});
  says("shape", {depth("'<f4'", "(3, x)")});
  says("too large", {depth("'<f4'", "(268435456, 268435456, 268435456)")});
  says("expected", {depth("'<f4'", "(100000, 10000)")});
  says("expected", {depth("'<f4'", shapeText({3, kHeight, kWidth, 2}))});
  // Pickled objects are not looked at.
  says("no depth", {{"world_points", ""}, {"depth", npyBytes("'|O'", "(1,)", "\x80\x04K\x2a.")}});
  says("", {{"world_points", npyBytes("'|O'", "(1,)", "\x80\x04K\x2a.")}});
}

TEST(Pointmap, EveryTruncationThrows) {
  const TemporaryFolder folder;
  writeNpz(arraysOf(ballInBox(), 1).list(true), folder / "a.npz");
  const std::string bytes = bytesOf(folder / "a.npz");
  for (size_t n = 0; n < bytes.size(); n += n < 100 || n + 100 > bytes.size() ? 1 : 997) {
    writeBytes(folder / "cut.npz", bytes.substr(0, n));
    EXPECT_NE(errorOf(folder / "cut.npz"), "") << n;
  }
  EXPECT_NE(errorOf(folder / "missing.npz"), "");
}

TEST(Pointmap, FlippedBytesNeverCrash) {
  const TemporaryFolder folder;
  for (bool deflated : {false, true}) {
    writeNpz(arraysOf(ballInBox(2), 1).list(deflated), folder / "a.npz");
    const std::string bytes = bytesOf(folder / "a.npz");
    for (size_t i = 0; i < 600; ++i) {
      std::string bad = bytes;
      // Half of them in the central directory.
      const size_t at = i % 2 ? bytes.size() - 1 - (i * 7) % 600 : (i * 7919) % bytes.size();
      bad[at] = char(bad[at] ^ (1 << i % 8));
      writeBytes(folder / "bad.npz", bad);
      errorOf(folder / "bad.npz");
    }
  }
}

TEST(Pointmap, ADirectoryThatClaimsTooMuchTakesNoMemory) {
  const TemporaryFolder folder;
  Arrays a = arraysOf(ballInBox(), 1);
  a.members["depth"] = {"depth", npyBytes("'<f4'", "(1073741824,)", "")};
  const auto size = uint32_t(a.members["depth"].bytes.size());
  writeNpz(a.list(), folder / "a.npz");
  std::string bytes = bytesOf(folder / "a.npz");
  const std::string name = "depth.npy";
  // Sizes stand 8 bytes before the name in its local header (uncompressed; 12: compressed) and 22
  // (26) before it in the directory.
  for (size_t at = bytes.find(name); at != std::string::npos; at = bytes.find(name, at + 1))
    for (size_t back : {8, 22}) {
      uint32_t stored = 0;
      std::memcpy(&stored, bytes.data() + at - back, 4);
      if (stored == size) stored = 0xf0000000u;
      std::memcpy(bytes.data() + at - back, &stored, 4);
    }
  writeBytes(folder / "bad.npz", bytes);
  EXPECT_SAYS(errorOf(folder / "bad.npz"), "depth");
}

// ---- NumPy

TEST(Pointmap, FilesOfNumPyAreRead) {
  if (outputOf("python3 -c 'import numpy; print(1)'").empty())
    GTEST_SKIP() << "python3-numpy is not installed";
  const TemporaryFolder folder;
  const Scene scene = ballInBox();
  Arrays a = arraysOf(scene, 2.5);
  a.members.erase("c2w");
  writeNpz(a.list(), folder / "ours.npz");  // NumPy reads ours and writes its own
  writeBytes(folder / "write.py", R"(
import numpy as np, sys
arrays = dict(np.load(sys.argv[1]))
assert arrays['images'].shape == (3, 3, 16, 24) and arrays['depth'].dtype == np.float32
arrays['depth_conf'] = np.ones((3, 16, 24), np.float64)
arrays['anything'] = np.array({'a': 1}, dtype=object)
np.savez(sys.argv[2] + '/stored.npz', **arrays)
arrays['intrinsic'] = arrays['intrinsic'].astype(np.float64)
np.savez_compressed(sys.argv[2] + '/deflated.npz', **arrays)
arrays['depth'] = np.asfortranarray(arrays['depth'])
np.savez(sys.argv[2] + '/fortran.npz', **arrays)
print('written')
)");
  const std::string text = outputOf("python3 " + folder / "write.py" + " " + folder / "ours.npz" +
                                    " " + folder.path.string());
  ASSERT_NE(text.find("written"), std::string::npos) << text;
  for (const char* name : {"stored.npz", "deflated.npz"})
    expectScene(readViews(folder / name, scaled(2.5)), scene, 1e-5);
  EXPECT_SAYS(errorOf(folder / "fortran.npz"), "Fortran");
}

}  // namespace
}  // namespace vdbc
