// Views of OpenEXR files, as renderers and ourselves write them.
#include <ImfChannelList.h>
#include <ImfCompression.h>
#include <ImfFrameBuffer.h>
#include <ImfHeader.h>
#include <ImfMatrixAttribute.h>
#include <ImfMultiPartOutputFile.h>
#include <ImfOutputPart.h>
#include <ImfPartType.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <limits>
#include <random>

#include "encoder/views/read_views.h"
#include "tests/view_files.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

using ExrViews = ViewFile;

TEST_F(ExrViews, WhatWriteExrWritesReadsBack) {
  for (unsigned seed = 1; seed <= 5; ++seed) {
    const View view = someView(seed);
    writeViewExr(view, path("a.exr"));
    const View back = readViews(path("a.exr"))[0];
    EXPECT_EQ(back.name, "a.exr");
    expectSameCamera(back.camera, view.camera, 1e-5);
    EXPECT_EQ(back.depth, view.depth);
    ASSERT_EQ(back.colour.data.size(), view.colour.data.size());
    for (size_t i = 0; i < back.colour.data.size(); ++i) {
      EXPECT_NEAR(back.colour.data[i], view.colour.data[i], 1e-3);  // half floats, linear
    }
  }
  EXPECT_EQ(readViews(folder_.path.string()).size(), 1u);
  EXPECT_EQ(conventionalUp(folder_.path.string()), Eigen::Vector3d::UnitY());
  int files = 0;
  for ([[maybe_unused]] const auto& entry : fs::directory_iterator(folder_.path)) ++files;
  EXPECT_EQ(files, 1);
}

TEST_F(ExrViews, EveryTruncationThrows) {
  writeViewExr(someView(1), path("whole.exr"));
  const std::string bytes = bytesOf(path("whole.exr"));
  for (size_t n = 0; n < bytes.size(); n += n < 150 || n + 40 > bytes.size() ? 1 : 11) {
    writeBytes(path("cut.exr"), bytes.substr(0, n));
    EXPECT_THROW(readViews(path("cut.exr")), Error) << n << " of " << bytes.size();
  }
}

TEST_F(ExrViews, FlippedBytesNeverCrash) {
  writeViewExr(someView(1), path("whole.exr"));
  const std::string bytes = bytesOf(path("whole.exr"));
  std::mt19937 random(3);
  for (int i = 0; i < 150; ++i) {
    std::string damaged = bytes;
    damaged[random() % (i % 2 ? 600 : damaged.size())] = char(random());
    writeBytes(path("damaged.exr"), damaged);
    try {
      readViews(path("damaged.exr"));
    } catch (const Error&) {
    }
  }
}

/// What a test EXR is made of: channels by part, each [height * width], float.
struct ExrPart {
  std::string name;
  std::vector<std::pair<std::string, std::vector<float>>> channels;
};

struct ExrCamera {
  Imath::M44f world_to_camera, world_to_ndc;
};

Imath::M44f rowMatrix(const Eigen::Matrix4d& m) {
  Imath::M44f result;
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c) result[r][c] = float(m(c, r));
  return result;
}

enum class Convention { kSpec, kMantra, kNdcYUp, kOpenGl };

/// The attributes that different renderers write for one camera. Built from projections of points,
/// not from the reader's formulas: each NDC row is chosen so that x_ndc / w is what the convention
/// says of the pixel position u = fx x / z + cx, v = cy - fy y / z (y up).
ExrCamera exrCameraOf(const Camera& c, Convention convention) {
  Eigen::Matrix4d view = c.world_from_camera.inverse().matrix();  // x right, y down, z forward
  view.row(1) *= -1;                                              // y up
  Eigen::Matrix4d ndc = Eigen::Matrix4d::Zero();                  // of (x, y up, z forward)
  const double w = c.width, h = c.height;
  if (convention == Convention::kSpec) {
    ndc.row(0) << c.fx / w, 0, c.cx / w, 0;   // u / W
    ndc.row(1) << 0, -c.fy / h, c.cy / h, 0;  // v / H
  } else {
    ndc.row(0) << 2 * c.fx / w, 0, 2 * c.cx / w - 1, 0;  // 2 u / W - 1
    ndc.row(1) << 0, 2 * c.fy / h, 1 - 2 * c.cy / h, 0;  // 1 - 2 v / H
  }
  ndc.row(2) << 0, 0, 1, -0.1;
  ndc.row(3) << 0, 0, 1, 0;
  if (convention == Convention::kMantra) {
    // w = -z, though worldToCamera has z forward: x and y come out negative, P00 stays positive.
    ndc.row(3) *= -1;
    ndc.row(0) << 2 * c.fx / w, 0, 2 * c.cx / w - 1, 0;
  }
  const Eigen::Matrix4d world_to_ndc = ndc * view;
  if (convention == Convention::kOpenGl) view.row(2) *= -1;  // looks along -z: determinant +1
  return {rowMatrix(view), rowMatrix(world_to_ndc)};
}

