#include "vdb/carve.h"

#include <gtest/gtest.h>
#include <openvdb/tree/ValueAccessor.h>
#include <tbb/global_control.h>

#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <random>
#include <set>

#include "encoder/views/read_views.h"
#include "splat/view.h"
#include "tests/files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr float kInf = std::numeric_limits<float>::infinity();

struct OwnedView {
  Camera camera;
  std::vector<float> depth;
};

std::vector<DepthView> borrow(const std::vector<OwnedView>& views) {
  std::vector<DepthView> borrowed;
  for (const OwnedView& v : views) borrowed.push_back({v.camera, v.depth.data()});
  return borrowed;
}

Camera makeCamera(int width, int height, double f, const Vector3d& eye,
                  const Eigen::Matrix3d& rotation = Eigen::Matrix3d::Identity()) {
  Camera c;
  c.width = width, c.height = height, c.fx = c.fy = f;
  c.cx = width / 2.0, c.cy = height / 2.0;
  c.world_from_camera.linear() = rotation;
  c.world_from_camera.translation() = eye;
  return c;
}

// Planar depth of the world point that a ray direction of unit depth hits: `hit` gives the factor.
OwnedView render(const Camera& camera,
                 const std::function<double(const Vector3d& eye, const Vector3d& direction)>& hit) {
  OwnedView view{camera, std::vector<float>(size_t(camera.width) * camera.height)};
  const Vector3d eye = camera.world_from_camera.translation();
  for (int j = 0; j < camera.height; ++j) {
    for (int i = 0; i < camera.width; ++i) {
      const Vector3d direction = camera.unproject(i + 0.5, j + 0.5, 1) - eye;
      view.depth[size_t(j) * camera.width + i] = float(hit(eye, direction));
    }
  }
  return view;
}

// The first wall ahead of the six of a box, seen from inside or outside.
double hitBox(const Eigen::AlignedBox3d& box, const Vector3d& eye, const Vector3d& direction) {
  double in = 0, out = std::numeric_limits<double>::infinity();
  for (int k = 0; k < 3; ++k) {
    const double a = (box.min()[k] - eye[k]) / direction[k],
                 b = (box.max()[k] - eye[k]) / direction[k];
    in = std::max(in, std::min(a, b)), out = std::min(out, std::max(a, b));
  }
  if (in > out) return 0;
  return in > 0 ? in : out;
}

OwnedView renderRoom(const Camera& camera, const Eigen::AlignedBox3d& room) {
  return render(camera,
                [&](const Vector3d& eye, const Vector3d& d) { return hitBox(room, eye, d); });
}

bool sameVoxels(const TokenMask& a, const TokenMask& b) {
  return activeCoords(a) == activeCoords(b);
}

std::set<Coord> voxelSet(const TokenMask& mask) {
  const std::vector<Coord> coords = activeCoords(mask);
  return {coords.begin(), coords.end()};
}

// The law of this file.
void expectSameAsTraversal(const VoxelFrame& frame, const std::vector<OwnedView>& views,
                           const CarveSettings& settings, const std::string& what) {
  Progress progress;
  const SeenSpace fast = carve(frame, borrow(views), settings, progress);
  const SeenSpace truth = carveByTraversal(frame, borrow(views), settings);
  for (const SeenSpace* space : {&fast, &truth}) {
    EXPECT_EQ(space->level, 0) << what;
    EXPECT_EQ(space->box, frame.bounds) << what;
  }
  EXPECT_TRUE(sameVoxels(fast.filled, truth.filled)) << what;
  EXPECT_TRUE(sameVoxels(fast.empty, truth.empty))
      << what << ": " << fast.empty.activeVoxelCount() << " of " << truth.empty.activeVoxelCount()
      << " empty voxels";
}

const Eigen::AlignedBox3d kRoom(Vector3d(-2.03, -1.51, -1.27), Vector3d(2.41, 1.83, 1.19));

Eigen::Matrix3d lookAlong(const Vector3d& forward) {
  return vdbc::lookAlong(forward.normalized(), Vector3d(0.1, 0.2, 1));
}

