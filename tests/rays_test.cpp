// The ray caster against closed forms, and carve() against the ray caster.
#include "splat/rays.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <set>
#include <tuple>

#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Vector3d;
using Eigen::Vector3f;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

class Random {
 public:
  explicit Random(uint64_t seed) : engine_(seed) {}
  double real(double a, double b) { return uniform(engine_, a, b); }
  Vector3d inBox(double half) {
    const double x = real(-half, half), y = real(-half, half);
    return {x, y, real(-half, half)};
  }
  Vector3d direction() {
    Vector3d d = inBox(1);
    while (d.norm() > 1 || d.norm() < .1) d = inBox(1);
    return d.normalized();
  }

 private:
  std::mt19937_64 engine_;
};

void addBox(const Vector3f& lo, const Vector3f& hi, TriangleMesh* mesh) {
  const int first = int(mesh->vertices.size());
  for (int i = 0; i < 8; ++i)
    mesh->vertices.emplace_back(i & 4 ? hi.x() : lo.x(), i & 2 ? hi.y() : lo.y(),
                                i & 1 ? hi.z() : lo.z());
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      const int a = 4 >> (axis + 1) % 3, b = 4 >> (axis + 2) % 3;
      const int o = first + (side ? 4 >> axis : 0);
      mesh->triangles.emplace_back(o, o + a, o + a + b);
      mesh->triangles.emplace_back(o, o + a + b, o + b);
    }
}

VoxelFrame tiltedFrame() {
  VoxelFrame frame;
  frame.voxel_m = .1f;
  frame.world_from_grid =
      Eigen::Translation3d(.4, -.3, .2) * Eigen::AngleAxisd(.7, Vector3d(1, 2, 3).normalized());
  return frame;
}

std::vector<Coord> block(const Coord& lo, const Coord& hi) {
  std::vector<Coord> voxels;
  for (int x = lo.x(); x <= hi.x(); ++x)
    for (int y = lo.y(); y <= hi.y(); ++y)
      for (int z = lo.z(); z <= hi.z(); ++z) voxels.emplace_back(x, y, z);
  return voxels;
}

/// Entry into [lo, hi], 0 from inside: the closed form, by slabs.
double boxDistance(const Vector3d& o, const Vector3d& d, const Vector3d& lo, const Vector3d& hi) {
  double near = 0, far = kInfinity;
  for (int a = 0; a < 3; ++a) {
    const double t0 = (lo[a] - o[a]) / d[a], t1 = (hi[a] - o[a]) / d[a];
    near = std::max(near, std::min(t0, t1)), far = std::min(far, std::max(t0, t1));
  }
  return near <= far ? near : kInfinity;
}

TEST(RayTarget, MeshBoxFromInsideIsTheClosedForm) {
  TriangleMesh mesh;
  addBox({-1, -2, -.5f}, {2, 1, 1.5f}, &mesh);
  const RayTarget target = RayTarget::fromMesh(mesh);
  Random random(1);
  std::vector<Vector3f> origins, directions;
  for (int i = 0; i < 5000; ++i) {
    origins.push_back(random.inBox(.45).cast<float>());
    directions.push_back(random.direction().cast<float>());
  }
  const std::vector<float> t = target.trace(origins, directions);
  for (size_t i = 0; i < t.size(); ++i) {
    double expected = kInfinity;
    for (int a = 0; a < 3; ++a) {
      const double d = directions[i][a],
                   face = d > 0 ? Vector3d(2, 1, 1.5)[a] : Vector3d(-1, -2, -.5)[a];
      expected = std::min(expected, (face - origins[i][a]) / d);
    }
    EXPECT_NEAR(t[i], expected, 1e-5 * expected + 1e-6);
  }
}

TEST(RayTarget, SharedEdgesOfAMeshAreClosed) {
  TriangleMesh mesh;
  addBox({-1, -1, -1}, {1, 1, 1}, &mesh);
  const RayTarget target = RayTarget::fromMesh(mesh);
  // Straight at the edges, corners and face diagonals, from off-centre places.
  Random random(2);
  std::vector<Vector3f> origins, directions;
  for (int i = 0; i < 20000; ++i) {
    const Vector3d o = random.inBox(.5);
    Vector3d p = random.inBox(1);
    const int a = i % 3;
    p[a] = i % 2 ? 1 : -1, p[(a + 1) % 3] = i % 5 ? 1 : p[(a + 2) % 3];
    origins.push_back(o.cast<float>());
    directions.push_back((p - o).normalized().cast<float>());
  }
  for (float t : target.trace(origins, directions)) EXPECT_TRUE(std::isfinite(t));
}

