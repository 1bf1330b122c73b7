// What views saw as discs: against a room of known colour and shape, and what may go wrong with
// depth. How completion joins it.
#include "splat/detail.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "splat/join.h"
#include "splat/rasterize.h"
#include "tests/expect_error.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Eigen::Vector3f;
using Eigen::Vector4f;

const Vector3d kRoomSides(4.2, 3.4, 2.6);  // metres, from the world's origin

/// Stripes on the floor, a checkerboard on the wall at x = 0, plain elsewhere.
Vector3f colourAt(const Vector3d& p) {
  if (p.z() < 1e-6)
    return std::fmod(p.x() * 4, 2) < 1 ? Vector3f(.2f, .3f, .7f) : Vector3f(.8f, .7f, .2f);
  if (p.x() < 1e-6)
    return (int(p.y() * 3) + int(p.z() * 3)) % 2 ? Vector3f(.9f, .9f, .9f)
                                                 : Vector3f(.1f, .2f, .1f);
  return {.6f, .5f, .4f};
}

/// A view from inside the box; exact.
View viewFrom(const Vector3d& eye, const Vector3d& target, int width = 96, int height = 72) {
  View v;
  v.name = "box";
  v.camera = {width,
              height,
              .8 * width,
              .8 * width,
              width / 2.,
              height / 2.,
              lookAt(eye, target, Vector3d::UnitZ())};
  v.colour = Image(width, height, 3);
  v.depth.resize(size_t(width) * size_t(height));
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const Vector3d ray = v.camera.unproject(x + .5, y + .5, 1) - eye;
      double z = 1e9;
      for (int axis = 0; axis < 3; ++axis)
        if (ray[axis] != 0)
          z = std::min(z, ((ray[axis] > 0 ? kRoomSides[axis] : 0) - eye[axis]) / ray[axis]);
      v.depth[size_t(y) * size_t(width) + size_t(x)] = float(z);
      Vector3d p = eye + z * ray;
      for (int axis = 0; axis < 3; ++axis)
        if (std::abs(p[axis]) < 1e-9) p[axis] = 0;
      const Vector3f c = colourAt(p);
      for (int k = 0; k < 3; ++k) v.colour.at(x, y, k) = c[k];
    }
  return v;
}

std::vector<View> boxViews() {
  return {viewFrom({3.2, 1.2, 1.5}, {0, 2, .8}), viewFrom({2.8, 2.4, 1.3}, {0, 1, .6})};
}

DetailSettings seconds(double s) {
  DetailSettings settings;
  settings.seconds = s;
  return settings;
}

Gaussians discsOf(const std::vector<View>& views, double s) {
  Progress silent;
  return seenDetail(views, seconds(s), {}, Vector3d::Zero(), silent).discs;
}

double psnrFrom(const Gaussians& g, const View& v) {
  RasterSettings raster;
  raster.antialias = g.antialias;
  return psnr(rasterize(g, v.camera, raster).colour, v.colour);
}

/// Metres from the nearest face of the room; negative outside of it.
double insideBy(const Vector3f& mean) {
  const Vector3d p = mean.cast<double>();
  return std::min(p.minCoeff(), (kRoomSides - p).minCoeff());
}

TEST(Detail, DiscsLieFlatOnWhatWasMeasured) {
  const Gaussians g = discsOf(boxViews(), 1e-9);  // placed, not fitted
  ASSERT_GT(g.size(), 100);
  EXPECT_TRUE(g.antialias);
  for (size_t i = 0; i < size_t(g.size()); ++i) {
    EXPECT_NEAR(insideBy(g.mean[i]), 0, .02) << i;
    const Vector3f sigma = g.log_scale[i].array().exp();
    EXPECT_LE(sigma[2], .31f * std::min(sigma[0], sigma[1]) + 1e-6f);
  }
}

TEST(Detail, PlainWallsGetFewerDiscsThanPatterns) {
  int wall = 0, pattern = 0;
  const std::vector<View> views = {viewFrom({2.1, 1.7, 1.3}, {4.2, 1.7, 1.3}),  // plain
                                   viewFrom({2.1, 1.7, 1.3}, {0, 1.7, 1.3})};   // checkerboard
  for (const Vector3f& mean : discsOf(views, 1e-9).mean) {
    wall += mean.x() > 4.1f && mean.z() > .3f && mean.z() < 2.3f;
    pattern += mean.x() < .1f && mean.z() > .3f && mean.z() < 2.3f;
  }
  EXPECT_GT(wall, 0);
  EXPECT_GT(pattern, 3 * wall);
}