void writeParts(const std::string& path, int w, int h, const std::vector<ExrPart>& parts,
                const ExrCamera* camera, const Imath::Box2i* data_window = nullptr) {
  std::vector<Imf::Header> headers;
  for (const ExrPart& part : parts) {
    Imf::Header header(w, h);
    if (data_window) header.dataWindow() = *data_window;
    header.compression() = Imf::ZIPS_COMPRESSION;
    header.setType(Imf::SCANLINEIMAGE);
    header.setName(part.name);
    for (const auto& channel : part.channels) {
      header.channels().insert(channel.first, Imf::Channel(Imf::FLOAT));
    }
    if (camera && headers.empty()) {  // cameras are in the first part
      header.insert("worldToCamera", Imf::M44fAttribute(camera->world_to_camera));
      header.insert("worldToNDC", Imf::M44fAttribute(camera->world_to_ndc));
    }
    headers.push_back(header);
  }
  Imf::MultiPartOutputFile file(path.c_str(), headers.data(), int(headers.size()));
  for (size_t p = 0; p < parts.size(); ++p) {
    const Imath::Box2i window = headers[p].dataWindow();
    const size_t row = size_t(window.max.x - window.min.x + 1);
    Imf::FrameBuffer buffer;
    for (const auto& [name, values] : parts[p].channels) {
      buffer.insert(name, Imf::Slice::Make(Imf::FLOAT, values.data(), window, sizeof(float),
                                           sizeof(float) * row));
    }
    Imf::OutputPart part(file, int(p));
    part.setFrameBuffer(buffer);
    part.writePixels(window.max.y - window.min.y + 1);
  }
}

std::vector<ExrPart> rgbAndZ(const View& view) {
  const std::vector<float> grey(view.depth.size(), 0.25f);
  return {{"rgba", {{"R", grey}, {"G", grey}, {"B", grey}, {"Z", view.depth}}}};
}

/// World positions of the pixel centres, as three channels.
std::array<std::vector<float>, 3> positionsOf(const View& view) {
  std::array<std::vector<float>, 3> channels;
  for (int y = 0; y < view.camera.height; ++y)
    for (int x = 0; x < view.camera.width; ++x) {
      const float z = view.depth[size_t(y * view.camera.width + x)];
      const Eigen::Vector3d p =
          z > 0 ? view.camera.unproject(x + 0.5, y + 0.5, z) : Eigen::Vector3d::Zero();
      for (size_t k = 0; k < 3; ++k) channels[k].push_back(float(p[Eigen::Index(k)]));
    }
  return channels;
}

TEST_F(ExrViews, ConventionsGiveTheSameCamera) {
  const View view = someView(7);
  for (Convention convention :
       {Convention::kSpec, Convention::kMantra, Convention::kNdcYUp, Convention::kOpenGl}) {
    SCOPED_TRACE(int(convention));
    const ExrCamera camera = exrCameraOf(view.camera, convention);
    writeParts(path("a.exr"), 20, 14, rgbAndZ(view), &camera);
    const View back = readViews(path("a.exr"))[0];
    expectSameCamera(back.camera, view.camera, 1e-5);
    EXPECT_EQ(back.depth, view.depth);
    EXPECT_NEAR(back.colour.data[0], srgbFromLinear(0.25f), 1e-6);
  }
}