TEST(RayTarget, VoxelsAreTheirBoxes) {
  const VoxelFrame frame = tiltedFrame();
  const std::vector<Coord> voxels = {{0, 0, 0}, {-7, 3, 2}, {5, 5, -5}, {5, 5, -4}, {-2, -9, 8}};
  const RayTarget target = RayTarget::fromVoxels(frame, voxels);
  Random random(3);
  std::vector<Vector3f> origins, directions;
  for (int i = 0; i < 6000; ++i) {
    // Aimed near a voxel, so that many rays hit and many just miss.
    const Coord c = voxels[size_t(i) % voxels.size()];
    const Vector3d aim =
        frame.toWorld(Vector3d(c.x() + .5, c.y() + .5, c.z() + .5) + random.inBox(1));
    origins.push_back((i % 9 == 0 ? aim : random.inBox(1.5)).cast<float>());
    directions.push_back(i % 9 == 0 ? random.direction().cast<float>()
                                    : (aim.cast<float>() - origins.back()).normalized());
  }
  const std::vector<float> t = target.trace(origins, directions);
  int hits = 0, inside = 0;
  for (size_t i = 0; i < t.size(); ++i) {
    const Vector3d o = frame.toIndex(origins[i].cast<double>());
    const Vector3d d =
        frame.world_from_grid.linear().transpose() * directions[i].cast<double>() / frame.voxel_m;
    double shrunk = kInfinity, grown = kInfinity;  // the answer lies between these two
    for (const Coord& c : voxels) {
      const Vector3d lo(c.x(), c.y(), c.z()), hi = lo.array() + 1;
      shrunk = std::min(shrunk, boxDistance(o, d, lo.array() + 2e-4, hi.array() - 2e-4));
      grown = std::min(grown, boxDistance(o, d, lo.array() - 2e-4, hi.array() + 2e-4));
    }
    EXPECT_LE(t[i], shrunk + 1e-5) << i;
    EXPECT_GE(t[i], grown - 1e-5) << i;
    hits += std::isfinite(t[i]), inside += t[i] == 0;
  }
  EXPECT_GT(hits, 1000);
  EXPECT_LT(hits, 5500);
  EXPECT_GT(inside, 50);
}

TEST(RayTarget, EmptyTargetsAreMissedAndBadMeshesThrow) {
  const std::vector<Vector3f> o = {Vector3f::Zero()}, d = {Vector3f::UnitZ()};
  EXPECT_FALSE(std::isfinite(RayTarget::fromMesh({}).trace(o, d)[0]));
  EXPECT_FALSE(std::isfinite(RayTarget::fromVoxels({}, {}).trace(o, d)[0]));
  TriangleMesh bad;
  bad.vertices.resize(3, Vector3f::Zero());
  bad.triangles.emplace_back(0, 1, 3);
  EXPECT_THROW(RayTarget::fromMesh(bad), Error);
  EXPECT_THROW(RayTarget::fromMesh({}).trace(o, {}), Error);
}

// --- agreement and leaks
// --------------------------------------------------------------------------

/// A closed room [0,4] x [0,3] x [0,2.5] with a cupboard, as triangles.
TriangleMesh boxRoom() {
  TriangleMesh mesh;
  addBox({0, 0, 0}, {4, 3, 2.5f}, &mesh);
  addBox({2.4f, 1.1f, 0}, {3.1f, 1.9f, 1.2f}, &mesh);
  return mesh;
}

Camera cameraAt(const Vector3d& eye, const Vector3d& target, int width, int height, double focal) {
  return {
      width, height, focal, focal, width / 2., height / 2., lookAt(eye, target, Vector3d::UnitZ())};
}

/// Depth by Embree through the pixel centres.
View traced(const RayTarget& target, const Camera& c) {
  View view;
  view.camera = c;
  std::vector<Vector3f> origins, directions;
  std::vector<double> z;
  for (int y = 0; y < c.height; ++y)
    for (int x = 0; x < c.width; ++x) {
      const Vector3d d = c.unproject(x + .5, y + .5, 1) - c.world_from_camera.translation();
      origins.push_back(c.world_from_camera.translation().cast<float>());
      directions.push_back(d.normalized().cast<float>());
      z.push_back(1 / d.norm());
    }
  const std::vector<float> t = target.trace(origins, directions);
  for (size_t i = 0; i < t.size(); ++i)
    view.depth.push_back(std::isfinite(t[i]) ? float(t[i] * z[i]) : 0.f);
  return view;
}