TEST(Detail, FittingBringsInputAndOtherViewsNearer) {
  const std::vector<View> views = boxViews();
  const View other = viewFrom({3, 1.8, 1.6}, {0, 1.5, .7});
  const Gaussians placed = discsOf(views, 1e-9), fitted = discsOf(views, .4);
  for (const View& v : views) EXPECT_GT(psnrFrom(fitted, v), psnrFrom(placed, v) + 2);
  EXPECT_GT(psnrFrom(fitted, other), psnrFrom(placed, other) + .5);
}

TEST(Detail, ASecondLookAtTheSameAddsNearlyNothing) {
  const View v = boxViews()[0];
  const int64_t once = discsOf({v}, 1e-9).size(), twice = discsOf({v, v, v}, 1e-9).size();
  EXPECT_LT(double(twice), 1.1 * double(once));
}

TEST(Detail, FlyingPixelsAndNoiseMakeNoFloaters) {
  std::vector<View> views = boxViews();
  std::mt19937 random(3);
  std::normal_distribution<float> noise;
  for (View& v : views) {
    for (float& z : v.depth) z += .0015f * z * z * noise(random);  // as of a Kinect
    for (int i = 0; i < 40; ++i) v.depth[random() % v.depth.size()] *= .5f;
  }
  int far = 0;
  for (const Vector3f& mean : discsOf(views, .2).mean) far += insideBy(mean) > .15;
  EXPECT_LT(far, 5);
}

TEST(Detail, WhatAnotherViewLooksThroughIsLeftOut) {
  std::vector<View> views = {boxViews()[0], viewFrom({3, 2, 1.4}, {1.5, .8, 1.2})};
  // A board that stands in the air, in one view's depth alone.
  for (int y = 20; y < 50; ++y)
    for (int x = 30; x < 60; ++x) views[0].depth[size_t(y) * 96 + size_t(x)] = 1;
  int64_t floating = 0;
  for (const Vector3f& mean : discsOf(views, 1e-9).mean) floating += insideBy(mean) > .15;
  EXPECT_LT(floating, 10);
}

TEST(Detail, HolesContinueThePlaneAroundThem) {
  std::vector<View> views = {boxViews()[0]};
  for (int y = 30; y < 38; ++y)
    for (int x = 40; x < 48; ++x) views[0].depth[size_t(y) * 96 + size_t(x)] = 0;
  const Gaussians g = discsOf(views, 1e-9);
  RasterSettings raster;
  raster.antialias = true;
  const RasterOutput seen = rasterize(g, views[0].camera, raster);
  for (int y = 31; y < 37; ++y)
    for (int x = 41; x < 47; ++x) EXPECT_GT(seen.alpha.at(x, y, 0), .9f);
  for (const Vector3f& mean : g.mean) EXPECT_NEAR(insideBy(mean), 0, .05);
}

TEST(Detail, OneViewsExposureDoesNotSpoilTheOthers) {
  std::vector<View> views = boxViews();
  const double alike = psnrFrom(discsOf(views, .4), views[0]);
  for (float& c : views[1].colour.data) c *= .8f;
  EXPECT_GT(psnrFrom(discsOf(views, .4), views[0]), alike - 2);
}

TEST(Detail, BudgetHolds) {
  Progress silent;
  DetailSettings settings = seconds(1e-9);
  const int64_t all = seenDetail(boxViews(), settings, {}, Vector3d::Zero(), silent).discs.size();
  settings.splats = all / 2;
  const int64_t half = seenDetail(boxViews(), settings, {}, Vector3d::Zero(), silent).discs.size();
  EXPECT_LE(half, all / 2);
  EXPECT_GT(half, all / 4);
  settings.splats = 3;
  expectError([&] { seenDetail(boxViews(), settings, {}, Vector3d::Zero(), silent); },
              {"budget", "3"});
}

