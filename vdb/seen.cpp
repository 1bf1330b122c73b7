#include "vdb/seen.h"

#include <openvdb/tools/Prune.h>

#include <algorithm>

#include "vdb/error.h"
#include "vdb/frontier.h"

namespace vdbc {
namespace {

std::vector<Coord> sorted(std::vector<Coord> coords) {
  std::sort(coords.begin(), coords.end());
  return coords;
}

// Calls f(box of voxels) for every active value, tiles as they are.
template <typename Visit>
void forEachActiveBox(const TokenMask& mask, const CoordBBox& bounds, const Visit& visit) {
  for (auto v = mask.cbeginValueOn(); v; ++v) {
    CoordBBox box;
    v.getBoundingBox(box);
    box.intersect(bounds);
    if (!box.empty()) visit(box);
  }
}

}  // namespace

SeenSpace poolSeen(const SeenSpace& voxels, int level) {
  require(voxels.level == 0 && level >= 0 && level <= 10,  // counts of voxels fit 32 bits
          "poolSeen: expected voxels and a level of 0-10, found levels ", voxels.level, " and ",
          level);
  SeenSpace pooled;
  pooled.level = level;
  if (voxels.box.empty()) return pooled;
  pooled.box = nodesIn(voxels.box, level);
  forEachActiveBox(voxels.filled, voxels.box, [&](const CoordBBox& box) {
    pooled.filled.sparseFill(nodesIn(box, level), true, true);
  });

  // Tiles and nodes are aligned: a tile is nodes in whole, or it lies in one and counts there.
  TokenIndexTree count(0);
  openvdb::tree::ValueAccessor<TokenIndexTree> counts(count);
  forEachActiveBox(voxels.empty, voxels.box, [&](const CoordBBox& box) {
    const CoordBBox nodes = nodesIn(box, level);
    if (nodes.min() == nodes.max())
      counts.setValue(nodes.min(), counts.getValue(nodes.min()) + int32_t(box.volume()));
    else
      pooled.empty.sparseFill(nodes, true, true);
  });
  openvdb::tree::ValueAccessor<TokenMask> empty(pooled.empty);
  for (auto v = count.cbeginValueOn(); v; ++v) {
    CoordBBox box = voxelsIn(v.getCoord(), level);
    box.intersect(voxels.box);
    if (uint64_t(*v) == box.volume()) empty.setValueOn(v.getCoord());
  }
  pooled.empty.topologyDifference(pooled.filled);
  openvdb::tools::prune(pooled.empty);
  return pooled;
}

SeenSpace seenIn(const SeenSpace& space, const CoordBBox& nodes) {
  SeenSpace part;
  part.level = space.level, part.box = nodes;
  for (auto [to, from] : {std::pair<TokenMask*, const TokenMask*>{&part.filled, &space.filled},
                          {&part.empty, &space.empty}}) {
    // Not clip(), which loses tiles that the box cuts; and this takes time by the box alone.
    to->sparseFill(nodes, true, true);
    to->topologyIntersection(*from);
  }
  return part;
}

std::vector<Coord> filledNodes(const SeenSpace& space) {
  return sorted(activeCoords(space.filled));
}
std::vector<Coord> emptyNodes(const SeenSpace& space) { return sorted(activeCoords(space.empty)); }

std::vector<Coord> unobservedNodes(const SeenSpace& space, const CoordBBox& nodes) {
  const StateLookup state(space);
  std::vector<Coord> unobserved;
  for (auto node = nodes.begin(); node; ++node)
    if (state(*node) == NodeState::kUnobserved) unobserved.push_back(*node);
  return unobserved;
}

std::vector<Coord> emptyShell(const SeenSpace& space) {
  TokenMask known;
  known.topologyUnion(space.filled);
  known.topologyUnion(space.empty);
  std::vector<Coord> open;  // U next to what is known
  for (const Coord& node : neighbourRing(activeCoords(known)))
    if (space.box.isInside(node)) open.push_back(node);
  std::vector<Coord> shell;
  for (const Coord& node : neighbourRing(open))
    if (space.empty.isValueOn(node)) shell.push_back(node);
  return sorted(shell);
}

}  // namespace vdbc