std::vector<View> boxViews(const RayTarget& target) {
  return {traced(target, cameraAt({.5, .5, 1.4}, {3, 2, .8}, 240, 180, 130)),
          traced(target, cameraAt({3.5, .4, 1.6}, {1, 2.2, .7}, 240, 180, 130)),
          traced(target, cameraAt({1.2, 2.6, 1.2}, {3.2, .3, 1.1}, 240, 180, 130))};
}

TEST(DepthAgreement, CountsErrorsMissesAndInvalidPixels) {
  const RayTarget target = RayTarget::fromMesh(boxRoom());
  std::vector<View> views = boxViews(target);
  DepthAgreement a = depthAgreement(target, views, .01f);
  EXPECT_EQ(a.rays, 3 * 240 * 180);
  EXPECT_EQ(a.within_share, 1);
  EXPECT_EQ(a.miss_share, 0);
  EXPECT_LT(a.median_error_m, 1e-5);
  // A third of the pixels off by 5 cm, another third invalid.
  for (View& view : views)
    for (size_t i = 0; i < view.depth.size(); ++i) {
      if (i % 3 == 1) view.depth[i] += .05f;
      if (i % 3 == 2) view.depth[i] = i % 2 ? 0.f : std::numeric_limits<float>::quiet_NaN();
    }
  a = depthAgreement(target, views, .01f);
  EXPECT_EQ(a.rays, 2 * 240 * 180);
  EXPECT_NEAR(a.within_share, .5, 1e-9);
  a = depthAgreement(target, views, .06f);
  EXPECT_EQ(a.within_share, 1);
  a = depthAgreement(RayTarget::fromMesh({}), views, .06f);
  EXPECT_EQ(a.miss_share, 1);
  EXPECT_EQ(a.within_share, 0);
  views[0].depth.pop_back();
  EXPECT_THROW(depthAgreement(target, views, .01f), Error);
}

TEST(LeakRate, IsZeroForItselfOneForNothingAndTheShareForHalf) {
  // A hollow cube of voxels, seen from its middle.
  VoxelFrame frame = tiltedFrame();
  std::vector<Coord> shell, half;
  for (const Coord& c : block({-5, -5, -5}, {4, 4, 4}))
    if (std::max({c.x(), c.y(), c.z()}) == 4 || std::min({c.x(), c.y(), c.z()}) == -5) {
      shell.push_back(c);
      if (c.x() >= 0) half.push_back(c);
    }
  const RayTarget whole = RayTarget::fromVoxels(frame, shell);
  const RayTarget part = RayTarget::fromVoxels(frame, half);
  const RayTarget nothing = RayTarget::fromVoxels(frame, {});
  const std::vector<Vector3f> middle = {frame.toWorld({0, 0, 0}).cast<float>()};
  EXPECT_EQ(leakRate(whole, whole, middle, 4000, .01f, 1), 0);
  EXPECT_EQ(leakRate(whole, nothing, middle, 4000, .01f, 1), 1);
  EXPECT_NEAR(leakRate(whole, part, middle, 40000, .01f, 1), .5, .01);  // by symmetry
  EXPECT_EQ(leakRate(whole, part, middle, 4000, .01f, 1),
            leakRate(whole, part, middle, 4000, .01f, 1));
  EXPECT_TRUE(std::isnan(leakRate(nothing, whole, middle, 100, .01f, 1)));
  EXPECT_EQ(openShare(whole, middle, 4000, 1), 0);
  EXPECT_EQ(openShare(nothing, middle, 4000, 1), 1);
  EXPECT_NEAR(openShare(part, middle, 40000, 1), .5, .01);
  EXPECT_TRUE(std::isnan(openShare(whole, {}, 100, 1)));
}

TEST(LeakRate, ToleranceDecidesHowFarBehindCounts) {
  TriangleMesh near, far;
  addBox({-1, -1, -1}, {1, 1, 1}, &near);
  addBox({-1.1f, -1.1f, -1.1f}, {1.1f, 1.1f, 1.1f}, &far);
  const RayTarget a = RayTarget::fromMesh(near), b = RayTarget::fromMesh(far);
  const std::vector<Vector3f> o = {Vector3f::Zero()};
  EXPECT_EQ(leakRate(a, b, o, 2000, .09f, 1), 1);   // the walls are .1 behind, or more
  EXPECT_EQ(leakRate(a, b, o, 2000, .18f, 1), 0);   // at most .1 * sqrt(3)
  EXPECT_EQ(leakRate(b, a, o, 2000, .001f, 1), 0);  // in front is no leak
}