TEST(Detail, TheSameBytesForAnyNumberOfThreadsAndFarFromTheWorldsOrigin) {
  const std::vector<View> views = boxViews();
  const Gaussians one = withThreads(1, [&] { return discsOf(views, .1); });
  for (int threads : {2, 4})
    EXPECT_TRUE(equalRows(one, withThreads(threads, [&] { return discsOf(views, .1); })));
  std::vector<View> far = views;
  const Vector3d shift(500000, -200000, 100);
  for (View& v : far) v.camera.world_from_camera.pretranslate(shift);
  Progress silent;
  const Gaussians there = seenDetail(far, seconds(1e-9), {}, shift, silent).discs;
  const Gaussians here = discsOf(views, 1e-9);
  ASSERT_NEAR(double(there.size()), double(here.size()), 3);
  for (size_t i = 0; i < std::min(there.mean.size(), here.mean.size()); i += 50)
    EXPECT_NEAR(insideBy(there.mean[i]), 0, .02);
}

TEST(Detail, StrangeInputIsRefusedOrMakesNothing) {
  Progress silent;
  EXPECT_EQ(seenDetail({}, seconds(1), {}, Vector3d::Zero(), silent).discs.size(), 0);
  EXPECT_EQ(discsOf(boxViews(), 0).size(), 0);
  View no_colour = boxViews()[0];
  no_colour.colour = {};
  expectError([&] { discsOf({no_colour}, 1); }, {"colour", "96 x 72"});
  expectError([&] { discsOf(boxViews(), -1); }, {"not negative"});
  View blind = boxViews()[0];
  std::fill(blind.depth.begin(), blind.depth.end(), std::nanf(""));
  EXPECT_EQ(discsOf({blind}, .1).size(), 0);
}

// --- joining ----------------------------------------------------------------------------------

/// A decoded voxel of 8 opaque Gaussians about `centre`.
void addVoxel(const Vector3f& centre, const Vector3f& srgb, bool generated, Gaussians* g,
              Provenance* p) {
  for (int i = 0; i < 8; ++i) {
    g->mean.push_back(centre + .025f * Vector3f(i & 1 ? 1 : -1, i & 2 ? 1 : -1, i & 4 ? 1 : -1));
    g->log_scale.push_back(Vector3f::Constant(std::log(.025f)));
    g->rotation.emplace_back(1.f, 0.f, 0.f, 0.f);
    g->opacity_logit.push_back(2);
    for (int c = 0; c < 3; ++c) g->sh.push_back((srgb[c] - .5f) / kSh0);
    p->generated.push_back(generated),
        p->probability.push_back(generated ? .7f - .01f * float(i) : 1);
  }
}

struct Joined {
  Gaussians decoded;
  Provenance provenance;
  SplatScene scene;
};

Joined joinWith(const std::vector<std::pair<Vector3f, bool>>& voxels, const Gaussians& discs,
                const std::vector<View>& views) {
  Joined j;
  for (const auto& [centre, generated] : voxels)
    addVoxel(centre, {.6f, .5f, .4f}, generated, &j.decoded, &j.provenance);
  std::vector<Camera> cameras;
  for (const View& v : views) cameras.push_back(v.camera);
  j.scene = join(discs, j.decoded, j.provenance, 8, cameras, {});
  return j;
}

TEST(Join, NothingStandsBeforeWhatWasSeen) {
  const std::vector<View> views = boxViews();
  const Gaussians discs = discsOf(views, .2);
  // In the air before the cameras, and in the seen wall.
  const Joined j = joinWith({{{1.5f, 1.8f, 1.2f}, true}, {{.0f, 1.7f, 1.f}, false}}, discs, views);
  EXPECT_EQ(j.scene.gaussians.size(), discs.size());
  EXPECT_EQ(j.scene.provenance.size(), discs.size());
  for (const View& v : views) EXPECT_NEAR(psnrFrom(j.scene.gaussians, v), psnrFrom(discs, v), 1e-6);
}

TEST(Join, WhatNoViewSawStaysAsOneGaussianAVoxel) {
  const std::vector<View> views = boxViews();
  const Gaussians discs = discsOf(views, .2);
  // Behind the cameras, off every seen plane.
  const Joined j = joinWith({{{3.9f, .4f, 1.1f}, true}}, discs, views);
  ASSERT_EQ(j.scene.gaussians.size(), discs.size() + 1);
  const size_t last = size_t(discs.size());
  EXPECT_LT((j.scene.gaussians.mean[last] - Vector3f(3.9f, .4f, 1.1f)).norm(), .01f);
  EXPECT_EQ(j.scene.provenance.generated[last], 1);
  EXPECT_FLOAT_EQ(j.scene.provenance.probability[last], .63f);  // the least of its parts
  const float colour = .5f + kSh0 * j.scene.gaussians.sh[3 * last];
  EXPECT_NEAR(colour, .6f, 1e-4f);
}