std::vector<OwnedView> roomViews(int width, int height, double f) {
  std::vector<OwnedView> views;
  for (const Vector3d& forward :
       {Vector3d(1, 0.2, -0.1), Vector3d(-1, 0.7, 0.3), Vector3d(0.1, -1, -0.2),
        Vector3d(0.999, 0.03, -0.9), Vector3d(0.02, 0.01, -1)}) {
    const Vector3d eye = Vector3d(0.3, 0.1, 0.2) - 0.9 * forward.normalized();
    views.push_back(renderRoom(makeCamera(width, height, f, eye, lookAlong(forward)), kRoom));
  }
  // Along a wall, 3 cm from it: grazing rays.
  views.push_back(renderRoom(
      makeCamera(width, height, f, {-1.8, 1.80, 0.1}, lookAlong({1, 0.02, -0.05})), kRoom));
  // From outside, at the outer side of the walls and past them.
  views.push_back(
      renderRoom(makeCamera(width, height, f, {-5, 3, 1}, lookAlong({1, -0.6, -0.2})), kRoom));
  return views;
}

VoxelFrame roomFrame(float voxel_m, double yaw = 0) {
  VoxelFrame frame;
  frame.voxel_m = voxel_m;
  frame.world_from_grid = Eigen::Isometry3d(Eigen::AngleAxisd(yaw, Vector3d::UnitZ()));
  frame.world_from_grid.translation() = Vector3d(0.011, -0.023, 0.007);
  const int n = int(3 / voxel_m);
  frame.bounds = CoordBBox(Coord(-n, -n + 1, -n / 2), Coord(n - 2, n, n / 2 + 1));
  return frame;
}

// An independent truth: the closed-form overlap of every ray with every voxel, in long double, with
// no traversal. Voxels where rounding could matter are left out, and counted.
struct ClosedForm {
  std::set<Coord> filled, empty, unsure;
};
ClosedForm closedForm(const VoxelFrame& frame, const std::vector<OwnedView>& views,
                      const CarveSettings& settings) {
  ClosedForm truth;
  constexpr long double kClose = 1e-9L;
  for (const OwnedView& view : views) {
    const std::vector<float> depth = usableDepth({view.camera, view.depth.data()}, settings);
    const Vector3d o = frame.toIndex(view.camera.world_from_camera.translation());
    for (int p = 0; p < int(depth.size()); ++p) {
      if (depth[p] == 0) continue;
      const Vector3d end = frame.toIndex(view.camera.unproject(
          p % view.camera.width + 0.5, p / view.camera.width + 0.5, depth[p]));
      const Coord hit(int(std::floor(end.x())), int(std::floor(end.y())), int(std::floor(end.z())));
      if (frame.bounds.isInside(hit)) truth.filled.insert(hit);
      for (auto c = frame.bounds.begin(); c; ++c) {
        long double in = 0, out = 1;
        for (int k = 0; k < 3; ++k) {
          const long double d = (long double)(end[k]) - o[k];
          const long double a = ((*c)[k] - (long double)(o[k])) / d, b = a + 1 / d;
          in = std::max(in, std::min(a, b)), out = std::min(out, std::max(a, b));
        }
        if (*c == hit) continue;
        if (out - in > kClose)
          truth.empty.insert(*c);
        else if (out - in > -kClose)
          truth.unsure.insert(*c);
      }
    }
  }
  for (const Coord& c : truth.filled) truth.empty.erase(c);
  return truth;
}

TEST(Carve, TraversalMatchesClosedForm) {
  std::mt19937 rng(5);
  std::uniform_real_distribution<float> noise(-0.2f, 0.2f);
  for (int round = 0; round < 4; ++round) {
    std::vector<OwnedView> views = roomViews(9, 7, 5 + 3 * round);
    for (OwnedView& v : views) {
      for (float& d : v.depth) d = std::max(0.f, d + noise(rng));
    }
    CarveSettings settings;
    settings.flying_pixel_ratio = 0;
    const VoxelFrame frame = roomFrame(0.23f + 0.05f * float(round), 0.3 * round);
    const ClosedForm truth = closedForm(frame, views, settings);
    const SeenSpace space = carveByTraversal(frame, borrow(views), settings);
    EXPECT_EQ(voxelSet(space.filled), truth.filled);
    std::set<Coord> empty = voxelSet(space.empty), expected = truth.empty;
    for (const Coord& c : truth.unsure) empty.erase(c), expected.erase(c);
    EXPECT_EQ(empty, expected);
    EXPECT_GT(expected.size(), 300u);
    EXPECT_LT(truth.unsure.size(), 5u);
  }
}

