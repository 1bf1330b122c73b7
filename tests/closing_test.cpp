// Holes are closed by the cheapest tokens (docs/method.md, section 4.10), against every choice of
// them.
#include "mar/closing.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <random>
#include <set>
#include <utility>

namespace vdbc {
namespace {

// --- scenes as pictures -------------------------------------------------------------------------

// What a node is: seen filled, seen empty, unobserved and open, there (generated), dropped.
enum Cell : char { kWall = '#', kSeen = '.', kOpen = ' ', kThere = '+', kDropped = '?' };

struct Scene {
  CoordBBox box;
  std::vector<char> cells;                      // x slowest
  std::vector<std::pair<Coord, float>> tokens;  // the dropped ones, in any order

  explicit Scene(const CoordBBox& b) : box(b), cells(size_t(b.volume()), kOpen) {}
  size_t index(const Coord& c) const {
    const Coord d = box.dim(), r = c - box.min();
    return (size_t(r.x()) * size_t(d.y()) + size_t(r.y())) * size_t(d.z()) + size_t(r.z());
  }
  char& operator[](const Coord& c) { return cells[index(c)]; }
  char operator[](const Coord& c) const { return cells[index(c)]; }
};

/// Makes some of the nodes dropped tokens, at most `most`.
void drop(Scene* scene, std::vector<Coord> nodes, size_t most, std::mt19937& random) {
  std::shuffle(nodes.begin(), nodes.end(), random);
  std::uniform_real_distribution<float> chance(.05f, .95f);
  for (size_t i = 0; i < std::min(most, nodes.size()); ++i) {
    (*scene)[nodes[i]] = kDropped;
    scene->tokens.push_back({nodes[i], chance(random)});
  }
}

std::set<Coord> closed(const Scene& scene, float least) {
  SeenSpace nodes;
  nodes.level = 1, nodes.box = scene.box;
  std::vector<Coord> there;
  for (auto c = scene.box.begin(); c; ++c) {
    if (scene[*c] == kWall) nodes.filled.setValueOn(*c);
    if (scene[*c] == kSeen) nodes.empty.setValueOn(*c);
    if (scene[*c] == kThere) there.push_back(*c);
  }
  Place dropped;
  for (const auto& [c, probability] : scene.tokens) {
    dropped.ijk.push_back(c), dropped.probability.push_back(probability);
    dropped.bfs_level.push_back(1), dropped.generated.push_back(1);
  }
  const std::vector<int64_t> rows = closingTokens(nodes, there, dropped, least);
  std::set<Coord> tokens;
  std::vector<Coord> in_order;
  for (int64_t row : rows) {
    tokens.insert(dropped.ijk[size_t(row)]), in_order.push_back(dropped.ijk[size_t(row)]);
    EXPECT_GT(dropped.probability[size_t(row)], least);
  }
  EXPECT_TRUE(std::is_sorted(in_order.begin(), in_order.end()));
  EXPECT_EQ(tokens.size(), rows.size());
  return tokens;
}

// --- the truth: a flood through every node, for every subset ------------------------------------

/// Nodes by number, their neighbours through faces (-1: beyond the border).
std::vector<std::array<int, 6>> neighboursOf(const Scene& scene) {
  std::vector<std::array<int, 6>> all(scene.cells.size());
  for (auto c = scene.box.begin(); c; ++c)
    for (int k = 0; k < 6; ++k) {
      Coord next = *c;
      next[k / 2] += k % 2 ? 1 : -1;
      all[scene.index(*c)][size_t(k)] = scene.box.isInside(next) ? int(scene.index(next)) : -1;
    }
  return all;
}

/// Which open nodes are open for good: a path through open nodes leads them out of the volume.
std::vector<char> outsideOf(const Scene& scene, const std::vector<std::array<int, 6>>& next) {
  std::vector<char> outside(scene.cells.size(), 0);
  for (bool more = true; more;) {
    more = false;
    for (size_t i = 0; i < outside.size(); ++i) {
      if (scene.cells[i] != kOpen || outside[i]) continue;
      for (int n : next[i])
        if (n < 0 || outside[size_t(n)]) outside[i] = 1, more = true;
    }
  }
  return outside;
}

/// The cheapest subset of the dropped tokens through which nothing leaks: no path from the seen
/// empty nodes to the outside has a dropped token that is not in it. (Paths without dropped tokens
/// cannot be closed and do not count.)
std::set<Coord> cheapest(const Scene& scene) {
  const auto next = neighboursOf(scene);
  const std::vector<char> outside = outsideOf(scene, next);
  const size_t n = scene.tokens.size();
  std::vector<int> token(scene.cells.size(), -1);
  for (size_t i = 0; i < n; ++i) token[scene.index(scene.tokens[i].first)] = int(i);
  std::vector<size_t> queue, starts;
  for (size_t i = 0; i < scene.cells.size(); ++i)
    if (scene.cells[i] == kSeen) starts.push_back(i);
  const auto leaks = [&](size_t subset) {
    std::vector<char> reached(scene.cells.size(), 0);
    queue = starts;
    for (size_t at = 0; at < queue.size(); ++at) {
      const size_t i = queue[at];
      for (int other : next[i]) {
        if (other < 0 || outside[size_t(other)]) {
          if (scene.cells[i] == kDropped) return true;
          continue;  // from seen empty straight to the outside
        }
        const size_t o = size_t(other);
        const char cell = scene.cells[o];
        const bool shut = cell == kWall || cell == kThere || cell == kSeen ||
                          (token[o] >= 0 && subset >> token[o] & 1);
        if (!shut && !reached[o]) reached[o] = 1, queue.push_back(o);
      }
    }
    return false;
  };
  double best = 1e30;
  size_t best_subset = 0;
  for (size_t subset = 0; subset < size_t(1) << n; ++subset) {
    double cost = 0;
    for (size_t i = 0; i < n; ++i)
      if (subset >> i & 1) cost -= std::log(double(scene.tokens[i].second));
    if (cost < best && !leaks(subset)) best = cost, best_subset = subset;
  }
  std::set<Coord> chosen;
  for (size_t i = 0; i < n; ++i)
    if (best_subset >> i & 1) chosen.insert(scene.tokens[i].first);
  return chosen;
}

/// Whether the completer closes what every-subset does. Returns how many tokens that is.
size_t expectCheapest(const Scene& scene) {
  const std::set<Coord> truth = cheapest(scene);
  EXPECT_EQ(closed(scene, 0), truth);
  float likeliest = 0;
  std::set<Coord> likely;
  for (const auto& [c, probability] : scene.tokens) {
    if (!truth.count(c)) continue;
    likeliest = std::max(likeliest, probability);
    if (probability > .4f) likely.insert(c);
  }
  EXPECT_EQ(closed(scene, .4f), likely);
  EXPECT_TRUE(closed(scene, likeliest).empty());
  return truth.size();
}

bool isShell(const CoordBBox& box, const Coord& c) {
  if (!box.isInside(c)) return false;
  for (int axis = 0; axis < 3; ++axis)
    if (c[axis] == box.min()[axis] || c[axis] == box.max()[axis]) return true;
  return false;
}

std::vector<Coord> nodesOf(const CoordBBox& box) {
  std::vector<Coord> nodes;
  for (auto c = box.begin(); c; ++c) nodes.push_back(*c);
  return nodes;
}

// --- laws ---------------------------------------------------------------------------------------

TEST(ClosingTokens, OneSeenNodeAmongWallsWithHoles) {
  std::mt19937 random(3);
  size_t found = 0;
  for (int trial = 0; trial < 40; ++trial) {
    SCOPED_TRACE(trial);
    Scene scene(CoordBBox(Coord(0), Coord(4)));
    scene[Coord(2)] = kSeen;
    std::vector<Coord> holes;
    for (const Coord& c : nodesOf(CoordBBox(Coord(1), Coord(3)))) {
      if (c == Coord(2)) continue;
      scene[c] = trial % 2 ? kWall : kThere;
      if (random() % 3 == 0) holes.push_back(c);
    }
    drop(&scene, holes, 9, random);
    // Other ways to close the same holes, one node further out.
    std::vector<Coord> outer;
    for (const auto& token : scene.tokens) {
      Coord c = token.first;
      for (int axis = 0; axis < 3; ++axis)
        if (c[axis] != 2) {
          c[axis] += c[axis] - 2;
          break;
        }
      if (scene[c] == kOpen) outer.push_back(c);
    }
    std::sort(outer.begin(), outer.end());
    outer.erase(std::unique(outer.begin(), outer.end()), outer.end());
    drop(&scene, outer, 2, random);
    found += expectCheapest(scene) > 0;
  }
  EXPECT_GT(found, 20u);
}

TEST(ClosingTokens, AnyScene) {
  std::mt19937 random(4);
  size_t found = 0;
  for (int trial = 0; trial < 400; ++trial) {
    SCOPED_TRACE(trial);
    const auto side = [&] { return 1 + int(random() % 5); };
    const Coord low(int(random() % 9) - 5, int(random() % 9) - 5, int(random() % 9) - 5);
    Scene scene(CoordBBox(low, low + Coord(side() + 1, side(), side())));
    std::vector<Coord> nodes = nodesOf(scene.box);
    // Mostly closed to mostly open.
    const unsigned open = unsigned(random() % 5);
    for (const Coord& c : nodes) {
      const unsigned kind = unsigned(random() % 10);
      scene[c] = kind < open ? kOpen : kind < 6 ? kWall : kind < 8 ? kSeen : kThere;
    }
    drop(&scene, nodes, 10, random);
    found += expectCheapest(scene) > 0;
  }
  EXPECT_GT(found, 150u);
}

TEST(ClosingTokens, ThingsThatFloatInClosedPocketsAndInTheOpen) {
  // Walls around open space in which something was seen empty; in the open space inside and outside
  // of the walls stand things. Holes in the walls lead through all of it.
  std::mt19937 random(5);
  size_t found = 0;
  for (int trial = 0; trial < 60; ++trial) {
    SCOPED_TRACE(trial);
    Scene scene(CoordBBox(Coord(0), Coord(10, 8, 8)));
    const CoordBBox room(Coord(1), Coord(9, 7, 7));
    std::vector<Coord> walls;
    for (const Coord& c : nodesOf(room))
      if (isShell(room, c)) scene[c] = kWall, walls.push_back(c);
    // Islands, hollow or not, and the seen space, near the walls or away from them.
    for (int i = 0; i < 3; ++i) {
      const Coord at(2 + int(random() % 7), 2 + int(random() % 5), 2 + int(random() % 5));
      const int r = int(random() % 2);
      for (const Coord& c : nodesOf(CoordBBox(at.offsetBy(-r), at.offsetBy(r))))
        if (room.isInside(c) && !isShell(room, c))
          scene[c] = i == 0 ? kSeen : random() % 4 && c == at ? kOpen : kWall;
    }
    for (int i = 0; i < 4; ++i) {  // outside
      const Coord c(int(random() % 11), int(random() % 9), int(random() % 9));
      if (!room.isInside(c)) scene[c] = kThere;
    }
    // Holes, some two deep.
    std::vector<Coord> holes;
    for (int i = 0; i < 4; ++i) {
      const Coord c = walls[random() % walls.size()];
      holes.push_back(c);
      if (random() % 2) {
        Coord inner = c;
        for (int axis = 0; axis < 3; ++axis)
          if (c[axis] == room.min()[axis] || c[axis] == room.max()[axis]) {
            inner[axis] += c[axis] == room.min()[axis] ? 1 : -1;
            break;
          }
        if (scene[inner] == kOpen) holes.push_back(inner);
      }
    }
    std::sort(holes.begin(), holes.end());
    holes.erase(std::unique(holes.begin(), holes.end()), holes.end());
    drop(&scene, holes, 8, random);
    found += expectCheapest(scene) > 0;
  }
  EXPECT_GT(found, 40u);
}

TEST(ClosingTokens, RoomsWithinRooms) {
  // Shells around each other, open space between them: the seen space is in the innermost.
  std::mt19937 random(6);
  size_t found = 0;
  for (int trial = 0; trial < 30; ++trial) {
    SCOPED_TRACE(trial);
    Scene scene(CoordBBox(Coord(-6), Coord(6)));
    scene[Coord(0)] = kSeen;
    for (int r : {1, 3, 5}) {
      const CoordBBox room(Coord(-r), Coord(r));
      std::vector<Coord> faces;  // without edges, through which nothing leaks
      for (const Coord& c : nodesOf(room)) {
        if (!isShell(room, c)) continue;
        scene[c] = kWall;
        if ((std::abs(c.x()) == r) + (std::abs(c.y()) == r) + (std::abs(c.z()) == r) == 1)
          faces.push_back(c);
      }
      drop(&scene, faces, 1 + random() % 3, random);
    }
    found += expectCheapest(scene) > 0;
  }
  EXPECT_EQ(found, 30u);
}

TEST(ClosingTokens, SheetsThatCutTheVolumeInTwo) {
  std::mt19937 random(7);
  size_t found = 0;
  for (int trial = 0; trial < 60; ++trial) {
    SCOPED_TRACE(trial);
    const int axis = trial % 3;
    Scene scene(CoordBBox(Coord(0), Coord(7, 7, 7)));
    std::vector<Coord> sheet;
    const bool pocket = trial % 2;  // a second sheet, and a closed layer between them
    for (const Coord& c : nodesOf(scene.box)) {
      if (c[axis] < 2) scene[c] = kSeen;
      if (c[axis] == 2 + trial % 4 / 2 || (pocket && c[axis] == 5)) {
        scene[c] = kWall;
        sheet.push_back(c);
      } else if (pocket && c[axis] > 2 && c[axis] < 5 && isShell(scene.box, c)) {
        scene[c] = kWall;
      }
    }
    drop(&scene, sheet, 8, random);
    found += expectCheapest(scene) > 0;
  }
  EXPECT_GT(found, 20u);
}

TEST(ClosingTokens, WhatCannotBeClosedIsClosedAsFarAsItCan) {
  // A tunnel of seen empty nodes with two mouths: one has a dropped token in it, one has none.
  Scene scene(CoordBBox(Coord(0), Coord(8, 2, 2)));
  for (const Coord& c : nodesOf(scene.box)) {
    const bool inside = c.y() == 1 && c.z() == 1;
    scene[c] = !inside ? kThere : c.x() >= 2 && c.x() <= 6 ? kSeen : kOpen;
  }
  EXPECT_TRUE(closed(scene, 0).empty());
  const Coord mouth(1, 1, 1);
  scene[mouth] = kDropped;
  scene.tokens = {{mouth, .2f}};
  EXPECT_EQ(closed(scene, .1f), std::set<Coord>{mouth});
  EXPECT_TRUE(closed(scene, .3f).empty());
}

TEST(ClosingTokens, OnlyUnobservedTokensOfTheVolumeCanClose) {
  Scene scene(CoordBBox(Coord(0), Coord(4)));
  for (const Coord& c : nodesOf(CoordBBox(Coord(1), Coord(3)))) scene[c] = kWall;
  scene[Coord(2)] = kSeen, scene[Coord(2, 2, 1)] = kDropped, scene[Coord(1)] = kThere;
  scene.tokens = {{Coord(2, 2, 1), .3f}, {Coord(2, 2, 1), .3f}};  // twice
  for (const Coord& c : {Coord(2), Coord(2, 2, 3), Coord(1), Coord(2, 2, -1)})
    scene.tokens.push_back({c, .99f});  // seen empty, seen filled, there, outside
  EXPECT_EQ(closed(scene, 0), std::set<Coord>{Coord(2, 2, 1)});
}

TEST(ClosingTokens, ALargeHoleStaysOpen) {
  // A box of walls without one of them: 10 x 10 tokens close it, 10 x 11 are too many.
  for (int height : {10, 11}) {
    SeenSpace nodes;
    nodes.level = 1, nodes.box = CoordBBox(Coord(0), Coord(15));
    std::vector<Coord> walls;
    Place dropped;
    for (const Coord& c : nodesOf(CoordBBox(Coord(1), Coord(6, 12, 2 + height)))) {
      const bool inside =
          c.x() > 1 && c.x() < 6 && c.y() > 1 && c.y() < 12 && c.z() > 1 && c.z() < 2 + height;
      const bool missing = c.x() == 6 && c.y() > 1 && c.y() < 12 && c.z() > 1 && c.z() < 2 + height;
      if (missing)
        dropped.ijk.push_back(c), dropped.probability.push_back(.4f);
      else if (inside)
        nodes.empty.setValueOn(c);
      else
        walls.push_back(c);
    }
    dropped.bfs_level.assign(dropped.ijk.size(), 1);
    dropped.generated.assign(dropped.ijk.size(), 1);
    EXPECT_EQ(closingTokens(nodes, walls, dropped, .1f).size(), height == 10 ? 100u : 0u);
  }
}

TEST(ClosingTokens, NothingClosesWherePeopleStand) {
  // A corridor along x that ends in the open, seen in its middle: doors at its end and, likelier,
  // behind the camera.
  SeenSpace nodes;
  nodes.level = 1, nodes.box = CoordBBox(Coord(0), Coord(12, 4, 4));
  std::vector<Coord> walls;
  for (const Coord& c : nodesOf(CoordBBox(Coord(1, 1, 1), Coord(12, 3, 3))))
    if (c.x() == 1 || c.y() != 2 || c.z() != 2) walls.push_back(c);
  nodes.empty.setValueOn(Coord(2, 2, 2));
  Place dropped;
  dropped.frame.voxel_m = .1f;  // nodes of .2 m
  dropped.ijk = {Coord(4, 2, 2), Coord(8, 2, 2)};
  dropped.probability = {.9f, .3f};
  dropped.bfs_level.assign(2, 1), dropped.generated.assign(2, 1);
  EXPECT_EQ(closingTokens(nodes, walls, dropped, 0), std::vector<int64_t>{0});
  Camera camera;
  camera.world_from_camera.translation() = dropped.frame.toWorld({5, 5, 5});  // .4 m away
  dropped.cameras.push_back(camera);
  EXPECT_EQ(closingTokens(nodes, walls, dropped, 0), std::vector<int64_t>{1});
}

TEST(ClosingTokens, TimeFollowsTheTokensAndNotTheVolume) {
  // A room in the middle of 10^15 nodes, and a thing far away.
  SeenSpace nodes;
  nodes.level = 1, nodes.box = CoordBBox(Coord(-50000), Coord(50000));
  std::vector<Coord> walls;
  for (const Coord& c : nodesOf(CoordBBox(Coord(1), Coord(3))))
    if (c != Coord(2) && c != Coord(2, 2, 1)) walls.push_back(c);
  nodes.empty.setValueOn(Coord(2));
  walls.push_back(Coord(40000, 2, 2));
  Place dropped;
  dropped.ijk = {Coord(2, 2, 1), Coord(39999, 2, 2)};
  dropped.probability = {.3f, .3f};
  dropped.bfs_level.assign(2, 1), dropped.generated.assign(2, 1);
  EXPECT_EQ(closingTokens(nodes, walls, dropped, 0), std::vector<int64_t>{0});
}

}  // namespace
}  // namespace vdbc