TEST(Join, SeenPlanesGoOnAsDiscsInThem) {
  const std::vector<View> views = boxViews();
  const Gaussians discs = discsOf(views, 1e-9);  // exactly on the planes
  // The checkerboard's wall goes on where no view looked, 4 cm off.
  const Joined j = joinWith({{{.04f, 1.7f, 2.55f}, true}}, discs, views);
  ASSERT_EQ(j.scene.gaussians.size(), discs.size() + 1);
  const size_t last = size_t(discs.size());
  EXPECT_LT(std::abs(j.scene.gaussians.mean[last].x()), .035f);
  const Vector3f sigma = j.scene.gaussians.log_scale[last].array().exp();
  EXPECT_LT(sigma.minCoeff(), .01f);
  EXPECT_GT(sigma.maxCoeff(), .05f);
}

/// The plain wall at x = 4.2, of which one view saw a part, decoded whole and farther on, in
/// another colour.
struct HalfSeenWall {
  std::vector<View> views = {viewFrom({1.2, 1.7, 1.3}, {kRoomSides.x(), .4, 1.3})};
  Vector3f seen_colour = {.6f, .5f, .4f}, generated_colour = {.75f, .5f, .3f};
  Gaussians discs;
  SplatScene scene;
  float rim = 0;  // y, metres: how far the discs go

  explicit HalfSeenWall(double seconds = .2) : discs(discsOf(views, seconds)) {
    for (const Vector3f& p : discs.mean)
      if (std::abs(p.x() - kRoomSides.x()) < .05 && std::abs(p.z() - 1.3) < .5)
        rim = std::max(rim, p.y());
    Joined j;
    for (float y = .05f; y < 5; y += .1f)
      for (float z = .45f; z < 2.2f; z += .1f)
        addVoxel({float(kRoomSides.x()) + .02f, y, z}, generated_colour, y > rim + .1f, &j.decoded,
                 &j.provenance);
    scene = join(discs, j.decoded, j.provenance, 8, {views[0].camera}, {});
  }

  /// Calls visit(row, metres beyond the rim) for generated Gaussians.
  template <typename Visit>
  void eachGenerated(const Visit& visit) const {
    for (size_t i = discs.mean.size(); i < scene.gaussians.mean.size(); ++i)
      visit(i, scene.gaussians.mean[i].y() - rim);
  }
};

TEST(Join, ContinuedPlanesAreLevel) {
  const HalfSeenWall wall(1e-9);  // exactly on the plane
  size_t flat = 0;
  wall.eachGenerated([&](size_t i, float beyond) {
    if (beyond > 1.2f) return;
    const Gaussians& g = wall.scene.gaussians;
    const Vector3f sigma = g.log_scale[i].array().exp();
    const Vector4f& q = g.rotation[i];
    const Vector3f normal = Eigen::Quaternionf(q[0], q[1], q[2], q[3]).matrix().col(2);
    ++flat;
    EXPECT_LT(sigma[2], .02f);
    EXPECT_GT(std::abs(normal.x()), std::cos(.5f * float(M_PI) / 180));
    EXPECT_NEAR(g.mean[i].x(), kRoomSides.x() + .03, .005);  // behind what was seen
  });
  EXPECT_GT(flat, 20u);
}

TEST(Join, ColoursOfBothSidesMeetAndPartFartherOn) {
  const HalfSeenWall wall;
  float near = 0, far = 0;
  wall.eachGenerated([&](size_t i, float beyond) {
    const Vector3f colour = Vector3f::Constant(.5f) +
                            kSh0 * Eigen::Map<const Vector3f>(&wall.scene.gaussians.sh[3 * i]);
    // What was pushed behind the discs is not looked at.
    if (beyond > 0 && beyond < .2f) near = std::max(near, (colour - wall.seen_colour).norm());
    if (beyond > 2) far = std::max(far, (colour - wall.generated_colour).norm());
  });
  EXPECT_LT(near, .045f);  // a quarter of what they are apart, as in two voxels some part is
  EXPECT_LT(far, .09f);
}