TEST(Carve, RoomFromInsideAndOutside) {
  // Pixels from far smaller to larger than a voxel.
  for (const float voxel_m : {0.5f, 0.2f, 0.1f, 0.05f}) {
    for (const double f : {12.0, 30.0, 90.0}) {
      for (const double yaw : {0.0, 0.4}) {
        expectSameAsTraversal(roomFrame(voxel_m, yaw), roomViews(36, 27, 0.75 * f), {},
                              joinText("voxel ", voxel_m, " f ", f, " yaw ", yaw));
      }
    }
  }
}

TEST(Carve, EveryKindOfBadDepth) {
  std::mt19937 rng(7);
  for (const float share : {0.02f, 0.3f, 0.95f}) {
    std::vector<OwnedView> views = roomViews(24, 18, 15);
    std::bernoulli_distribution broken(share);
    const float kinds[] = {0.f,    -1.f,   kNaN,   kInf,   -kInf, 1e30f,
                           1e-30f, 19.99f, 20.01f, 5000.f, 1e-3f};
    for (OwnedView& v : views) {
      for (float& d : v.depth) {
        if (broken(rng)) d = kinds[rng() % std::size(kinds)];
      }
    }
    for (const float max_depth : {1.5f, 20.f, 8000.f, kInf}) {
      CarveSettings settings;
      settings.max_depth_m = max_depth;
      settings.flying_pixel_ratio = rng() % 2 ? 0.05f : 0.f;
      expectSameAsTraversal(roomFrame(0.12f, 0.2), views, settings, joinText("max ", max_depth));
    }
  }
  // No ray at all.
  std::vector<OwnedView> views = roomViews(8, 6, 5);
  for (OwnedView& v : views) v.depth.assign(v.depth.size(), 0.f);
  Progress progress;
  const SeenSpace none = carve(roomFrame(0.1f), borrow(views), {}, progress);
  EXPECT_EQ(none.filled.activeVoxelCount() + none.empty.activeVoxelCount(), 0u);
}

// Cameras on voxel corners, edges and faces, rays along the axes and diagonals, depths that end on
// faces: everywhere the DDA's rounding and tie-breaking decide.
TEST(Carve, DegenerateRays) {
  for (const int offset : {0, 1, 2}) {
    for (const double centre : {8.0, 8.5}) {  // rays at +-0.5 pixel of the axis, and along it
      for (const double f : {1.0, 4.0, 8.0}) {
        std::vector<OwnedView> views;
        for (const Vector3d& forward :
             {Vector3d(0, 0, 1), Vector3d(0, 0, -1), Vector3d(1, 0, 0), Vector3d(-1, 0, 0),
              Vector3d(0, 1, 0), Vector3d(0, -1, 0)}) {
          const Vector3d side = Vector3d(forward.y(), forward.z(), forward.x());
          Eigen::Matrix3d r;
          r << side, forward.cross(side), forward;
          Camera c = makeCamera(17, 17, f, Vector3d(0.5, 0.25 * offset, 0.125 * offset), r);
          c.cx = c.cy = centre;
          OwnedView view{c, std::vector<float>(17 * 17)};
          for (size_t i = 0; i < view.depth.size(); ++i) view.depth[i] = 0.25f * float(1 + i % 7);
          views.push_back(view);
        }
        VoxelFrame frame;
        frame.voxel_m = 0.25f;
        frame.bounds = CoordBBox(Coord(-9), Coord(9));
        CarveSettings settings;
        settings.flying_pixel_ratio = 0;
        expectSameAsTraversal(frame, views, settings,
                              joinText("offset ", offset, " centre ", centre, " f ", f));
      }
    }
  }
}

