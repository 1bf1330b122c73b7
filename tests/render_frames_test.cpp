#include <ImfChannelList.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfInputFile.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <filesystem>
#include <functional>
#include <map>
#include <random>

#include "encoder/views/read_views.h"
#include "houdini_style_tools/render.h"
#include "splat/exr.h"
#include "splat/image_files.h"
#include "splat/ply.h"
#include "splat/points_vdb.h"
#include "splat/rasterize.h"
#include "splat/view.h"

namespace vdbc {
namespace {

Gaussians ball(const Eigen::Vector3f& centre, float radius) {
  Gaussians g;
  g.resize(2000, 0);
  std::mt19937 random(1);
  for (auto& mean : g.mean) {
    for (int k = 0; k < 3; ++k) mean[k] = float(random()) / float(random.max()) - .5f;
    mean = centre + radius * mean.normalized();
  }
  return g;
}

void expectRotation(const Eigen::Matrix3d& m) {
  EXPECT_LT((m.transpose() * m - Eigen::Matrix3d::Identity()).norm(), 1e-12);
  EXPECT_NEAR(m.determinant(), 1, 1e-12);
}

TEST(Turntable, GoesRoundOutsideWithAllInThePicture) {
  Gaussians g = ball({3, -2, 1}, 2);
  g.mean[0] = {1000, 0, 0};  // a stray one does not push the cameras away
  for (const Eigen::Vector3d& up : {Eigen::Vector3d(0, 0, 1), Eigen::Vector3d(0, 2, 0)}) {
    const std::vector<Camera> cameras = turntableCameras(g, 12, 320, 180, 60, up);
    ASSERT_EQ(cameras.size(), 12u);
    for (size_t i = 0; i < 12; ++i) {
      const Camera& c = cameras[i];
      EXPECT_EQ(c.width, 320);
      EXPECT_EQ(c.height, 180);
      EXPECT_NEAR(c.fx, 160 / std::tan(M_PI / 6), 1e-9);
      expectRotation(c.world_from_camera.linear());
      const Eigen::Vector3d middle = c.project({3, -2, 1});
      EXPECT_NEAR(middle.x(), 160, 10);
      EXPECT_NEAR(middle.y(), 90, 10);
      for (size_t k = 1; k < g.mean.size(); ++k) {
        const Eigen::Vector3d p = c.project(g.mean[k].cast<double>());
        ASSERT_GT(p.z(), 0);
        ASSERT_TRUE(p.x() > 0 && p.x() < 320 && p.y() > 0 && p.y() < 180) << p.transpose();
      }
      // Up in the world is up in the picture, and the cameras look down on the middle.
      EXPECT_LT(c.world_from_camera.linear().col(1).dot(up), 0);
      EXPECT_LT(c.world_from_camera.linear().col(2).dot(up), 0);
      // Equal steps.
      const Camera& next = cameras[(i + 1) % 12];
      const double step =
          (c.world_from_camera.translation() - next.world_from_camera.translation()).norm();
      const double first =
          (cameras[0].world_from_camera.translation() - cameras[1].world_from_camera.translation())
              .norm();
      EXPECT_NEAR(step, first, 1e-9);
    }
  }
}

TEST(Turntable, TakesAnyGaussians) {
  for (const Gaussians& g : {Gaussians(), ball({1, 1, 1}, 0)}) {
    for (const Camera& c : turntableCameras(g, 3, 64, 64, 90, Eigen::Vector3d::UnitZ()))
      EXPECT_TRUE(c.world_from_camera.matrix().allFinite());
  }
}

std::vector<Camera> someCameras(int count) {
  std::vector<Camera> cameras;
  for (int i = 0; i < count; ++i) {
    Camera c;
    c.width = 64, c.height = 48, c.cx = 32, c.cy = 24;
    c.fx = c.fy = 50 + 10 * i;
    c.world_from_camera = Eigen::Translation3d(i, std::sin(i), .5 * i * i) *
                          Eigen::AngleAxisd(.7 * i, Eigen::Vector3d(1, 2, 3).normalized());
    cameras.push_back(c);
  }
  return cameras;
}

TEST(Flythrough, PassesThroughEveryCamera) {
  const std::vector<Camera> through = someCameras(5), path = flythroughCameras(through, 41);
  ASSERT_EQ(path.size(), 41u);
  for (size_t i = 0; i < 5; ++i) {
    EXPECT_TRUE(path[10 * i].world_from_camera.isApprox(through[i].world_from_camera, 1e-9)) << i;
    EXPECT_NEAR(path[10 * i].fx, through[i].fx, 1e-9);
  }
  for (const Camera& c : path) expectRotation(c.world_from_camera.linear());
}

TEST(Flythrough, IsSmooth) {
  const int n = 4001;
  const std::vector<Camera> path = flythroughCameras(someCameras(5), n);
  for (size_t i = 1; i + 1 < path.size(); ++i) {
    const auto place = [&](size_t k) { return path[k].world_from_camera.translation(); };
    const Eigen::Vector3d before = place(i) - place(i - 1), after = place(i + 1) - place(i);
    ASSERT_LT((after - before).norm(), .02 * before.norm()) << i;  // no corner in the path
  }
  // Cameras on a line at equal distances: the path keeps the line.
  std::vector<Camera> line = someCameras(4);
  for (int i = 0; i < 4; ++i)
    line[size_t(i)].world_from_camera.translation() = Eigen::Vector3d(i, 2 * i, 0);
  for (const Camera& c : flythroughCameras(line, 31)) {
    const Eigen::Vector3d p = c.world_from_camera.translation();
    EXPECT_NEAR(p.y(), 2 * p.x(), 1e-9);
  }
}

TEST(Flythrough, TakesTheShorterTurnAndFewFrames) {
  std::vector<Camera> two = someCameras(2);
  two[0].world_from_camera.linear() = Eigen::AngleAxisd(3, Eigen::Vector3d::UnitZ()).matrix();
  two[1].world_from_camera.linear() = Eigen::AngleAxisd(-3, Eigen::Vector3d::UnitZ()).matrix();
  const Camera middle = flythroughCameras(two, 3)[1];  // over 180 degrees, not over 0
  EXPECT_NEAR(middle.world_from_camera.linear()(0, 0), -1, 1e-9);
  EXPECT_EQ(flythroughCameras(two, 1).size(), 1u);
  EXPECT_EQ(flythroughCameras(two, 2).size(), 2u);
}

// ---- files

namespace fs = std::filesystem;

class RenderFrames : public testing::Test {
 protected:
  RenderFrames() { fs::create_directories(folder_); }
  ~RenderFrames() override { fs::remove_all(folder_); }
  std::string path(const std::string& name) const { return folder_ + "/" + name; }

