// Surfaces one token thick (docs/method.md, section 4.10): walls by hand, and any tokens against a
// plain rule over a map.
#include "mar/thinning.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <numeric>
#include <random>
#include <set>

namespace vdbc {
namespace {

Place askedOf(const std::map<Coord, float>& probability) {
  Place place;
  for (const auto& [c, p] : probability) place.ijk.push_back(c), place.probability.push_back(p);
  return place;
}

std::set<Coord> thickOf(const Place& asked) {
  const std::vector<uint8_t> thick = thickTokens(asked);
  EXPECT_EQ(thick.size(), asked.ijk.size());
  std::set<Coord> tokens;
  for (size_t i = 0; i < thick.size(); ++i)
    if (thick[i]) tokens.insert(asked.ijk[i]);
  return tokens;
}

/// A wall of 8 x 8 tokens; its layers in x are as likely as told.
std::map<Coord, float> wallOf(const std::vector<float>& layers) {
  std::map<Coord, float> wall;
  for (int x = 0; x < int(layers.size()); ++x)
    for (int y = 0; y < 8; ++y)
      for (int z = 0; z < 8; ++z) wall[Coord(x, y, z)] = layers[size_t(x)];
  return wall;
}

std::set<int> layersOf(const std::set<Coord>& tokens) {
  std::set<int> layers;
  for (const Coord& c : tokens) layers.insert(c.x());
  EXPECT_EQ(tokens.size(), layers.size() * 64);
  return layers;
}

TEST(Thinning, OfAThickWallTheLikeliestLayerStays) {
  EXPECT_EQ(layersOf(thickOf(askedOf(wallOf({.8f})))), std::set<int>());
  EXPECT_EQ(layersOf(thickOf(askedOf(wallOf({.7f, .8f})))), std::set<int>({0}));
  EXPECT_EQ(layersOf(thickOf(askedOf(wallOf({.7f, .8f, .75f})))), std::set<int>({0, 2}));
  EXPECT_EQ(layersOf(thickOf(askedOf(wallOf({.7f, .7f})))), std::set<int>())
      << "neither is likelier";
  EXPECT_EQ(layersOf(thickOf(askedOf(wallOf({.9f, .2f, .9f})))), std::set<int>({1}))
      << "two walls stay two";
  // A block is no surface, whatever its probabilities.
  EXPECT_EQ(thickOf(askedOf(wallOf({.7f, .71f, .72f, .73f}))), std::set<Coord>());
}

TEST(Thinning, IsThePlainRuleInAnyOrder) {
  std::mt19937 random(1);
  std::uniform_real_distribution<float> uniform;
  for (int trial = 0; trial < 20; ++trial) {
    std::map<Coord, float> likely;
    for (const Coord& c : CoordBBox(Coord(-4), Coord(5)))
      if (uniform(random) < .7f) likely[c] = uniform(random);
    Place asked = askedOf(likely);
    std::set<Coord> truth;
    for (const auto& [c, p] : likely) {
      int shortest = 100;
      bool beaten = false;
      for (const Coord& axis : {Coord(1, 0, 0), Coord(0, 1, 0), Coord(0, 0, 1)}) {
        int length = 1;
        bool is_beaten = false;
        for (const Coord& step : {axis, -axis}) {
          const auto next = likely.find(c + step);
          is_beaten = is_beaten || (next != likely.end() && next->second > p);
          for (Coord n = c + step; likely.count(n) && likely[n] >= .8f * p; n += step) ++length;
        }
        if (length < shortest) shortest = length, beaten = is_beaten;
      }
      if (shortest <= 3 && beaten) truth.insert(c);
    }
    ASSERT_GT(truth.size(), 50u);
    std::vector<size_t> order(asked.ijk.size());
    std::iota(order.begin(), order.end(), 0);
    std::shuffle(order.begin(), order.end(), random);
    Place shuffled;
    for (size_t i : order) {
      shuffled.ijk.push_back(asked.ijk[i]);
      shuffled.probability.push_back(asked.probability[i]);
    }
    ASSERT_EQ(thickOf(asked), truth);
    ASSERT_EQ(thickOf(shuffled), truth);
  }
}

}  // namespace
}  // namespace vdbc