TEST(Carve, RandomScenes) {
  std::mt19937 rng(11);
  const auto uniform = [&](double a, double b) {
    return std::uniform_real_distribution<double>(a, b)(rng);
  };
  for (int round = 0; round < 150; ++round) {
    VoxelFrame frame;
    frame.voxel_m = float(std::exp(uniform(std::log(0.04), std::log(0.7))));
    frame.world_from_grid = Eigen::Isometry3d(
        Eigen::Quaterniond(uniform(-1, 1), uniform(-1, 1), uniform(-1, 1), uniform(-1, 1))
            .normalized());
    frame.world_from_grid.translation() = Vector3d(uniform(-9, 9), uniform(-9, 9), uniform(-9, 9));
    const Coord low(int(uniform(-90, 40)), int(uniform(-40, 5)), int(uniform(-40, 5)));
    frame.bounds =
        CoordBBox(low, low.offsetBy(int(uniform(1, 45)), int(uniform(5, 40)), int(uniform(5, 40))));
    std::vector<OwnedView> views;
    const Vector3d middle =
        frame.toWorld(Vector3d(low.x(), low.y(), low.z()) + Vector3d(15, 15, 15));
    const int count = 1 + int(rng() % 4);
    for (int v = 0; v < count; ++v) {
      const Vector3d eye = middle + uniform(0, 40) * frame.voxel_m *
                                        Vector3d(uniform(-1, 1), uniform(-1, 1), uniform(-1, 1));
      const Vector3d aim(uniform(-1, 1), uniform(-1, 1), uniform(-1, 1));
      Camera c = makeCamera(5 + int(rng() % 30), 5 + int(rng() % 20), uniform(3, 60), eye,
                            lookAlong(rng() % 2 ? aim : (middle - eye + 0.3 * aim).eval()));
      c.fy *= uniform(0.7, 1.3), c.cx += uniform(-3, 3);
      OwnedView view{c, std::vector<float>(size_t(c.width) * c.height)};
      const double near = uniform(0.01, 3), far = near + uniform(0.01, 8);
      for (float& d : view.depth) d = rng() % 9 ? float(uniform(near, far)) : 0.f;
      views.push_back(view);
    }
    CarveSettings settings;
    settings.flying_pixel_ratio = rng() % 2 ? 0.05f : 0.f;
    expectSameAsTraversal(frame, views, settings, joinText("round ", round));
  }
}

TEST(Carve, PartitionsTheVolume) {
  const VoxelFrame frame = roomFrame(0.1f, 0.3);
  Progress progress;
  const SeenSpace space = carve(frame, borrow(roomViews(80, 60, 50)), {}, progress);
  const std::set<Coord> filled = voxelSet(space.filled), empty = voxelSet(space.empty);
  EXPECT_GT(filled.size(), 500u);
  EXPECT_GT(empty.size(), 5000u);
  for (const Coord& c : filled) EXPECT_EQ(empty.count(c), 0u) << c;
  for (const auto* set : {&filled, &empty}) {
    for (const Coord& c : *set) EXPECT_TRUE(frame.bounds.isInside(c)) << c;
  }
}

TEST(Carve, EmptyIsPrunedToTiles) {
  Progress progress;
  const SeenSpace space = carve(roomFrame(0.05f), borrow(roomViews(160, 120, 100)), {}, progress);
  EXPECT_GT(space.empty.activeTileCount(), 1000u);
  for (auto leaf = space.empty.cbeginLeaf(); leaf; ++leaf) {
    EXPECT_FALSE(leaf->isDense() || leaf->isEmpty());
  }
}