  std::vector<RenderedFrame> render(const RenderSettings& settings) const {
    std::vector<RenderedFrame> frames;
    Progress silent;
    renderFrames(
        settings, [&](const RenderedFrame& f) { frames.push_back(f); }, silent);
    return frames;
  }

  RenderSettings turn(const std::string& splats, const std::string& output) const {
    RenderSettings s;
    s.splats = path(splats), s.output = path(output);
    s.turntable = 4, s.width = 96, s.height = 64;
    return s;
  }

  const std::string folder_ =
      (fs::temp_directory_path() / ("vdbc_render_" + std::to_string(getpid()))).string();
};

Gaussians colourful() {
  Gaussians g = ball({1, 2, 3}, 1);
  std::mt19937 random(2);
  for (auto& s : g.log_scale) s = {-2.5f, -3.5f, -4.5f};
  for (float& logit : g.opacity_logit) logit = 4 * float(random()) / float(random.max()) - 2;
  for (float& v : g.sh) v = 2 * float(random()) / float(random.max()) - 1;
  return g;
}

/// All channels of an EXR, as floats.
std::map<std::string, std::vector<float>> exrChannels(const std::string& path) {
  Imf::InputFile file(path.c_str());
  const auto box = file.header().dataWindow();
  const size_t width = size_t(box.max.x + 1), height = size_t(box.max.y + 1);
  std::map<std::string, std::vector<float>> result;
  Imf::FrameBuffer buffer;
  for (auto c = file.header().channels().begin(); c != file.header().channels().end(); ++c) {
    std::vector<float>& values = result[c.name()];
    values.resize(width * height);
    buffer.insert(c.name(),
                  Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(values.data()), 4, 4 * width));
  }
  file.setFrameBuffer(buffer);
  file.readPixels(0, int(height) - 1);
  return result;
}

void expectClose(const std::vector<float>& found, const std::vector<float>& expected,
                 float tolerance) {
  ASSERT_EQ(found.size(), expected.size());
  for (size_t i = 0; i < found.size(); ++i)
    ASSERT_NEAR(found[i], expected[i], tolerance * std::max(1.f, std::abs(expected[i]))) << i;
}

TEST_F(RenderFrames, ExrHoldsWhatTheRasteriserSees) {
  const Gaussians written = colourful();
  Provenance provenance;
  for (size_t i = 0; i < written.mean.size(); ++i) {
    provenance.generated.push_back(written.mean[i].x() > 1);
    provenance.probability.push_back(written.mean[i].x() > 1 ? .25f : 1.f);
  }
  writePointsVdb(written, provenance, path("a.points.vdb"));
  RenderSettings s = turn("a.points.vdb", "turn.##.exr");
  s.preview = true, s.frames = {1, 3};
  const std::vector<RenderedFrame> frames = render(s);
  ASSERT_EQ(frames.size(), 2u);
  EXPECT_EQ(frames[1].number, 3);
  EXPECT_EQ(frames[1].image, path("turn.03.exr"));
  EXPECT_EQ(frames[1].preview, path("turn.03.png"));

  Provenance back;
  const Gaussians g = readPointsVdb(path("a.points.vdb"), &back);
  const Camera camera = turntableCameras(g, 4, 96, 64, 60, s.up)[3];
  std::vector<float> extra;
  for (size_t i = 0; i < back.generated.size(); ++i)
    extra.insert(extra.end(), {float(back.generated[i]), back.probability[i]});
  RasterSettings settings;
  settings.median_depth = true;
  const RasterOutput out = rasterize(g, camera, settings, nullptr, {2, extra.data()});
  auto exr = exrChannels(path("turn.03.exr"));
  EXPECT_EQ(exr.size(), 8u);
  expectClose(exr["A"], out.alpha.data, 1e-3f);
  const float* colour = out.colour.data.data();
  std::vector<float> z = out.depth.data, median = out.median_depth.data, generated, confidence, red;
  for (size_t i = 0; i < z.size(); ++i) {
    if (z[i] == 0) z[i] = kNoDepth;
    if (median[i] == 0) median[i] = kNoDepth;
    generated.push_back(out.channels.data[2 * i]),
        confidence.push_back(out.channels.data[2 * i + 1]);
    const float alpha = out.alpha.data[i];
    red.push_back(alpha > 0 ? alpha * linearFromSrgb(colour[3 * i] / alpha) : 0);
  }
  expectClose(exr["Z"], z, 1e-6f);
  expectClose(exr["depth.median"], median, 1e-6f);
  expectClose(exr["provenance"], generated, 1e-3f);
  expectClose(exr["confidence"], confidence, 1e-3f);
  expectClose(exr["R"], red, 1e-3f);
  EXPECT_GT(*std::max_element(generated.begin(), generated.end()), .5f);

  // Read back as a view: the camera is the one rendered from.
  const View view = readViews(path("turn.03.exr"))[0];
  EXPECT_TRUE(view.camera.world_from_camera.isApprox(camera.world_from_camera, 1e-5));
  EXPECT_NEAR(view.camera.fx, camera.fx, 1e-2);
  EXPECT_NEAR(view.camera.cy, camera.cy, 1e-2);
  EXPECT_GT(psnr(readImage(path("turn.03.png")), out.colour), 50);
}

TEST_F(RenderFrames, PlyHasNoProvenanceToShow) {
  writePly(colourful(), path("a.ply"));
  render(turn("a.ply", "####.exr"));
  auto exr = exrChannels(path("0002.exr"));
  EXPECT_EQ(exr.count("provenance"), 0u);
  EXPECT_EQ(exr.count("confidence"), 0u);
  EXPECT_EQ(exr.size(), 6u);
  EXPECT_FALSE(fs::exists(path("0002.png")));
}

TEST_F(RenderFrames, AntialiasFollowsTheFileUnlessTold) {
  Gaussians g = colourful();
  for (auto& s : g.log_scale) s.setConstant(-6);  // smaller than a pixel: the two ways differ
  for (bool recorded : {false, true}) {
    g.antialias = recorded;
    writePly(g, path("a.ply"));
    const Camera camera = turntableCameras(g, 4, 96, 64, 60, Eigen::Vector3d::UnitZ())[0];
    for (const std::optional<bool> told :
         {std::optional<bool>(), std::optional<bool>(false), std::optional<bool>(true)}) {
      RenderSettings s = turn("a.ply", "out");
      s.frames = {0}, s.antialias = told;
      render(s);
      RasterSettings with, without;
      with.antialias = true;
      const Image shown = readImage(path("out/0000.png"));
      const bool expected = told.value_or(recorded);
      EXPECT_GT(psnr(shown, rasterize(g, camera, expected ? with : without).colour), 50);
      EXPECT_LT(psnr(shown, rasterize(g, camera, expected ? without : with).colour), 40);
    }
  }
}

TEST_F(RenderFrames, FilesRenderAlike) {
  Gaussians g = colourful();
  writePly(g, path("a.ply"));
  writePointsVdb(g, {}, path("a.points.vdb"));
  render(turn("a.ply", "ply")), render(turn("a.points.vdb", "vdb"));
  for (const char* name : {"/0000.png", "/0003.png"})
    EXPECT_GT(psnr(readImage(path("ply") + name), readImage(path("vdb") + name)), 50);
}

/// Asks to stop once two frames are there.
class Impatient : public Progress {
 public:
  int frames = 0;
  bool wasInterrupted(int) override { return frames == 2; }
};

TEST_F(RenderFrames, AnInterruptLeavesWholeFrames) {
  writePly(colourful(), path("a.ply"));
  Impatient progress;
  EXPECT_THROW(renderFrames(
                   turn("a.ply", "cut/####.exr"), [&](const RenderedFrame&) { ++progress.frames; },
                   progress),
               Cancelled);
  int files = 0;
  for (const auto& entry : fs::directory_iterator(path("cut"))) {
    EXPECT_FALSE(exrChannels(entry.path().string()).empty());
    ++files;
  }
  EXPECT_EQ(files, 2);
}

TEST_F(RenderFrames, ContradictionsAreRefused) {
  writePly(colourful(), path("a.ply"));
  const RenderSettings good = turn("a.ply", "x.####.exr");
  const auto refuses = [&](const std::function<void(RenderSettings*)>& change) {
    RenderSettings s = good;
    change(&s);
    EXPECT_THROW(render(s), UsageError);
  };
  refuses([](RenderSettings* s) { s->turntable = 0; });  // no cameras at all
  refuses([](RenderSettings* s) { s->cameras = "views"; });
  refuses([](RenderSettings* s) { s->flythrough = 3; });
  refuses([](RenderSettings* s) { s->frames = {4}; });
  refuses([&](RenderSettings* s) { s->output = path("x.exr"); });  // one name for four frames
  refuses([&](RenderSettings* s) { s->output = path("x.####.tif"); });
  refuses([&](RenderSettings* s) { s->preview = true, s->output = path("x.####.png"); });
  refuses([&](RenderSettings* s) { s->splats = path("a.xyz"); });
  EXPECT_EQ(std::distance(fs::directory_iterator(folder_), fs::directory_iterator()), 1);
  RenderSettings one = good;
  one.frames = {2}, one.output = path("one.png");
  EXPECT_EQ(render(one)[0].image, path("one.png"));
}

TEST(FramePath, PadsTheLastRunOfHashes) {
  EXPECT_EQ(framePath("a/####.png", 7), "a/0007.png");
  EXPECT_EQ(framePath("a#/x.##.exr", 123), "a#/x.123.exr");
  EXPECT_EQ(framePath("#.png", 0), "0.png");
  EXPECT_EQ(framePath("plain.png", 3), "plain.png");
}

}  // namespace
}  // namespace vdbc
