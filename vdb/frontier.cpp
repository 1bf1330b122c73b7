#include "vdb/frontier.h"

#include <openvdb/tools/Morphology.h>
#include <openvdb/tree/ValueAccessor.h>
#include <tbb/parallel_for.h>

#include "vdb/grid_instances.h"

namespace vdbc {
namespace {

// OpenVDB dilates leaves of 8^3 only (64-bit rows), hence the standard tree.
MaskTree standardMask(const std::vector<Coord>& tokens) {
  MaskTree mask;
  openvdb::tree::ValueAccessor<MaskTree> accessor(mask);
  for (const Coord& ijk : tokens) accessor.setValueOn(ijk);
  return mask;
}

void dilate(MaskTree& mask, Neighbours neighbours) {
  namespace tools = openvdb::tools;
  const auto shape = neighbours == Neighbours::kFaces6    ? tools::NN_FACE
                     : neighbours == Neighbours::kEdges18 ? tools::NN_FACE_EDGE
                                                          : tools::NN_FACE_EDGE_VERTEX;
  // The masks are made of voxels alone: no tiles to look after.
  tools::dilateActiveValues(mask, 1, shape, tools::IGNORE_TILES);
}

}  // namespace

std::vector<int32_t> breadthFirstLevels(const std::vector<Coord>& candidates,
                                        const std::vector<Coord>& seeds, Neighbours neighbours) {
  constexpr int32_t kUnreached = -1;
  TokenIndexTree level_of(kUnreached);
  openvdb::tree::ValueAccessor<TokenIndexTree> levels(level_of);

  MaskTree remaining = standardMask(candidates);
  MaskTree front = standardMask(seeds);
  for (const Coord& ijk : seeds) levels.setValue(ijk, 0);
  remaining.topologyDifference(front);
  int32_t reached = 0;
  while (true) {
    dilate(front, neighbours);
    front.topologyIntersection(remaining);
    if (front.activeVoxelCount() == 0) break;
    ++reached;
    for (auto leaf = front.cbeginLeaf(); leaf; ++leaf) {
      for (auto v = leaf->cbeginValueOn(); v; ++v) levels.setValue(v.getCoord(), reached);
    }
    remaining.topologyDifference(front);
  }

  std::vector<int32_t> result(candidates.size());
  tbb::parallel_for(tbb::blocked_range<size_t>(0, candidates.size(), 4096),
                    [&](const tbb::blocked_range<size_t>& range) {
                      openvdb::tree::ValueAccessor<const TokenIndexTree> look(level_of);
                      for (size_t i = range.begin(); i != range.end(); ++i) {
                        const int32_t level = look.getValue(candidates[i]);
                        result[i] = level == kUnreached ? reached + 1 : level;
                      }
                    });
  return result;
}

std::vector<Coord> neighbourRing(const std::vector<Coord>& tokens, Neighbours neighbours) {
  const MaskTree inside = standardMask(tokens);
  MaskTree ring(inside);
  dilate(ring, neighbours);
  ring.topologyDifference(inside);
  std::vector<Coord> coords;
  coords.reserve(size_t(ring.activeVoxelCount()));
  for (auto leaf = ring.cbeginLeaf(); leaf; ++leaf) {
    for (auto v = leaf->cbeginValueOn(); v; ++v) coords.push_back(v.getCoord());
  }
  return activeCoords(maskFromCoords(coords));
}

}  // namespace vdbc