TEST(Join, NoSeamAlongTheRimOfWhatWasSeen) {
  const HalfSeenWall wall;
  const View other = viewFrom({1.5, wall.rim + .3, 1.3}, {kRoomSides.x(), wall.rim, 1.3});
  RasterSettings raster;
  raster.antialias = true;
  const RasterOutput seen = rasterize(wall.scene.gaussians, other.camera, raster);
  for (int y = 28; y < 44; ++y)
    for (int x = 20; x < 76; ++x) {
      EXPECT_GT(seen.alpha.at(x, y, 0), .9f) << x << ' ' << y;
      const float step = std::abs(seen.colour.at(x, y, 0) - seen.colour.at(x - 1, y, 0));
      EXPECT_LT(step, .03f) << x << ' ' << y;
    }
}

TEST(Join, AGeneratedWallIsFewGaussiansOfTheLowestProbability) {
  const HalfSeenWall wall;
  size_t far = 0;
  wall.eachGenerated([&](size_t i, float beyond) {
    EXPECT_EQ(wall.scene.provenance.generated[i], 1);
    if (beyond < .5f) return;
    EXPECT_FLOAT_EQ(wall.scene.provenance.probability[i], .63f);
    ++far;
  });
  const size_t voxels = size_t((5 - wall.rim - .5f) / .1f * 18);
  EXPECT_GT(far, voxels / 6);
  EXPECT_LT(far, voxels / 3);
}

TEST(Join, WhatCrossesASeenPlaneKeepsItsShape) {
  // Exactly on the plane of the plain wall, which a sheet of voxels crosses beyond its rim.
  const std::vector<View> views = {viewFrom({1.2, 1.7, 1.3}, {kRoomSides.x(), .4, 1.3})};
  const Gaussians discs = discsOf(views, 1e-9);
  std::vector<std::pair<Vector3f, bool>> voxels;
  for (float x = 3.95f; x < 4.5f; x += .1f)
    for (float z = .85f; z < 1.8f; z += .1f) voxels.push_back({{x, 3.2f, z}, true});
  const Gaussians g = joinWith(voxels, discs, views).scene.gaussians;
  for (size_t i = size_t(discs.size()); i < g.mean.size(); ++i)
    EXPECT_GT(g.log_scale[i].minCoeff(), std::log(.02f)) << g.mean[i].transpose();
}

TEST(Join, TheSameBytesForAnyNumberOfThreads) {
  const std::vector<View> views = boxViews();
  const Gaussians discs = discsOf(views, .1);
  std::vector<std::pair<Vector3f, bool>> voxels;
  for (float x = .05f; x < 4; x += .3f)
    for (float z = .05f; z < 2.6f; z += .3f) voxels.push_back({{x, .05f, z}, true});
  const auto at = [&](int threads) {
    return withThreads(threads, [&] { return joinWith(voxels, discs, views).scene.gaussians; });
  };
  const Gaussians one = at(1);
  EXPECT_TRUE(equalRows(one, at(2)));
  EXPECT_TRUE(equalRows(one, at(4)));
  const auto wall = [&](int threads) {
    return withThreads(threads, [] { return HalfSeenWall(1e-9).scene.gaussians; });
  };
  EXPECT_TRUE(equalRows(wall(1), wall(4)));  // with merging
}

TEST(Join, WhereNothingWasSeenAllIsGenerated) {
  const Joined j = joinWith({{{1, 1, 1}, true}, {{1.3f, 1, 1}, false}}, {}, {});
  ASSERT_EQ(j.scene.gaussians.size(), 2);
  requireConsistent(j.scene.gaussians);
  for (size_t i = 0; i < 2; ++i) {
    EXPECT_TRUE(j.scene.gaussians.mean[i].allFinite() &&
                j.scene.gaussians.log_scale[i].allFinite());
    EXPECT_EQ(j.scene.provenance.generated[i], 1);
  }
}

TEST(Join, RowsThatDoNotFitAreRefused) {
  const std::vector<View> views = boxViews();
  Gaussians g;
  Provenance p;
  addVoxel({1, 1, 1}, {.5f, .5f, .5f}, true, &g, &p);
  p.probability.pop_back(), p.generated.pop_back();
  expectError([&] { join(g, g, p, 8, {}, {}); }, {"join", "provenance"});
}

}  // namespace
}  // namespace vdbc