// A room of 4 m seen all around from one point, a plate before one wall: everything is E but the
// plate's shadow, whose volume is that of a pyramid's stump.
TEST(Carve, VolumeFractionsMatchClosedForm) {
  const Eigen::AlignedBox3d room(Vector3d(0, 0, 0), Vector3d(4, 4, 4));
  const Vector3d eye(2, 2, 2);
  const double half = 0.5, plate_x = 2.8;  // plate |y - 2|, |z - 2| < half
  std::vector<OwnedView> views;
  for (const Vector3d& forward : {Vector3d(0, 0, 1), Vector3d(0, 0, -1), Vector3d(1, 0, 0),
                                  Vector3d(-1, 0, 0), Vector3d(0, 1, 0), Vector3d(0, -1, 0)}) {
    const Vector3d side = Vector3d(forward.y(), forward.z(), forward.x());
    Eigen::Matrix3d r;
    r << side, forward.cross(side), forward;
    views.push_back(
        render(makeCamera(200, 200, 100, eye, r), [&](const Vector3d& o, const Vector3d& d) {
          const double t = (plate_x - o.x()) / d.x();
          const Vector3d p = o + t * d;
          const bool plate = t > 0 && std::abs(p.y() - 2) < half && std::abs(p.z() - 2) < half;
          return plate ? t : hitBox(room, o, d);
        }));
  }
  VoxelFrame frame;
  frame.voxel_m = 0.04f;
  frame.world_from_grid.translation() = Vector3d(-0.02, -0.02, -0.02);  // walls in mid-voxel
  frame.bounds = CoordBBox(Coord(-4), Coord(104));
  Progress progress;
  CarveSettings settings;
  settings.flying_pixel_ratio = 0;
  const SeenSpace space = carve(frame, borrow(views), settings, progress);
  const double voxel = std::pow(0.04, 3), stretch = half / (plate_x - 2);
  const double shadow = 4 * stretch * stretch * (std::pow(2, 3) - std::pow(plate_x - 2, 3)) / 3;
  const double volume = double(frame.bounds.volume()) * voxel;
  EXPECT_NEAR(double(space.empty.activeVoxelCount()) * voxel / volume,
              (std::pow(4 - 0.04, 3) - shadow) / volume, 0.01);
  // Outside of the walls nothing was seen, inside only the shadow was not.
  openvdb::tree::ValueAccessor<const TokenMask> filled(space.filled), empty(space.empty);
  size_t unseen = 0;
  const CoordBBox inside(Coord(0), Coord(100));
  for (auto c = frame.bounds.begin(); c; ++c) {
    const bool seen = filled.isValueOn(*c) || empty.isValueOn(*c);
    if (inside.isInside(*c)) {
      unseen += !seen;
    } else {
      ASSERT_FALSE(seen) << *c;
    }
  }
  EXPECT_NEAR(double(unseen) * voxel / shadow, 1, 0.06);
}

TEST(Carve, ThreadCountDoesNotMatter) {
  const std::vector<OwnedView> views = roomViews(120, 90, 80);
  const VoxelFrame frame = roomFrame(0.07f, 0.1);
  const auto run = [&](size_t threads) {
    tbb::global_control control(tbb::global_control::max_allowed_parallelism, threads);
    Progress progress;
    return carve(frame, borrow(views), {}, progress);
  };
  const SeenSpace one = run(1), four = run(4);
  EXPECT_TRUE(one.filled.hasSameTopology(four.filled));
  EXPECT_TRUE(one.empty.hasSameTopology(four.empty));
}

TEST(Carve, RejectsBadInput) {
  Progress progress;
  std::vector<OwnedView> views = roomViews(8, 6, 5);
  const auto attempt = [&](const std::vector<OwnedView>& v, const VoxelFrame& frame) {
    carve(frame, borrow(v), {}, progress);
  };
  const VoxelFrame frame = roomFrame(0.1f);
  auto bad = views;
  bad[1].camera.world_from_camera.linear() *= 1.1;
  EXPECT_THROW(attempt(bad, frame), Error);
  bad = views;
  bad[0].camera.world_from_camera.translation().x() = kNaN;
  EXPECT_THROW(attempt(bad, frame), Error);
  bad = views;
  bad[2].camera.world_from_camera.translation().x() = 1e9;
  EXPECT_THROW(attempt(bad, frame), Error);
  bad = views;
  bad[0].camera.fx = 0;
  EXPECT_THROW(attempt(bad, frame), Error);
  VoxelFrame flat = frame;
  flat.voxel_m = 0;
  EXPECT_THROW(attempt(views, flat), Error);
  EXPECT_THROW(carve(frame, {{views[0].camera, nullptr}}, {}, progress), Error);
}

TEST(Carve, CanBeInterrupted) {
  struct Impatient : Progress {
    bool wasInterrupted(int percent) override { return percent < 0; }  // workers ask without one
  } progress;
  EXPECT_THROW(carve(roomFrame(0.1f), borrow(roomViews(8, 6, 5)), {}, progress), Cancelled);
}

TEST(Carve, RealFramesMatchTraversal) {
  const std::string folder = sharedFile("data/rgbd_redkitchen");
  if (folder.empty()) GTEST_SKIP() << "no kitchen";
  ReadViewsSettings reading;
  reading.frames = {0, 9};
  std::vector<OwnedView> views;
  for (const View& v : readViews(folder, reading)) views.push_back({v.camera, v.depth});
  for (const float voxel_m : {0.1f, 0.04f}) {
    VoxelFrame frame;
    frame.voxel_m = voxel_m;
    const int n = int(4 / voxel_m);
    const Vector3d middle = views[0].camera.unproject(320, 240, 2) / double(voxel_m);
    const Coord centre(int(middle.x()), int(middle.y()), int(middle.z()));
    frame.bounds = CoordBBox(centre.offsetBy(-n), centre.offsetBy(n));
    expectSameAsTraversal(frame, views, {}, joinText("voxel ", voxel_m));
  }
}

