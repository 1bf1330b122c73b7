// What the encoder is told of a scene, against loops over its pixels (docs/method.md, sections 2
// and 3; numbers behind tests are its sections).
#include "encoder/observation.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <set>

#include "tests/simple_room.h"
#include "vdb/fit_volume.h"

namespace vdbc {
namespace {

const std::vector<View>& roomViews() {
  static const std::vector<View> views = simpleRoomViews(3, 64, 48, 41);
  return views;
}

VoxelFrame fittedFrame(const std::vector<View>& views, float voxel_m) {
  std::vector<DepthView> depth;
  for (const View& v : views) depth.push_back(v.depthView());
  VolumeSettings volume;
  volume.voxel_m = voxel_m;
  return fitVolume(depth, volume, CarveSettings());
}

Observation observed(const std::vector<View>& views, const VoxelFrame& frame, int patches_across) {
  ObserveSettings settings;
  settings.frame = frame;
  settings.patches_across = patches_across;
  Progress silent;
  return observe(views, settings, silent);
}

/// A usable pixel whose point lies in the bounds.
struct Pixel {
  size_t view;
  int x, y;
  Eigen::Vector3d index;  // of its point
  Coord voxel;
};

std::vector<Pixel> usablePixels(const std::vector<View>& views, const VoxelFrame& frame) {
  std::vector<Pixel> pixels;
  for (size_t i = 0; i < views.size(); ++i) {
    const Camera& c = views[i].camera;
    const std::vector<float> depth = usableDepth(views[i].depthView(), CarveSettings());
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        const double z = depth[size_t(y * c.width + x)];
        if (!(z > 0)) continue;
        const Eigen::Vector3d p = frame.toIndex(c.unproject(x + .5, y + .5, z));
        const Coord ijk(int(std::floor(p.x())), int(std::floor(p.y())), int(std::floor(p.z())));
        if (frame.bounds.isInside(ijk)) pixels.push_back({i, x, y, p, ijk});
      }
  }
  return pixels;
}

std::vector<Coord> voxelsOf(const std::vector<Pixel>& pixels) {
  std::set<Coord> voxels;
  for (const Pixel& p : pixels) voxels.insert(p.voxel);
  return {voxels.begin(), voxels.end()};
}

std::vector<Coord> sorted(std::vector<Coord> coords) {
  std::sort(coords.begin(), coords.end());
  return coords;
}

/// The same for all pixels of a patch: its number among those of all views.
int patchOf(const Observation& o, const View& view, const Pixel& p) {
  const PatchLattice& l = o.lattices[p.view];
  return l.first + p.y * l.rows / view.camera.height * l.columns +
         p.x * l.columns / view.camera.width;
}

TEST(Observation, TokensAreTheVoxelsThatPointsFallInto) {  // section 2.3
  const VoxelFrame frame = fittedFrame(roomViews(), .1f);
  const Observation o = observed(roomViews(), frame, 8);
  const std::vector<Coord> truth = voxelsOf(usablePixels(roomViews(), frame));
  ASSERT_GT(truth.size(), 500u);
  EXPECT_EQ(sorted(o.tokens.coords(0)), truth);
}

TEST(Observation, SizesFollowTheTokensAndNotTheBounds) {  // section 2.3: nothing dense
  VoxelFrame frame = fittedFrame(roomViews(), .1f);
  const Observation tight = observed(roomViews(), frame, 8);
  frame.bounds.expand(1500);  // 3,000 voxels a side: 2.7e10 voxels
  const Observation wide = observed(roomViews(), frame, 8);
  EXPECT_GE(wide.tokens.size(0), tight.tokens.size(0));
  EXPECT_EQ(sorted(wide.tokens.coords(0)), voxelsOf(usablePixels(roomViews(), frame)));
  EXPECT_EQ(int64_t(wide.voxel_features.size()), wide.tokens.size(0) * kVoxelFeatures);
  EXPECT_EQ(int64_t(wide.row_begin.size()), wide.tokens.size(1) + 1);
}

TEST(Observation, PatchCountsEqualThoseOfEveryPixel) {  // section 3.2
  const std::vector<View>& views = roomViews();
  const VoxelFrame frame = fittedFrame(views, .1f);
  for (int patches_across : {5, 8}) {  // 5 does not divide 64 pixels
    const Observation o = observed(views, frame, patches_across);
    std::map<std::pair<Coord, int>, float> truth, found;
    for (const Pixel& p : usablePixels(views, frame))
      ++truth[{tokenCoord(p.voxel, 1), patchOf(o, views[p.view], p)}];
    for (int64_t v = 0; v < o.tokens.size(1); ++v)
      for (int32_t k = o.row_begin[size_t(v)]; k < o.row_begin[size_t(v) + 1]; ++k)
        EXPECT_TRUE(
            found.insert({{o.tokens.coords(1)[size_t(v)], o.patch[size_t(k)]}, o.count[size_t(k)]})
                .second)
            << "a pair is listed twice";
    EXPECT_EQ(found, truth);
  }
}

TEST(Observation, LatticesFollowTheAspectAndNumberPatchesOn) {  // section 2.6
  std::vector<View> views = {roomViews()[0], roomViews()[1]};
  views[1].camera = resized(views[1].camera, 32, 48);
  views[1].colour = resizeImage(views[1].colour, 32, 48);
  std::vector<float> depth;
  for (int y = 0; y < 48; ++y)
    for (int x = 0; x < 32; ++x) depth.push_back(roomViews()[1].depth[size_t(y * 64 + 2 * x)]);
  views[1].depth = depth;
  const Observation o = observed(views, fittedFrame(views, .1f), 4);
  ASSERT_EQ(o.lattices.size(), 2u);
  const auto lattice = [&](size_t i) {
    return std::array<int, 3>{o.lattices[i].columns, o.lattices[i].rows, o.lattices[i].first};
  };
  EXPECT_EQ(lattice(0), (std::array<int, 3>{4, 3, 0}));
  EXPECT_EQ(lattice(1), (std::array<int, 3>{4, 6, 12}));
  EXPECT_EQ(o.patches, 36);
  EXPECT_EQ(o.patch_points.size(), 36u * 4);
}

TEST(Observation, FeaturesAreTheMeansOverEachVoxelsPixels) {
  const std::vector<View>& views = roomViews();
  const VoxelFrame frame = fittedFrame(views, .1f);
  const Observation o = observed(views, frame, 8);
  struct Sums {
    std::array<Eigen::Vector3d, 9> colour;  // of the octants, of all
    std::array<double, 9> pixels{};
    Eigen::Vector3d place = Eigen::Vector3d::Zero();
    Sums() { colour.fill(Eigen::Vector3d::Zero()); }
  };
  std::map<Coord, Sums> truth;
  for (const Pixel& p : usablePixels(views, frame)) {
    const Eigen::Vector3d place = p.index - p.index.array().floor().matrix();
    const int octant =
        (place.x() < .5 ? 0 : 4) + (place.y() < .5 ? 0 : 2) + (place.z() < .5 ? 0 : 1);
    Sums& s = truth[p.voxel];
    for (size_t k : {size_t(octant), size_t(8)}) {
      for (int c = 0; c < 3; ++c) s.colour[k][c] += views[p.view].colour.at(p.x, p.y, c);
      ++s.pixels[k];
    }
    s.place += place - Eigen::Vector3d::Constant(.5);
  }
  double worst = 0;
  for (int64_t v = 0; v < o.tokens.size(0); ++v) {
    const float* f = &o.voxel_features[size_t(v) * kVoxelFeatures];
    const Sums& s = truth.at(o.tokens.coords(0)[size_t(v)]);
    auto compare = [&](int k, double value) { worst = std::max(worst, std::abs(f[k] - value)); };
    for (size_t k = 0; k < 8; ++k) {
      for (int c = 0; c < 3; ++c)
        compare(4 * int(k) + c, s.colour[k][c] / std::max(1., s.pixels[k]));
      compare(4 * int(k) + 3, s.pixels[k] / s.pixels[8]);
    }
    for (int c = 0; c < 3; ++c) compare(32 + c, s.colour[8][c] / s.pixels[8]);
    compare(35, std::log(1 + s.pixels[8]) / 8);
    for (int c = 0; c < 3; ++c) compare(36 + c, s.place[c] / s.pixels[8]);
  }
  EXPECT_LT(worst, 1e-4);
}

/// A camera at the origin that looks along +z at the plane z = distance - slope * x.
View wallView(double distance, double slope) {
  View view;
  Camera& c = view.camera;
  c.width = 40, c.height = 30, c.fx = c.fy = 40, c.cx = 20, c.cy = 15;
  view.colour = Image(40, 30, 3, .25f);
  for (int y = 0; y < 30; ++y)
    for (int x = 0; x < 40; ++x)
      view.depth.push_back(float(distance / (1 + slope * (x + .5 - c.cx) / c.fx)));
  return view;
}

TEST(Observation, NormalsOfAPlaneFaceTheCamera) {
  for (double slope : {0., .4}) {
    const View view = wallView(2, slope);
    VoxelFrame frame;
    frame.voxel_m = .2f;
    frame.world_from_grid.linear() =
        Eigen::AngleAxisd(.6, Eigen::Vector3d(1, 2, 2) / 3).toRotationMatrix();
    frame.bounds = CoordBBox(Coord(-40), Coord(40));
    const Observation o = observed({view}, frame, 4);
    const Eigen::Vector3d truth =
        frame.world_from_grid.linear().transpose() * Eigen::Vector3d(-slope, 0, -1).normalized();
    for (int64_t v = 0; v < o.tokens.size(0); ++v) {
      const float* f = &o.voxel_features[size_t(v) * kVoxelFeatures + 39];
      EXPECT_LT((Eigen::Vector3d(f[0], f[1], f[2]) - truth).norm(), 1e-3);
    }
  }
}

TEST(Observation, PatchPointsAreTheMeanOfTheirPixels) {
  const std::vector<View>& views = roomViews();
  const VoxelFrame frame = fittedFrame(views, .1f);
  const Observation o = observed(views, frame, 8);
  std::vector<Eigen::Vector4d> truth(size_t(o.patches), Eigen::Vector4d::Zero());
  for (const Pixel& p : usablePixels(views, frame)) {
    Eigen::Vector4d& t = truth[size_t(patchOf(o, views[p.view], p))];
    t.head<3>() += p.index * double(frame.voxel_m);
    t[3] += 1;
  }
  for (int p = 0; p < o.patches; ++p) {
    const float* f = &o.patch_points[size_t(p) * 4];
    const double pixels = truth[size_t(p)][3];
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(f[c], truth[size_t(p)][c] / std::max(1., pixels), 1e-4);
    EXPECT_NEAR(f[3], pixels / 64, 1e-5);  // 8 x 6 patches of 8 x 8 pixels
  }
}

TEST(Observation, PixelsWithoutDepthSayNothing) {
  std::vector<View> views = {wallView(2, 0)};
  VoxelFrame frame;
  frame.bounds = CoordBBox(Coord(-40), Coord(40));
  for (int y = 0; y < 30; ++y)
    for (int x = 20; x < 40; ++x) views[0].depth[size_t(y * 40 + x)] = 0;
  for (float& v : views[0].colour.data) v = 1;
  const Observation o = observed(views, frame, 4);
  for (const Coord& ijk : o.tokens.coords(0)) EXPECT_LT(ijk.x(), 0);
  for (int p = 0; p < o.patches; ++p)
    EXPECT_EQ(o.patch_points[size_t(p) * 4 + 3] > 0, p % 4 < 2) << p;
}

TEST(Observation, NothingIsWhereACameraStood) {
  std::vector<View> views = roomViews();
  // What the first camera sees of its own place is nothing: pixels before it alone are known.
  const VoxelFrame frame = fittedFrame(views, .05f);
  // One pixel's point lies within reach of the second lens: it stays.
  View& near = views[1];
  near.depth[size_t(near.camera.width * near.camera.height / 2 + near.camera.width / 2)] = .15f;
  ObserveSettings settings;
  settings.frame = frame;
  settings.carving.flying_pixel_ratio = 0;
  Progress silent;
  const Observation open = observe(views, settings, silent);
  settings.lens_m = 0;
  const Observation carved = observe(views, settings, silent);
  int opened = 0;
  for (const Coord& ijk : frame.bounds) {
    double farthest = 1e9;  // corner of the voxel from the nearest lens, metres
    for (const View& v : views) {
      double corner = 0;
      for (int k = 0; k < 8; ++k) {
        const Eigen::Vector3d p = frame.toWorld(
            Eigen::Vector3d(ijk.x() + (k & 1), ijk.y() + (k >> 1 & 1), ijk.z() + (k >> 2)));
        corner = std::max(corner, (p - v.camera.world_from_camera.translation()).norm());
      }
      farthest = std::min(farthest, corner);
    }
    NodeState expected = carved.seen->at(ijk);
    if (expected == NodeState::kUnobserved && farthest <= .3)
      expected = NodeState::kEmpty, ++opened;
    if (std::abs(farthest - .3) < 1e-6) continue;
    ASSERT_EQ(open.seen->at(ijk), expected) << ijk;
  }
  EXPECT_GT(opened, 50);
  EXPECT_EQ(open.tokens.coords(0), carved.tokens.coords(0));
}

TEST(Observation, NothingInTheBoundsThrows) {
  VoxelFrame frame;
  frame.bounds = CoordBBox(Coord(500), Coord(540));
  EXPECT_THROW(observed({wallView(2, 0)}, frame, 4), Error);
  frame.bounds = CoordBBox(Coord(-40), Coord(40));
  View blind = wallView(2, 0);
  std::fill(blind.depth.begin(), blind.depth.end(), 0.f);
  EXPECT_THROW(observed({blind}, frame, 4), Error);
}

TEST(ObservedPixels, AreThoseWhosePointsLieInAnObservedToken) {
  const View& other = roomViews()[0];
  std::vector<View> views = {other};  // of which the right half saw nothing
  for (size_t i = 0; i < other.depth.size(); ++i)
    if (i % size_t(other.camera.width) >= size_t(other.camera.width) / 2) views[0].depth[i] = 0;
  const VoxelFrame frame = fittedFrame(views, .1f);
  const Observation o = observed(views, frame, 4);
  const auto size = size_t(other.camera.width) * size_t(other.camera.height);
  for (int level = 0; level < kTokenLevels; ++level) {
    std::set<Coord> tokens;
    for (const Pixel& p : usablePixels(views, frame)) tokens.insert(tokenCoord(p.voxel, level));
    std::vector<uint8_t> expected(size, 0);
    for (const Pixel& p : usablePixels({other}, frame))
      expected[size_t(p.y * other.camera.width + p.x)] =
          uint8_t(tokens.count(tokenCoord(p.voxel, level)));
    const auto count = std::count(expected.begin(), expected.end(), 1);
    EXPECT_GT(count, 0);
    EXPECT_LT(size_t(count), size);
    EXPECT_EQ(observedPixels(other, o, level, CarveSettings()), expected);
  }
}

}  // namespace
}  // namespace vdbc
