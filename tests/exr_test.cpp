#include "splat/exr.h"

#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <limits>

#include "tests/expect_error.h"
#include "tests/files.h"

namespace vdbc {
namespace {

Camera someCamera() {
  Camera c;
  c.width = 5, c.height = 3, c.fx = c.fy = 4, c.cx = 2, c.cy = 1.5;
  c.world_from_camera.translation() = Eigen::Vector3d(1, 2, 3);
  return c;
}

ExrFile open(const std::string& path) {
  const std::string bytes = bytesOf(path);
  return ExrFile("test", path, {bytes.begin(), bytes.end()});
}

TEST(Exr, ChannelsReadBackAsTheyWereStored) {
  const TemporaryFolder folder;
  std::vector<float> pair, z;  // interleaved, and by itself
  for (int i = 0; i < 15; ++i) pair.insert(pair.end(), {.1f * float(i), 1e6f}), z.push_back(1e-7f);
  writeExr(
      someCamera(),
      {{"R", pair.data(), 2, true}, {"G", pair.data() + 1, 2, true}, {"Z", z.data(), 1, false}},
      folder / "a.exr");
  const ExrFile file = open(folder / "a.exr");
  ASSERT_EQ(file.parts(), 1);
  EXPECT_EQ(file.channels(0), (std::vector<std::string>{"G", "R", "Z"}));
  EXPECT_TRUE(file.hasChannel(0, "Z"));
  EXPECT_FALSE(file.hasChannel(0, "A"));
  int width = 0, height = 0;
  file.size(0, &width, &height);
  EXPECT_EQ(width, 5);
  EXPECT_EQ(height, 3);
  const Image image = file.read(0, {"Z", "R", "G"}, 0);
  for (int i = 0; i < 15; ++i) {
    EXPECT_EQ(image.at(i % 5, i / 5, 0), 1e-7f);
    EXPECT_NEAR(image.at(i % 5, i / 5, 1), .1f * float(i), 1e-3);  // half
    EXPECT_EQ(image.at(i % 5, i / 5, 2), 65504);                   // the largest half
  }
}

TEST(Exr, MatricesTakePointsToTheCamera) {
  const TemporaryFolder folder;
  const std::vector<float> z(15, 1.f);
  writeExr(someCamera(), {{"Z", z.data(), 1, false}}, folder / "a.exr");
  const ExrFile file = open(folder / "a.exr");
  const Eigen::Vector4d p(1.5, 2.25, 5, 1);  // half a metre right, a quarter down, two ahead
  const auto axes_from_world = file.matrix("worldToCamera"), ndc = file.matrix("worldToNDC");
  ASSERT_TRUE(axes_from_world && ndc);
  EXPECT_TRUE((*axes_from_world * p).isApprox(Eigen::Vector4d(.5, -.25, 2, 1), 1e-6));
  const Eigen::Vector4d q = *ndc * p;
  EXPECT_NEAR(q.x() / q.w(), (4 * .25 + 2) / 5, 1e-6);
  EXPECT_NEAR(q.y() / q.w(), (4 * .125 + 1.5) / 3, 1e-6);
  EXPECT_FALSE(file.matrix("screenToWorld"));
}

TEST(Exr, FailuresAreErrorsThatNameTheFile) {
  const TemporaryFolder folder;
  const std::vector<float> z(15, 1.f);
  EXPECT_THROW(writeExr(someCamera(), {{"Z", z.data(), 1, false}}, folder / "no/such/a.exr"),
               Error);
  EXPECT_THROW(writeExr(Camera(), {{"Z", z.data(), 1, false}}, folder / "a.exr"), Error);
  EXPECT_TRUE(std::filesystem::is_empty(folder.path));
  expectError([] { ExrFile("readViews", "b.exr", {'h', 'i'}); }, {"readViews: b.exr: corrupt EXR"});
  writeExr(someCamera(), {{"Z", z.data(), 1, false}}, folder / "a.exr");
  const ExrFile file = open(folder / "a.exr");
  expectError([&] { file.read(0, {"A"}, 0); }, {"a.exr: corrupt EXR"});
}

}  // namespace
}  // namespace vdbc