// --- carve() against Embree
// --------------------------------------------------------------

using VoxelSet = std::set<std::tuple<int, int, int>>;

/// F and E from Embree's own distances: each ray is cut at every grid plane it crosses; the middle
/// of each piece names its voxel. Shares nothing with carve() but the definition.
void truthFromEmbree(const RayTarget& target, const VoxelFrame& frame,
                     const std::vector<Camera>& cameras, VoxelSet* filled, VoxelSet* empty) {
  VoxelSet passed;
  for (const Camera& c : cameras) {
    const View view = traced(target, c);
    for (int y = 0; y < c.height; ++y)
      for (int x = 0; x < c.width; ++x) {
        const double depth = view.depth[size_t(y) * size_t(c.width) + size_t(x)];
        if (!(depth > 0)) continue;
        const Vector3d o = frame.toIndex(c.world_from_camera.translation());
        const Vector3d p = frame.toIndex(c.unproject(x + .5, y + .5, depth)), d = p - o;
        std::vector<double> cuts = {0, 1};
        for (int a = 0; a < 3; ++a)
          for (int plane = int(std::floor(std::min(o[a], p[a]))) + 1; plane < std::max(o[a], p[a]);
               ++plane)
            cuts.push_back((plane - o[a]) / d[a]);
        std::sort(cuts.begin(), cuts.end());
        const auto voxel = [](const Vector3d& q) {
          return std::make_tuple(int(std::floor(q.x())), int(std::floor(q.y())),
                                 int(std::floor(q.z())));
        };
        for (size_t i = 0; i + 1 < cuts.size(); ++i)
          passed.insert(voxel(o + d * (cuts[i] + cuts[i + 1]) / 2));
        filled->insert(voxel(p));
      }
  }
  const auto inBounds = [&](const std::tuple<int, int, int>& v) {
    return frame.bounds.isInside(Coord(std::get<0>(v), std::get<1>(v), std::get<2>(v)));
  };
  for (const auto& v : passed)
    if (!filled->count(v) && inBounds(v)) empty->insert(v);
  for (auto it = filled->begin(); it != filled->end();)
    it = inBounds(*it) ? std::next(it) : filled->erase(it);
}

TEST(Carve, VolumesAgreeWithEmbreeOnBoxes) {
  const RayTarget target = RayTarget::fromMesh(boxRoom());
  const std::vector<View> views = boxViews(target);
  // Walls well inside voxels: on a face of the grid, rounding would decide which side is filled.
  for (const bool is_turned : {false, true}) {
    VoxelFrame frame;
    frame.world_from_grid = Eigen::Translation3d(-.537, -.463, -.471) *
                            Eigen::AngleAxisd(is_turned ? .3 : 0., Vector3d::UnitZ());
    frame.bounds = is_turned ? CoordBBox(Coord(0, -15, 0), Coord(59, 39, 33))
                             : CoordBBox(Coord(0, 0, 0), Coord(50, 39, 33));
    VoxelSet filled, empty;
    std::vector<Camera> cameras;
    std::vector<DepthView> depth_views;
    for (const View& view : views) {
      cameras.push_back(view.camera);
      depth_views.push_back(view.depthView());
    }
    truthFromEmbree(target, frame, cameras, &filled, &empty);
    CarveSettings settings;
    settings.flying_pixel_ratio = 0;  // every ray counts, as in the truth
    Progress progress;
    const SeenSpace space = carve(frame, depth_views, settings, progress);
    const double total = double(frame.bounds.volume());
    const double f = double(space.filled.activeVoxelCount()) / total;
    const double e = double(space.empty.activeVoxelCount()) / total, u = 1 - f - e;
    const double true_f = double(filled.size()) / total, true_e = double(empty.size()) / total;
    const double true_u = 1 - true_f - true_e;
    EXPECT_GT(true_f, .02);
    EXPECT_GT(true_e, .1);
    EXPECT_GT(true_u, .1);
    EXPECT_NEAR(f / true_f, 1, .01);
    EXPECT_NEAR(e / true_e, 1, .01);
    EXPECT_NEAR(u / true_u, 1, .01);
    // And in place, not just in volume.
    int64_t wrong = 0;
    for (const Coord& c : activeCoords(space.filled)) wrong += !filled.count({c.x(), c.y(), c.z()});
    for (const Coord& c : activeCoords(space.empty)) wrong += !empty.count({c.x(), c.y(), c.z()});
    EXPECT_LT(double(wrong), .01 * double(filled.size() + empty.size()));
  }
}

}  // namespace
}  // namespace vdbc
