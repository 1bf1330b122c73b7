// Views of nerfstudio's transforms.json.
#include <gtest/gtest.h>

#include <cmath>
#include <nlohmann/json.hpp>

#include "encoder/views/read_views.h"
#include "splat/image_files.h"
#include "tests/view_files.h"

namespace vdbc {
namespace {

using Json = nlohmann::json;

class TransformsJson : public ViewFile {
 protected:
  /// A valid transforms.json of one 8 x 6 frame with its pictures, to be spoiled by tests.
  Json writeSmallCapture() {
    Image colour(8, 6, 3, 0.5f);
    writePng(colour, path("a.png"));
    writePng16(std::vector<uint16_t>(48, 2000), 8, 6, path("a_depth.png"));
    Json json = {{"fl_x", 10.0}, {"fl_y", 11.0}, {"cx", 4.0}, {"cy", 3.0}, {"w", 8}, {"h", 6}};
    json["frames"] = Json::array();
    json["frames"].push_back(
        {{"file_path", "a.png"},
         {"depth_file_path", "a_depth.png"},
         {"transform_matrix", {{1, 0, 0, 1}, {0, 1, 0, 2}, {0, 0, 1, 3}, {0, 0, 0, 1}}}});
    return json;
  }
  std::vector<View> readJson(const Json& json) {
    writeBytes(path("transforms.json"), json.dump());
    return readViews(folder_.path.string());
  }
  void expectJsonError(const Json& json, const std::vector<std::string>& parts) {
    writeBytes(path("transforms.json"), json.dump());
    expectUnreadable(folder_.path.string(), parts);
  }
};

TEST_F(TransformsJson, WriteViewsReadsBack) {
  std::vector<View> views = {someView(1), someView(2), someView(3)};
  for (int different_cameras : {0, 1}) {
    if (different_cameras) views[2].camera.fx = 30;
    const std::string folder = path("capture" + std::to_string(different_cameras));
    writeViews(views, folder);
    const std::vector<View> back = readViews(folder);
    ASSERT_EQ(back.size(), 3u);
    for (size_t i = 0; i < 3; ++i) {
      expectSameCamera(back[i].camera, views[i].camera, 1e-12);
      EXPECT_EQ(back[i].colour.data, views[i].colour.data);  // was at 8 bits already
      ASSERT_EQ(back[i].depth.size(), views[i].depth.size());
      for (size_t p = 0; p < back[i].depth.size(); ++p) {
        EXPECT_NEAR(back[i].depth[p], views[i].depth[p], 0.00051);
        EXPECT_EQ(back[i].depth[p] > 0, views[i].depth[p] > 0);
      }
    }
    EXPECT_EQ(readViews(folder + "/transforms.json").size(), 3u);
  }
  EXPECT_EQ(conventionalUp(path("capture0")), Eigen::Vector3d::UnitZ());
}

TEST_F(TransformsJson, WriteViewsDropsDepthThatSixteenBitsCannotHold) {
  View view = someView(1);
  view.depth[1] = 65.534f, view.depth[2] = 65.535f, view.depth[3] = 1e9f;
  view.depth[4] = std::nanf(""), view.depth[5] = -1;
  writeViews({view}, path("c"));
  const View back = readViews(path("c"))[0];
  EXPECT_FLOAT_EQ(back.depth[1], 65.534f);
  for (size_t i = 2; i <= 5; ++i) EXPECT_EQ(back.depth[i], 0) << i;
}

TEST_F(TransformsJson, OpenGlPoseBecomesOpenCv) {
  const View view = readJson(writeSmallCapture())[0];
  EXPECT_EQ(view.name, "a.png");
  // Camera at (1, 2, 3) that looks along -z with y up: 2 m ahead of the centre pixel.
  EXPECT_LT((view.camera.unproject(4, 3, 2) - Eigen::Vector3d(1, 2, 1)).norm(), 1e-12);
  // A pixel right of and below the centre lies at +x and -y.
  EXPECT_LT((view.camera.unproject(5, 4, 10) - Eigen::Vector3d(2, 2 - 10 / 11.0, -7)).norm(),
            1e-12);
  for (float z : view.depth) EXPECT_FLOAT_EQ(z, 2.f);
}

TEST_F(TransformsJson, FrameIntrinsicsOverrideTheFiles) {
  Json json = writeSmallCapture();
  json["frames"][0]["fl_x"] = 44.0;
  json["frames"][0]["cy"] = 2.5;
  const Camera camera = readJson(json)[0].camera;
  EXPECT_EQ(camera.fx, 44);
  EXPECT_EQ(camera.fy, 11);
  EXPECT_EQ(camera.cx, 4);
  EXPECT_EQ(camera.cy, 2.5);
}

TEST_F(TransformsJson, CameraAngleAloneGivesSquarePixelsAndTheCentre) {
  Json json = writeSmallCapture();
  for (const char* key : {"fl_x", "fl_y", "cx", "cy", "w", "h"}) json.erase(key);
  json["camera_angle_x"] = M_PI / 2;
  const Camera camera = readJson(json)[0].camera;
  EXPECT_NEAR(camera.fx, 4, 1e-12);  // half of 8 pixels at 45 degrees
  EXPECT_NEAR(camera.fy, 4, 1e-12);
  EXPECT_EQ(camera.cx, 4);
  EXPECT_EQ(camera.cy, 3);
}

TEST_F(TransformsJson, AppliedTransformAndScaleAreUndone) {
  const Eigen::Isometry3d source = somePose(5), applied = somePose(6);
  const double scale = 0.37;
  Eigen::Isometry3d stored = applied * source;  // what an exporter does to the source's poses
  stored.translation() *= scale;
  Json json = writeSmallCapture();
  Json rows = Json::array(), applied_rows = Json::array();
  for (int r = 0; r < 4; ++r) {
    Json row = Json::array(), applied_row = Json::array();
    for (int c = 0; c < 4; ++c) {
      row.push_back(stored.matrix()(r, c));
      applied_row.push_back(applied.matrix()(r, c));
    }
    rows.push_back(row);
    if (r < 3) applied_rows.push_back(applied_row);
  }
  json["frames"][0]["transform_matrix"] = rows;
  json["applied_transform"] = applied_rows;
  json["applied_scale"] = scale;
  const View view = readJson(json)[0];
  Eigen::Isometry3d expected = source;
  expected.linear().rightCols<2>() *= -1;
  EXPECT_LT((view.camera.world_from_camera.matrix() - expected.matrix()).cwiseAbs().maxCoeff(),
            1e-12);
  for (float z : view.depth) EXPECT_FLOAT_EQ(z, 2.f);  // millimetres of the source
  // +Z of the file's frame, seen in the source's.
  EXPECT_LT(
      (applied.linear() * conventionalUp(folder_.path.string()) - Eigen::Vector3d::UnitZ()).norm(),
      1e-12);
}

TEST_F(TransformsJson, DepthUnitMaskAndUnmeasuredPixels) {
  Json json = writeSmallCapture();
  std::vector<uint16_t> stored(48);
  for (size_t i = 0; i < stored.size(); ++i) stored[i] = uint16_t(100 + i);
  stored[0] = 0, stored[1] = 65535, stored[2] = 65534;
  writePng16(stored, 8, 6, path("a_depth.png"));
  Image mask(8, 6, 1, 1.f);
  mask.at(5, 3, 0) = 0;
  mask.at(6, 3, 0) = 1 / 255.f;  // not black
  writePng(mask, path("m.png"));
  json["frames"][0]["mask_path"] = "m.png";
  json["depth_unit_scale_factor"] = 0.01;
  const View view = readJson(json)[0];
  EXPECT_EQ(view.depth[0], 0);
  EXPECT_EQ(view.depth[1], 0);
  EXPECT_FLOAT_EQ(view.depth[2], 655.34f);
  EXPECT_FLOAT_EQ(view.depth[3], 1.03f);
  EXPECT_EQ(view.depth[3 * 8 + 5], 0);
  EXPECT_FLOAT_EQ(view.depth[3 * 8 + 6], 1.30f);
}

TEST_F(TransformsJson, ExtensionsMayBeLeftOut) {
  Json json = writeSmallCapture();
  json["frames"][0]["file_path"] = "./a";
  json["frames"][0]["depth_file_path"] = "a_depth";
  EXPECT_EQ(readJson(json)[0].name, "./a");
}

TEST_F(TransformsJson, SpoiledFilesThrow) {
  const Json good = writeSmallCapture();
  ASSERT_EQ(readJson(good).size(), 1u);
  const auto spoiled = [&](const char* pointer, const Json& value) {
    Json json = good;
    json[Json::json_pointer(pointer)] = value;
    return json;
  };
  const std::string matrix = "/frames/0/transform_matrix";
  expectJsonError(spoiled("/k1", 0.1), {"distortion", "k1"});
  expectJsonError(spoiled("/frames/0/p2", -0.1), {"distortion", "p2"});
  expectJsonError(spoiled("/frames/0/distortion_params", {0.1, 0}), {"distortion"});
  expectJsonError(spoiled("/camera_model", "OPENCV_FISHEYE"), {"OPENCV_FISHEYE"});
  expectJsonError(spoiled("/is_fisheye", true), {"fisheye"});
  expectJsonError(spoiled("/w", 9), {"a.png", "9 x 6", "8 x 6"});
  expectJsonError(spoiled("/w", 1e18), {"a.png", "8 x 6"});
  expectJsonError(spoiled("/w", "8"), {"w", "number", "string"});
  expectJsonError(spoiled("/fl_x", 0), {"fl_x"});
  expectJsonError(spoiled("/fl_x", -3), {"fl_x"});
  expectJsonError(spoiled("/depth_unit_scale_factor", 0), {"depth_unit_scale_factor"});
  expectJsonError(spoiled("/applied_scale", 0), {"applied_scale"});
  expectJsonError(spoiled("/applied_transform", {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 0, 0}}),
                  {"applied_transform", "singular"});
  expectJsonError(spoiled("/frames", Json::array()), {"no frames"});
  expectJsonError(spoiled("/frames", 3), {"frames"});
  expectJsonError(spoiled("/frames/0", 3), {"frame 0", "object"});
  expectJsonError(spoiled("/frames/0/file_path", 3), {"file_path", "string"});
  expectJsonError(spoiled("/frames/0/file_path", "none.png"), {"none.png", "no such file"});
  expectJsonError(spoiled("/frames/0/file_path", ""), {"file_path"});
  expectJsonError(spoiled("/frames/0/depth_file_path", nullptr), {"a.png", "no depth"});
  expectJsonError(spoiled("/frames/0/depth_file_path", "none.png"), {"none.png", "no such file"});
  expectJsonError(spoiled("/frames/0/depth_file_path", "a.png"), {"a.png", "16-bit"});
  expectJsonError(spoiled("/frames/0/mask_path", "none.png"), {"none.png"});
  expectJsonError(spoiled(matrix.c_str(), {1, 2, 3}), {"transform_matrix", "4 rows"});
  expectJsonError(spoiled((matrix + "/0/0").c_str(), 2), {"transform_matrix", "not rigid"});
  expectJsonError(spoiled((matrix + "/0/0").c_str(), 0), {"transform_matrix", "singular"});
  expectJsonError(spoiled((matrix + "/0/0").c_str(), -1), {"transform_matrix", "mirrors"});
  expectJsonError(spoiled((matrix + "/3/0").c_str(), 1), {"transform_matrix", "last row"});
  expectJsonError(spoiled((matrix + "/0/0").c_str(), "x"), {"transform_matrix"});
  Json no_focal = good;
  no_focal.erase("fl_x"), no_focal.erase("fl_y");
  expectJsonError(no_focal, {"focal"});
  for (const char* text :
       {"", "[]", "3", "{", "{\"frames\": [{\"file_path\": 1e999}]}", "\xff\xfe"}) {
    writeBytes(path("transforms.json"), text);
    expectUnreadable(folder_.path.string(), {"transforms.json"});
  }
  writeBytes(path("transforms.json"), std::string(100000, '['));  // deep nesting must not recurse
  expectUnreadable(folder_.path.string(), {"JSON"});
}

TEST_F(TransformsJson, DepthOfAnotherSizeAndEmptyDepthThrow) {
  const Json json = writeSmallCapture();
  writePng16(std::vector<uint16_t>(12, 2000), 4, 3, path("a_depth.png"));
  expectJsonError(json, {"a_depth.png", "8 x 6", "4 x 3"});
  std::vector<uint16_t> nothing(48, 0);
  nothing[7] = 65535;
  writePng16(nothing, 8, 6, path("a_depth.png"));
  expectJsonError(json, {"a.png", "no valid pixel"});
}

TEST_F(TransformsJson, EveryTruncationThrows) {
  const std::string text = writeSmallCapture().dump(1);
  for (size_t n = 0; n < text.size(); n += 2) {
    writeBytes(path("transforms.json"), text.substr(0, n));
    EXPECT_THROW(readViews(folder_.path.string()), Error) << n;
  }
}

}  // namespace
}  // namespace vdbc
