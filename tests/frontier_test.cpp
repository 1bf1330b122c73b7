#include "vdb/frontier.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <map>
#include <queue>
#include <random>
#include <set>

namespace vdbc {
namespace {

const Neighbours kAll[] = {Neighbours::kFaces6, Neighbours::kEdges18, Neighbours::kCorners26};

std::vector<Coord> offsets(Neighbours neighbours) {
  const int most = neighbours == Neighbours::kFaces6    ? 1
                   : neighbours == Neighbours::kEdges18 ? 2
                                                        : 3;
  std::vector<Coord> result;
  for (int x = -1; x <= 1; ++x) {
    for (int y = -1; y <= 1; ++y) {
      for (int z = -1; z <= 1; ++z) {
        const int n = std::abs(x) + std::abs(y) + std::abs(z);
        if (n > 0 && n <= most) result.emplace_back(x, y, z);
      }
    }
  }
  return result;
}

// The serial truth: one queue, one map.
std::vector<int32_t> serialLevels(const std::vector<Coord>& candidates,
                                  const std::vector<Coord>& seeds, Neighbours neighbours) {
  const std::set<Coord> open(candidates.begin(), candidates.end());
  std::map<Coord, int32_t> level;
  std::queue<Coord> queue;
  for (const Coord& s : seeds) {
    if (level.emplace(s, 0).second) queue.push(s);
  }
  int32_t deepest = 0;
  while (!queue.empty()) {
    const Coord c = queue.front();
    queue.pop();
    for (const Coord& o : offsets(neighbours)) {
      const Coord n = c + o;
      if (open.count(n) && level.emplace(n, level[c] + 1).second) {
        deepest = std::max(deepest, level[n]);
        queue.push(n);
      }
    }
  }
  std::vector<int32_t> result;
  for (const Coord& c : candidates) result.push_back(level.count(c) ? level[c] : deepest + 1);
  return result;
}

std::vector<Coord> randomTokens(std::mt19937& rng, int count, int extent) {
  std::vector<Coord> tokens;
  for (int i = 0; i < count; ++i) {
    const auto pick = [&] { return int(rng() % unsigned(2 * extent)) - extent; };
    tokens.emplace_back(pick(), pick(), pick());
  }
  return tokens;
}

TEST(Frontier, OffsetsNumberAsNamed) {
  for (const Neighbours n : kAll) EXPECT_EQ(offsets(n).size(), size_t(n));
}

TEST(Frontier, LevelsEqualASerialSearch) {
  std::mt19937 rng(3);
  // From nearly full to mostly disconnected, across leaf and node borders of negative coordinates.
  for (const int count : {200, 1000, 3000, 8000}) {
    for (const Neighbours n : kAll) {
      const std::vector<Coord> candidates = randomTokens(rng, count, 10);
      const std::vector<Coord> seeds = randomTokens(rng, 3, 12);
      EXPECT_EQ(breadthFirstLevels(candidates, seeds, n), serialLevels(candidates, seeds, n))
          << count << " candidates, " << int(n) << " neighbours";
    }
  }
}

TEST(Frontier, LevelsFollowAMaze) {
  // A long thin corridor of face steps: depth equals its length for every kind of neighbour that
  // cannot cut its corners.
  std::vector<Coord> corridor;
  for (int x = 1; x <= 300; ++x) corridor.emplace_back(x, 0, 0);
  for (int y = 1; y <= 40; ++y) corridor.emplace_back(300, y, 0);
  for (const Neighbours n : kAll) {
    const std::vector<int32_t> levels = breadthFirstLevels(corridor, {Coord(0, 0, 0)}, n);
    EXPECT_EQ(levels, serialLevels(corridor, {Coord(0, 0, 0)}, n));
    EXPECT_EQ(levels.back(), n == Neighbours::kFaces6 ? 340 : 339);
  }
}

TEST(Frontier, NothingUnreachedIsForgotten) {
  const std::vector<Coord> candidates = {{1, 0, 0}, {2, 0, 0}, {50, 0, 0}, {90, 9, 9}, {1, 0, 0}};
  EXPECT_EQ(breadthFirstLevels(candidates, {Coord(0, 0, 0)}),
            (std::vector<int32_t>{1, 2, 3, 3, 1}));
  EXPECT_EQ(breadthFirstLevels(candidates, {}), (std::vector<int32_t>(5, 1)));
  EXPECT_TRUE(breadthFirstLevels({}, {Coord(0, 0, 0)}).empty());
}

TEST(Frontier, SeedsAmongCandidatesAreLevelZero) {
  EXPECT_EQ(breadthFirstLevels({{0, 0, 0}, {1, 0, 0}, {2, 0, 0}}, {Coord(1, 0, 0)}),
            (std::vector<int32_t>{1, 0, 1}));
}

TEST(Frontier, AdjacencyIsSymmetric) {
  for (const Neighbours n : kAll) {
    for (const Coord& o : offsets(Neighbours::kCorners26)) {
      const Coord a(-1, 7, 8), b = a + o;
      EXPECT_EQ(breadthFirstLevels({a, Coord(99, 0, 0)}, {b}, n),
                breadthFirstLevels({b, Coord(99, 0, 0)}, {a}, n));
    }
  }
}

TEST(Frontier, RingEqualsBruteForce) {
  std::mt19937 rng(8);
  for (const Neighbours n : kAll) {
    const std::vector<Coord> tokens = randomTokens(rng, 500, 12);
    const std::set<Coord> inside(tokens.begin(), tokens.end());
    std::set<Coord> expected;
    for (const Coord& t : tokens) {
      for (const Coord& o : offsets(n)) {
        if (!inside.count(t + o)) expected.insert(t + o);
      }
    }
    const std::vector<Coord> ring = neighbourRing(tokens, n);
    EXPECT_EQ(ring.size(), expected.size());
    EXPECT_EQ(std::set<Coord>(ring.begin(), ring.end()), expected);
    EXPECT_EQ(ring, activeCoords(maskFromCoords(ring)));
  }
  EXPECT_TRUE(neighbourRing({}).empty());
}

}  // namespace
}  // namespace vdbc
