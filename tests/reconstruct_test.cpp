// The baselines of the evaluations, and what counts there.
#include "examples/lab/reconstruct.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "splat/metrics.h"
#include "splat/rasterize.h"
#include "tests/simple_room.h"

namespace vdbc {
namespace {

constexpr uint64_t kRoom = 41;

struct ViewedPlace {
  std::vector<View> views;
  Observation observation;
  std::vector<std::vector<uint8_t>> observed;
};

ViewedPlace placeOf(std::vector<View> views) {
  Progress silent;
  Observation o = observe(views, ObserveSettings(), silent);
  ViewedPlace place{std::move(views), std::move(o), {}};
  for (const View& v : place.views)
    place.observed.push_back(observedPixels(v, place.observation, 1, CarveSettings()));
  return place;
}

const ViewedPlace& simplePlace() {
  static const ViewedPlace place = placeOf(simpleRoomViews(4, 96, 72, kRoom));
  return place;
}

double meanPsnr(const Gaussians& g, const ViewedPlace& place) {
  double sum = 0;
  for (size_t i = 0; i < place.views.size(); ++i)
    sum += pictureError(place.views[i].colour, rasterize(g, place.views[i].camera, {}).colour,
                        place.observed[i])
               .psnr;
  return sum / double(place.views.size());
}

TEST(Reconstruct, VoxelMeanOfOneColourHasThatColour) {
  std::vector<View> views = simpleRoomViews(4, 96, 72, kRoom);
  const float colour[3] = {.2f, .5f, .7f};
  for (View& v : views)
    for (size_t i = 0; i < v.colour.data.size(); ++i) v.colour.data[i] = colour[i % 3];
  const ViewedPlace place = placeOf(std::move(views));
  const Gaussians g = voxelMean(place.observation, 8);
  ASSERT_EQ(g.size(), 8 * place.observation.tokens.size(0));
  for (size_t i = 0; i < g.sh.size(); ++i) ASSERT_NEAR(.5f + kSh0 * g.sh[i], colour[i % 3], 1e-5);
  EXPECT_GT(meanPsnr(g, place), 30);
}

TEST(Reconstruct, VoxelMeanLiesOnTheSubLattice) {
  const Observation& o = simplePlace().observation;
  const Gaussians g = voxelMean(o, 27);
  for (size_t i = 0; i < g.mean.size(); ++i) {
    const Eigen::Vector3d index = o.frame.toIndex(g.mean[i].cast<double>());
    const Coord voxel = o.tokens.coords(0)[i / 27];
    const int cell[3] = {int(i % 27) / 9, int(i % 9) / 3, int(i % 3)};
    for (int axis = 0; axis < 3; ++axis)
      ASSERT_NEAR(index[axis], voxel[axis] + (cell[axis] + .5) / 3, 1e-4);
    ASSERT_NEAR(std::exp(g.log_scale[i].x()), o.frame.voxel_m / 6, 1e-6);
  }
}

TEST(Reconstruct, PixelAlignedReproducesTheInput) {
  const ViewedPlace& place = simplePlace();
  const ViewedPlace one = placeOf({place.views[0]});
  EXPECT_GT(meanPsnr(pixelAligned(one.views, one.observed), one), 30);
  const Gaussians all = pixelAligned(place.views, place.observed);
  int64_t pixels = 0;
  for (const auto& mask : place.observed) pixels += std::count(mask.begin(), mask.end(), 1);
  EXPECT_EQ(all.size(), pixels);
  EXPECT_GT(meanPsnr(all, place), meanPsnr(voxelMean(place.observation, 8), place) + 2);
}

TEST(Reconstruct, OptimisingBeatsItsStart) {
  const ViewedPlace& place = simplePlace();
  const Gaussians start = voxelMean(place.observation, 8);
  OptimiseSettings settings;
  settings.seconds = 1e9, settings.max_steps = 40;
  Progress silent;
  const Gaussians better = optimised(start, place.views, place.observed, settings, silent);
  EXPECT_GT(meanPsnr(better, place), meanPsnr(start, place) + 2);
  settings.max_steps = 0;
  EXPECT_EQ(optimised(start, place.views, place.observed, settings, silent).mean, start.mean);
}

TEST(Reconstruct, AnInterruptedOptimisationStops) {
  struct Impatient : Progress {
    bool wasInterrupted(int) override { return true; }
  } impatient;
  const ViewedPlace& place = simplePlace();
  EXPECT_THROW(
      optimised(voxelMean(place.observation, 1), place.views, place.observed, {}, impatient),
      Cancelled);
}

TEST(Reconstruct, SplitScoresKnowTheTruth) {
  const Observation& o = simplePlace().observation;
  const TriangleMesh truth = solidMesh(simpleRoom(kRoom).surface);
  for (int level : {0, 1}) {
    const std::vector<Coord>& parents = o.tokens.coords(level + 1);
    std::vector<Coord> everything, surface;  // voxels of the children
    const std::vector<Coord> nodes = surfaceNodes(truth, o.frame, level);
    const std::set<Coord> true_nodes(nodes.begin(), nodes.end());
    for (const Coord& parent : parents)
      for (int slot = 0; slot < 8; ++slot) {
        const Coord child = childCoord(parent, slot), voxel = level ? childCoord(child, 0) : child;
        everything.push_back(voxel);
        if (true_nodes.count(child)) surface.push_back(voxel);
      }
    const SetScores exact = splitScores(truth, o, surface, level);
    EXPECT_EQ(exact.precision, 1);
    EXPECT_EQ(exact.recall, 1);
    EXPECT_EQ(exact.f1, 1);
    const SetScores all = splitScores(truth, o, everything, level);
    EXPECT_EQ(all.recall, 1);
    EXPECT_GT(all.precision, 0);
    EXPECT_LT(all.precision, 1);
    const SetScores seen =
        splitScores(truth, o, o.tokens.coords(0), level);  // adds nothing to what was seen
    EXPECT_TRUE(std::isnan(seen.precision));
    EXPECT_EQ(seen.recall, 0);
  }
}

TEST(Reconstruct, SetScoresCount) {
  const SetScores s =
      setScores({{0, 0, 0}, {0, 0, 1}, {0, 0, 2}}, {{0, 0, 1}, {0, 0, 2}, {0, 0, 3}, {0, 0, 4}});
  EXPECT_DOUBLE_EQ(s.precision, 2 / 3.);
  EXPECT_DOUBLE_EQ(s.recall, .5);
  EXPECT_DOUBLE_EQ(s.f1, 4 / 7.);
  EXPECT_DOUBLE_EQ(s.iou, 2 / 5.);
  EXPECT_DOUBLE_EQ(s.iou, s.f1 / (2 - s.f1));
  EXPECT_TRUE(std::isnan(setScores({}, {}).iou));
}

TEST(Evaluate, OutsideIsWhatLiesBehindTheShell) {
  // A room of 2 x 1.6 x 1.2 m, turned; its walls in the middle of nodes: 11 x 9 x 7 nodes are in it
  // or in its shell.
  Room room;
  room.world_from_room =
      Eigen::Translation3f(1, -2, .3f) * Eigen::AngleAxisf(.7f, Eigen::Vector3f::UnitZ());
  SurfaceMesh local;
  const Eigen::Vector3f size(2, 1.6f, 1.2f);
  addBox(Eigen::Vector3f::Zero(), size, Material(), true, &local);
  room.surface.append(local, Eigen::Affine3f(room.world_from_room));
  room.floor = {{0, 0}, {size.x(), 0}, {size.x(), size.y()}, {0, size.y()}};
  room.ceilings = {{0, 0, size.z()}};
  EvaluationScene scene;
  scene.is_within = [&](const Eigen::Vector3f& p) {
    return isWithin(room, room.world_from_room.inverse() * p);
  };
  VoxelFrame frame;
  frame.world_from_grid = room.world_from_room.cast<double>();
  frame.world_from_grid.linear() =
      Eigen::Quaterniond(frame.world_from_grid.linear()).normalized().toRotationMatrix();
  frame.world_from_grid.translate(Eigen::Vector3d::Constant(-.1));
  const std::vector<Coord> surface = surfaceNodes(solidMesh(room.surface), frame, 1);
  const std::set<Coord> truth(surface.begin(), surface.end());
  EXPECT_EQ(truth.size(), 11u * 9 * 7 - 9 * 7 * 5);
  std::set<Coord> filled;
  for (int x = -1; x <= 11; ++x)
    for (int y = -1; y <= 9; ++y)
      for (int z = -1; z <= 7; ++z) filled.insert(Coord(x, y, z));
  EXPECT_EQ(outsideCount(scene, frame, filled, truth), 13 * 11 * 9 - 11 * 9 * 7);
  EXPECT_EQ(outsideCount(scene, frame, truth, truth), 0);
}

TEST(Evaluate, ReliabilityCountsGeneratedNodes) {
  Place place;
  const auto add = [&](int x, float probability, bool generated) {
    place.ijk.emplace_back(x, 0, 0);
    place.probability.push_back(probability), place.generated.push_back(generated);
  };
  add(0, 1, false), add(1, .25f, true), add(2, .25f, true), add(3, .75f, true), add(4, 1, true),
      add(5, 0, true);
  add(6, .9f, true);
  SeenSpace all;
  all.level = 1, all.box = CoordBBox(Coord(0), Coord(9));
  for (int x : {0, 1, 4}) all.filled.setValueOn(Coord(x, 0, 0));
  for (int x : {2, 3, 5}) all.empty.setValueOn(Coord(x, 0, 0));  // nobody saw the last one
  const Reliability r = reliabilityOf(outcomesOf(place, all));
  const std::array<int, 10> counts = {1, 0, 2, 0, 0, 0, 0, 1, 0, 1},
                            hits = {0, 0, 1, 0, 0, 0, 0, 0, 0, 1};
  for (size_t i = 0; i < r.size(); ++i) {
    EXPECT_EQ(r[i].count, counts[i]);
    EXPECT_EQ(r[i].hits, hits[i]);
  }
  EXPECT_DOUBLE_EQ(r[2].sum_probability, .5);
  EXPECT_DOUBLE_EQ(calibrationError(r),
                   (2 * .25 + .75) / 5);  // bin 2: half are hits, not a quarter
  EXPECT_TRUE(std::isnan(calibrationError({})));
}

TEST(Evaluate, MeansSumTheReliabilityAndDeviationsAreOfTheSample) {
  std::vector<MethodResult> results(4);
  for (size_t i = 0; i < results.size(); ++i) results[i].method = i < 3 ? "a" : "b";
  results[0].psnr = 20, results[1].psnr = 23, results[2].psnr = 26;
  results[0].leak = .2, results[1].leak = .4,
  results[2].leak = std::numeric_limits<double>::quiet_NaN();
  results[0].reliability.emplace(), results[1].reliability.emplace();
  (*results[0].reliability)[3] = {2, 1, .7}, (*results[1].reliability)[3] = {4, 1, 1.3};
  const std::vector<MethodResult> means = meanResults(results),
                                  deviations = deviationResults(results);
  ASSERT_EQ(means.size(), 2u);
  ASSERT_TRUE(means[0].reliability);
  EXPECT_EQ((*means[0].reliability)[3].count, 6);
  EXPECT_EQ((*means[0].reliability)[3].hits, 2);
  EXPECT_DOUBLE_EQ((*means[0].reliability)[3].sum_probability, 2);
  EXPECT_FALSE(means[1].reliability);
  ASSERT_EQ(deviations.size(), 2u);
  EXPECT_EQ(deviations[0].scene, "std");
  EXPECT_DOUBLE_EQ(deviations[0].psnr, 3);
  EXPECT_NEAR(deviations[0].leak, .2 / std::sqrt(2.), 1e-12);
  EXPECT_TRUE(std::isnan(deviations[1].psnr));
}

TEST(Reconstruct, MeansLeaveOutWhatIsNotThere) {
  std::vector<ReconstructionResult> results(3);
  results[0].method = results[1].method = "a", results[2].method = "b";
  results[0].input_psnr = 20, results[1].input_psnr = 30;
  results[0].leak = std::numeric_limits<double>::quiet_NaN(), results[1].leak = .5;
  results[0].gaussians = 10, results[1].gaussians = 20;
  const std::vector<ReconstructionResult> means = meanReconstructions(results);
  ASSERT_EQ(means.size(), 2u);
  EXPECT_EQ(means[0].scene, "mean");
  EXPECT_EQ(means[0].input_psnr, 25);
  EXPECT_EQ(means[0].leak, .5);
  EXPECT_EQ(means[0].gaussians, 15);
}

}  // namespace
}  // namespace vdbc