TEST_F(ExrViews, WorldPositionsBeatZ) {
  View view = someView(8);
  // Far from the world's origin's pixel, so that background (0, 0, 0) reprojects nowhere near.
  const ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
  const auto p = positionsOf(view);
  for (const std::array<std::string, 3>& names :
       {std::array<std::string, 3>{"P.X", "P.Y", "P.Z"},
        {"P.x", "P.y", "P.z"},
        {"ViewLayer.Position.X", "ViewLayer.Position.Y", "ViewLayer.Position.Z"}}) {
    std::vector<ExrPart> parts = rgbAndZ(view);
    for (float& z : parts[0].channels[3].second) z = 9.f;  // a Z that lies
    parts.push_back({"position", {{names[0], p[0]}, {names[1], p[1]}, {names[2], p[2]}}});
    writeParts(path("a.exr"), 20, 14, parts, &camera);
    const View back = readViews(path("a.exr"))[0];
    for (size_t i = 0; i < view.depth.size(); ++i) {
      EXPECT_NEAR(back.depth[i], view.depth[i], 2e-5) << names[0] << " " << i;
    }
  }
}

TEST_F(ExrViews, PointsThatMissTheirPixelAreInvalid) {
  View view = someView(8);
  auto p = positionsOf(view);
  const size_t pixel = 5 * 20 + 9;  // measured: 109 is no multiple of 7
  const float z = view.depth[pixel];
  for (const auto& [shift, valid] :
       {std::pair{0.45, true}, {0.55, false}, {-0.45, true}, {-0.55, false}}) {
    const Eigen::Vector3d moved = view.camera.unproject(9.5 + shift, 5.5, z);
    for (size_t k = 0; k < 3; ++k) p[k][pixel] = float(moved[Eigen::Index(k)]);
    std::vector<ExrPart> parts = rgbAndZ(view);
    parts.push_back({"position", {{"P.X", p[0]}, {"P.Y", p[1]}, {"P.Z", p[2]}}});
    const ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
    writeParts(path("a.exr"), 20, 14, parts, &camera);
    EXPECT_EQ(readViews(path("a.exr"))[0].depth[pixel] > 0, valid) << shift;
  }
}

TEST_F(ExrViews, DepthChannelsOfManyNames) {
  const View view = someView(9);
  const ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
  for (const char* name : {"Z", "depth.Z", "ViewLayer.Depth.Z", "depth", "Pz"}) {
    std::vector<ExrPart> parts = rgbAndZ(view);
    parts[0].channels.pop_back();
    parts.push_back({"second", {{name, view.depth}}});
    // A part of normals, whose Z is no depth.
    const std::vector<float> ones(view.depth.size(), 1.f);
    parts.push_back({"normals", {{"X", ones}, {"Y", ones}, {"Z", ones}}});
    std::swap(parts[1], parts[2]);
    writeParts(path("a.exr"), 20, 14, parts, &camera);
    EXPECT_EQ(readViews(path("a.exr"))[0].depth, view.depth) << name;
  }
}

TEST_F(ExrViews, ColourOfAViewLayer) {
  const View view = someView(9);
  const ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
  const size_t n = view.depth.size();
  const std::vector<ExrPart> parts = {{"ViewLayer",
                                       {{"ViewLayer.Combined.R", std::vector<float>(n, 0.1f)},
                                        {"ViewLayer.Combined.G", std::vector<float>(n, 0.2f)},
                                        {"ViewLayer.Combined.B", std::vector<float>(n, 5.f)},
                                        {"ViewLayer.Depth.Z", view.depth}}}};
  writeParts(path("a.exr"), 20, 14, parts, &camera);
  const Image colour = readViews(path("a.exr"))[0].colour;
  EXPECT_NEAR(colour.at(3, 3, 0), srgbFromLinear(0.1f), 1e-6);
  EXPECT_NEAR(colour.at(3, 3, 1), srgbFromLinear(0.2f), 1e-6);
  EXPECT_NEAR(colour.at(3, 3, 2), 1.f, 1e-6);
}

