// Completion adds to what views saw and does not spoil it: every input view, before and after.
#include <gtest/gtest.h>

#include "encoder/views/read_views.h"
#include "houdini_style_tools/complete.h"
#include "splat/metrics.h"
#include "splat/rasterize.h"
#include "tests/files.h"

namespace vdbc {
namespace {

// Decibels of each view, the scene's Gaussians over black.
std::vector<double> viewPsnr(const std::vector<View>& views, const Place& place,
                             const Encoder& encoder, const SceneSettings& settings) {
  Progress progress;
  const Scene made = sceneOf(encoder.decode(place, settings.child_threshold, progress), place);
  const Gaussians& gaussians = made.splats.gaussians;
  RasterSettings raster;
  raster.antialias = gaussians.antialias;
  std::vector<double> result;
  for (const View& v : views)
    result.push_back(psnr(rasterize(gaussians, v.camera, raster).colour, v.colour));
  return result;
}

void expectNoInputIsWorse(const std::string& folder, const ReadViewsSettings& reading,
                          double by_db) {
  if (folder.empty()) GTEST_SKIP() << "the capture is not on this machine";
  if (!std::filesystem::exists(kWeights + "/encoder.safetensors"))
    GTEST_SKIP() << "no trained weights in " << kWeights;
  const std::vector<View> views = readViews(folder, reading);
  const Encoder encoder(kWeights + "/encoder.safetensors");
  const Completer completer(kWeights + "/completer.safetensors");
  SceneSettings settings;
  settings.observing.volume.up = conventionalUp(folder);
  Progress progress;
  const Place seen = encodeScene(views, encoder, settings, progress);
  const Place completed = completer.complete(seen, settings.completion, progress);
  ASSERT_GT(completed.size(), seen.size());
  const std::vector<double> before = viewPsnr(views, seen, encoder, settings),
                            after = viewPsnr(views, completed, encoder, settings);
  for (size_t i = 0; i < views.size(); ++i) {
    std::printf("view %zu: %.2f dB, completed %.2f\n", i, before[i], after[i]);
    EXPECT_GT(after[i], before[i] - by_db) << folder << ", view " << i;
  }
}

TEST(Captures, NoBundledViewIsWorse) {
  expectNoInputIsWorse(VDBC_SOURCE_DIR "/examples/two_views", {}, .6);  // of 39 dB
}
TEST(Captures, NoViewOfTheKitchenIsWorse) {
  expectNoInputIsWorse(sharedFile("data/rgbd_redkitchen"), {{0, 6, 12, 18}}, .2);
}
TEST(Captures, NoViewOfTheDiningRoomIsWorse) {
  expectNoInputIsWorse(sharedFile("data/rgbd_diningroom"), {{0, 2, 4}}, .2);
}
TEST(Captures, NoViewOfTheLivingRoomIsWorse) {
  expectNoInputIsWorse(sharedFile("data/rgbd_livingroom_rendered"), {{0, 2, 4}},
                       .5);  // of 30 dB
}

}  // namespace
}  // namespace vdbc