TEST(UsableDepth, DropsWhatCarriesNoRay) {
  CarveSettings settings;
  settings.max_depth_m = 10;
  const Camera camera = makeCamera(3, 3, 5, Vector3d::Zero());
  for (const float bad : {0.f, -2.f, kNaN, kInf, -kInf, 10.01f}) {
    std::vector<float> depth(9, 2.f);
    depth[4] = bad;
    std::vector<float> expected(9, 2.f);
    expected[4] = 0;
    EXPECT_EQ(usableDepth({camera, depth.data()}, settings), expected) << bad;
  }
}

TEST(UsableDepth, DropsFlyingPixelsAndKeepsSlopesAndEdges) {
  CarveSettings settings;
  const Camera row = makeCamera(7, 1, 5, Vector3d::Zero());
  // Between two surfaces at 2 m and 4 m; the surfaces' own edge pixels stay.
  const std::vector<float> jump = {2, 2, 2, 3, 4, 4, 4}, cleaned = {2, 2, 2, 0, 4, 4, 4};
  EXPECT_EQ(usableDepth({row, jump.data()}, settings), cleaned);
  const Camera column = makeCamera(1, 7, 5, Vector3d::Zero());
  EXPECT_EQ(usableDepth({column, jump.data()}, settings), cleaned);
  // A slope of 4 % a pixel, a thin thing before a wall, a pixel beside a hole.
  for (const std::vector<float>& kept :
       {std::vector<float>{2.f, 2.08f, 2.16f, 2.25f, 2.34f, 2.43f, 2.53f},
        std::vector<float>{4, 4, 4, 2, 4, 4, 4}, std::vector<float>{2, 2, 2, 3, 0, 0, 4}}) {
    EXPECT_EQ(usableDepth({row, kept.data()}, settings), kept);
  }
  settings.flying_pixel_ratio = 0;
  EXPECT_EQ(usableDepth({row, jump.data()}, settings), jump);
}

TEST(Carve, PoolsToNodesByTheRule) {
  VoxelFrame frame = roomFrame(0.1f, 0.2);
  for (const Coord& shift : {Coord(0, 0, 0), Coord(1, 3, -2)}) {
    frame.bounds.translate(shift);  // nodes at the border are cut at other places
    Progress progress;
    const SeenSpace space = carve(frame, borrow(roomViews(120, 90, 60)), {}, progress);
    for (int level = 0; level <= 4; ++level) {
      const SeenSpace pooled = poolSeen(space, level);
      EXPECT_EQ(pooled.level, level);
      EXPECT_EQ(pooled.box, CoordBBox(tokenCoord(frame.bounds.min(), level),
                                      tokenCoord(frame.bounds.max(), level)));
      std::map<Coord, std::array<int, 3>> counts;  // of voxels, filled and empty ones
      for (auto c = frame.bounds.begin(); c; ++c) {
        auto& [voxels, filled, empty] = counts[tokenCoord(*c, level)];
        ++voxels;
        filled += space.filled.isValueOn(*c);
        empty += space.empty.isValueOn(*c);
      }
      EXPECT_EQ(counts.size(), pooled.box.volume());
      std::set<NodeState> kinds;
      for (const auto& [node, count] : counts) {
        const auto& [voxels, filled, empty] = count;
        const NodeState expected = filled            ? NodeState::kFilled
                                   : empty == voxels ? NodeState::kEmpty
                                                     : NodeState::kUnobserved;
        EXPECT_EQ(pooled.at(node), expected) << "level " << level << " node " << node;
        kinds.insert(expected);
      }
      if (level < 4) {
        EXPECT_EQ(kinds.size(), 3u);
      }
      EXPECT_EQ(pooled.at(pooled.box.max().offsetBy(1)), NodeState::kUnobserved);
    }
  }
}

}  // namespace
}  // namespace vdbc