TEST_F(ExrViews, NanFarNegativeAndPartlyCoveredPixelsHaveNoDepth) {
  View view = someView(9);
  const ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
  std::vector<ExrPart> parts = rgbAndZ(view);
  const float inf = std::numeric_limits<float>::infinity(), nan = std::nanf("");
  std::vector<float>& z = parts[0].channels[3].second;
  z[1] = nan, z[2] = inf, z[3] = -inf, z[4] = -2, z[5] = 1e10f;
  parts[0].channels[0].second[20] = nan;  // a red value
  std::vector<float> alpha(z.size(), 1.f);
  alpha[8] = 0.5f, alpha[9] = nan, alpha[10] = 0.9995f;
  parts[0].channels.emplace_back("A", alpha);
  writeParts(path("a.exr"), 20, 14, parts, &camera);
  const View back = readViews(path("a.exr"))[0];
  for (size_t i : {1, 2, 3, 4, 5, 8, 9}) EXPECT_EQ(back.depth[i], 0) << i;
  EXPECT_EQ(back.depth[6], view.depth[6]);
  EXPECT_EQ(back.depth[10], view.depth[10]);
  EXPECT_EQ(back.colour.data[60], 0);
  for (float v : back.colour.data) EXPECT_TRUE(v >= 0 && v <= 1);
}

TEST_F(ExrViews, PixelsOutsideTheDataWindowAreEmpty) {
  const View view = someView(9);
  const ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
  // Overlaps the display window (0,0)-(19,13) in x 5-19, y 0-10 and sticks out of it.
  const Imath::Box2i window(Imath::V2i(5, -2), Imath::V2i(24, 10));
  std::vector<float> grey, z;
  for (int y = -2; y <= 10; ++y)
    for (int x = 5; x <= 24; ++x) grey.push_back(0.5f), z.push_back(float(100 * (y + 3) + x));
  writeParts(path("a.exr"), 20, 14, {{"p", {{"R", grey}, {"G", grey}, {"B", grey}, {"Z", z}}}},
             &camera, &window);
  const View back = readViews(path("a.exr"))[0];
  ASSERT_EQ(back.depth.size(), 280u);
  for (int y = 0; y < 14; ++y)
    for (int x = 0; x < 20; ++x) {
      const bool inside = x >= 5 && y <= 10;
      EXPECT_EQ(back.depth[size_t(y * 20 + x)], inside ? float(100 * (y + 3) + x) : 0.f);
      EXPECT_EQ(back.colour.at(x, y, 1) > 0, inside);
    }
}

TEST_F(ExrViews, UnusableFilesThrow) {
  const View view = someView(9);
  ExrCamera camera = exrCameraOf(view.camera, Convention::kSpec);
  const auto expectExrError = [&](const std::vector<ExrPart>& parts, const ExrCamera* c,
                                  const std::vector<std::string>& words) {
    writeParts(path("a.exr"), 20, 14, parts, c);
    expectUnreadable(path("a.exr"), words);
  };
  expectExrError(rgbAndZ(view), nullptr, {"a.exr", "worldToCamera"});
  std::vector<ExrPart> parts = rgbAndZ(view);
  parts[0].channels.pop_back();
  expectExrError(parts, &camera, {"a.exr", "no depth"});
  expectExrError({{"p", {{"Z", view.depth}}}}, &camera, {"a.exr", "no colour"});
  parts = rgbAndZ(view);
  std::fill(parts[0].channels[3].second.begin(), parts[0].channels[3].second.end(), 1e10f);
  expectExrError(parts, &camera, {"a.exr", "no valid pixel"});
  ExrCamera broken = camera;
  for (int c = 0; c < 3; ++c) broken.world_to_camera[0][c] = 0;
  expectExrError(rgbAndZ(view), &broken, {"a.exr", "worldToCamera"});
  broken = camera;
  broken.world_to_ndc[1][1] = std::nanf("");
  expectExrError(rgbAndZ(view), &broken, {"a.exr", "not finite"});
  broken = camera;
  broken.world_to_ndc = Imath::M44f(0.f);
  expectExrError(rgbAndZ(view), &broken, {"a.exr", "worldToNDC"});
  broken.world_to_ndc = exrCameraOf(someView(10).camera, Convention::kSpec).world_to_ndc;
  expectExrError(rgbAndZ(view), &broken, {"a.exr", "different cameras"});
  writeBytes(path("a.exr"), "hello");
  expectUnreadable(path("a.exr"), {"a.exr", "corrupt"});
}

}  // namespace
}  // namespace vdbc
