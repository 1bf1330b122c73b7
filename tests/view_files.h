#pragma once
// Views and their files, for tests of what reads them.
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <random>
#include <string>
#include <vector>

#include "encoder/views/read_views.h"
#include "splat/exr.h"
#include "splat/view.h"
#include "tests/expect_error.h"
#include "tests/files.h"

namespace vdbc {

/// A smooth picture, which JPEG keeps.
inline Image smoothImage(int w, int h, int c) {
  Image image(w, h, c);
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x)
      for (int k = 0; k < c; ++k)
        image.at(x, y, k) = 0.5f + 0.4f * std::sin(0.05f * float(x) + 0.03f * float(y) + float(k));
  return image;
}

inline Eigen::Isometry3d somePose(unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal;
  Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
  pose.linear() = Eigen::Quaterniond(normal(random), normal(random), normal(random), normal(random))
                      .normalized()
                      .toRotationMatrix();
  pose.translation() = Eigen::Vector3d(normal(random), normal(random), normal(random)) * 2;
  return pose;
}

/// A wall and floor seen by a camera with an off-centre principal point; some pixels unmeasured.
inline View someView(unsigned seed, int w = 20, int h = 14) {
  View view;
  view.name = "some";
  view.camera.width = w, view.camera.height = h;
  view.camera.fx = 17.25, view.camera.fy = 18.5;
  view.camera.cx = 0.5 * w + 0.7, view.camera.cy = 0.5 * h - 0.4;
  view.camera.world_from_camera = somePose(seed);
  view.colour = Image(w, h, 3);
  std::mt19937 random(seed + 100);
  for (float& v : view.colour.data) v = float(random() % 256) / 255.f;
  for (int i = 0; i < w * h; ++i) view.depth.push_back(1.f + 0.013f * float(i));
  for (int i = 0; i < w * h; i += 7) view.depth[size_t(i)] = 0;
  return view;
}

inline void expectSameCamera(const Camera& a, const Camera& b, double tolerance) {
  EXPECT_EQ(a.width, b.width);
  EXPECT_EQ(a.height, b.height);
  EXPECT_NEAR(a.fx, b.fx, tolerance * b.fx);
  EXPECT_NEAR(a.fy, b.fy, tolerance * b.fy);
  EXPECT_NEAR(a.cx, b.cx, tolerance * b.width);
  EXPECT_NEAR(a.cy, b.cy, tolerance * b.height);
  EXPECT_LT((a.world_from_camera.matrix() - b.world_from_camera.matrix()).cwiseAbs().maxCoeff(),
            tolerance);
}

/// The view as a renderer leaves it: half R, G, B scene-linear, float Z planar, kNoDepth where
/// there is none.
inline void writeViewExr(const View& view, const std::string& path) {
  std::vector<float> linear, depth;
  for (float v : view.colour.data) linear.push_back(linearFromSrgb(v));
  for (float z : view.depth) depth.push_back(z > 0 ? z : kNoDepth);
  writeExr(view.camera,
           {{"R", linear.data(), 3, true},
            {"G", linear.data() + 1, 3, true},
            {"B", linear.data() + 2, 3, true},
            {"Z", depth.data(), 1, false}},
           path);
}

/// A test with a folder of its own.
class ViewFile : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_ / name; }

  /// Expects readViews(what) to throw one line that contains all of `parts`.
  static void expectUnreadable(const std::string& what, const std::vector<std::string>& parts,
                               const ReadViewsSettings& settings = {}) {
    SCOPED_TRACE(what);
    expectError([&] { readViews(what, settings); }, parts);
  }

  TemporaryFolder folder_;
};

}  // namespace vdbc
