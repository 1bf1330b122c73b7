// Gaussians merged by their moments: against what a pair's and a square's are.
#include "splat/merge.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>

#include "vdb/threads.h"

namespace vdbc {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector3f;

Blob blobAt(const Vector3f& mean, const Vector3f& sigmas) {
  Blob b;
  b.mean = mean, b.opacity = .9f, b.probability = .8f;
  b.covariance = sigmas.cwiseAbs2().asDiagonal();
  return b;
}

/// A square of edge .1 m in the plane z = `mean.z()`: its variance is edge^2 / 12.
Blob tileAt(const Vector3f& mean) {
  const float sigma = .1f / std::sqrt(12.f);
  return blobAt(mean, {sigma, sigma, .002f});
}

const auto kAny = [](const Blob&) { return true; };

TEST(Merge, APairHasTheMomentsAndTheLightOfBoth) {
  const float sigma = .02f, apart = .03f;
  Blob left = blobAt({1 - apart, 2, 3}, Vector3f::Constant(sigma)), right = left;
  right.mean.x() = 1 + apart;
  left.colour = {.2f, 0, 0}, right.colour = {.4f, 0, 0};
  left.opacity = right.opacity = .3f;
  right.probability = .6f;
  const Blob both = merged({left, right});
  EXPECT_LT((both.mean - Vector3f(1, 2, 3)).norm(), 1e-6f);
  EXPECT_NEAR(both.colour[0], .3f, 1e-6f);
  const float along = sigma * sigma + apart * apart;
  const Matrix3f expected = Vector3f(along, sigma * sigma, sigma * sigma).asDiagonal();
  EXPECT_LT((both.covariance - expected).norm(), 1e-7f);
  const float area = 2 * std::sqrt(along) * sigma + sigma * sigma;
  EXPECT_NEAR(both.opacity, 2 * .3f * 3 * sigma * sigma / area, 1e-5f);
  EXPECT_EQ(both.probability, .6f);  // the lowest
}

TEST(Merge, FourTilesAreOneOfTwiceTheEdge) {
  std::vector<Blob> tiles;
  for (float x : {.05f, .15f})
    for (float y : {.05f, .15f}) tiles.push_back(tileAt({x, y, .1f}));
  tiles[2].probability = .5f;
  const std::vector<Blob> one = mergeAlike(tiles, {}, kAny);
  ASSERT_EQ(one.size(), 1u);
  EXPECT_LT((one[0].mean - Vector3f(.1f, .1f, .1f)).norm(), 1e-6f);
  EXPECT_NEAR(one[0].covariance(0, 0), .2f * .2f / 12, 1e-6f);
  EXPECT_NEAR(one[0].covariance(1, 1), .2f * .2f / 12, 1e-6f);
  EXPECT_NEAR(one[0].covariance(2, 2), .002f * .002f, 1e-8f);
  EXPECT_NEAR(one[0].opacity, .9f, 1e-5f);
  EXPECT_EQ(one[0].probability, .5f);
}

TEST(Merge, WhatDiffersStaysApart) {
  const Blob tile = tileAt({.05f, .05f, .05f});
  const auto left = [&](const Blob& other) { return mergeAlike({tile, other}, {}, kAny).size(); };
  EXPECT_EQ(left(tileAt({.15f, .05f, .05f})), 1u);
  Blob red = tileAt({.15f, .05f, .05f});
  red.colour[0] = .2f / kSh0;
  EXPECT_EQ(left(red), 2u);
  EXPECT_EQ(left(tileAt({.05f, .05f, .15f})), 2u);  // a sheet behind it
  Blob wall = blobAt({.15f, .05f, .1f}, {.002f, .03f, .03f});
  EXPECT_EQ(left(wall), 2u);                        // around a corner
  EXPECT_EQ(left(tileAt({.25f, .05f, .05f})), 2u);  // another cell
  EXPECT_EQ(
      mergeAlike({tile, tileAt({.15f, .05f, .05f})}, {}, [](const Blob&) { return false; }).size(),
      2u);
  EXPECT_TRUE(mergeAlike({}, {}, kAny).empty());
}

TEST(Merge, RowsKeepABlobsShape) {
  Blob b = blobAt({1, -2, 3}, {.03f, .01f, .002f});
  const Matrix3f turn = Eigen::AngleAxisf(.7f, Vector3f(1, 2, -1).normalized()).matrix();
  b.covariance = turn * b.covariance * turn.transpose();
  b.colour = {.1f, -.2f, .3f};
  Gaussians g;
  appendBlob(b, &g);
  const Blob again = blobOf(g, 0);
  EXPECT_LT((again.covariance - b.covariance).norm(), 1e-7f);
  EXPECT_EQ(again.mean, b.mean);
  EXPECT_EQ(again.colour, b.colour);
  EXPECT_NEAR(again.opacity, b.opacity, 1e-5f);
}

}  // namespace
}  // namespace vdbc
