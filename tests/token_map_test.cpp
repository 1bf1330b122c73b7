// A map by token does what std::map does, and keeps the order of insertion.
#include "vdb/token_map.h"

#include <gtest/gtest.h>

#include <map>
#include <random>

namespace vdbc {
namespace {

TEST(TokenMap, DoesWhatAStandardMapDoes) {
  std::mt19937 random(1);
  TokenMap<int> map;
  std::map<Coord, int> truth;
  std::vector<Coord> order;
  const auto draw = [&](int extent) {
    const auto part = [&] { return int(random() % unsigned(2 * extent + 1)) - extent; };
    return Coord(part(), part(), part());
  };
  for (int i = 0; i < 6000; ++i) {
    const Coord token = draw(i % 50 ? 7 : 100000);
    const bool is_new = !truth.count(token);
    if (is_new) order.push_back(token);
    if (random() % 2) {
      EXPECT_EQ(map.insert(token, i), is_new);
      truth.insert({token, i});
    } else {
      map.set(token, i);
      truth[token] = i;
    }
    const Coord other = draw(8);
    const auto found = truth.find(other);
    const int* value = map.find(other);
    ASSERT_EQ(value != nullptr, found != truth.end());
    if (value) {
      ASSERT_EQ(*value, found->second);
    }
  }
  EXPECT_EQ(map.size(), truth.size());
  EXPECT_EQ(map.tokens(), order);
  ASSERT_EQ(map.values().size(), order.size());
  for (size_t i = 0; i < order.size(); ++i) {
    EXPECT_EQ(map.values()[i], truth.at(order[i]));
    EXPECT_EQ(map.find(order[i]), &map.values()[i]);
  }
}

TEST(TokenMap, OfListsHoldsPairs) {
  const std::vector<Coord> tokens = {Coord(3, -1, 4), Coord(-1, 5, -9), Coord(0)};
  const TokenMap<float> map(tokens, {.5f, 0.f, -2.f});
  EXPECT_EQ(map.tokens(), tokens);
  EXPECT_EQ(map.values(), (std::vector<float>{.5f, 0.f, -2.f}));
  EXPECT_EQ(*map.find(Coord(-1, 5, -9)), 0.f);
  EXPECT_EQ(map.find(Coord(1)), nullptr);
  EXPECT_EQ(TokenMap<float>().find(Coord(0)), nullptr);
  EXPECT_EQ(TokenMap<float>().size(), 0u);
}

}  // namespace
}  // namespace vdbc
