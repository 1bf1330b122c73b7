#include "vdb/point_leaves.h"

#include <tbb/parallel_for.h>
#include <tbb/parallel_sort.h>

#include "vdb/error.h"

namespace vdbc {
namespace {

// Bits of a leaf's coordinate relative to the first leaf, so that three and the 9 of a voxel's
// place in its leaf fit a key of 64.
constexpr int kLeafBits = 18;

struct Placed {
  uint64_t key;
  int64_t row;
  bool operator<(const Placed& other) const {
    return key != other.key ? key < other.key : row < other.row;
  }
};

}  // namespace

PointLayout layOutPoints(const std::vector<openvdb::Coord>& voxels,
                         const openvdb::NamePair& position) {
  PointLayout layout;
  layout.tree = std::make_shared<PointTree>();
  if (voxels.empty()) return layout;
  openvdb::Coord low = voxels[0], high = voxels[0];
  for (const openvdb::Coord& ijk : voxels) low.minComponent(ijk), high.maxComponent(ijk);
  for (int k = 0; k < 3; ++k) {
    require((int64_t(high[k]) >> 3) - (low[k] >> 3) < int64_t(1) << kLeafBits,
            "layOutPoints: points from ", low, " to ", high, " (expected an extent below 2^20)");
  }
  std::vector<Placed> placed(voxels.size());
  tbb::parallel_for(size_t(0), voxels.size(), [&](size_t i) {
    uint64_t leaf = 0;
    for (int k = 0; k < 3; ++k)
      leaf = leaf << kLeafBits | uint64_t((voxels[i][k] >> 3) - (low[k] >> 3));
    placed[i] = {leaf << 9 | PointLeaf::coordToOffset(voxels[i]), int64_t(i)};
  });
  tbb::parallel_sort(placed.begin(), placed.end());

  layout.rows.resize(placed.size());
  for (size_t i = 0; i < placed.size(); ++i) layout.rows[i] = placed[i].row;
  for (size_t begin = 0, end = 0; begin < placed.size(); begin = end) {
    while (end < placed.size() && placed[end].key >> 9 == placed[begin].key >> 9) ++end;
    layout.leaves.push_back(
        {layout.tree->touchLeaf(voxels[size_t(placed[begin].row)]), begin, end});
  }
  const auto descriptor = openvdb::points::AttributeSet::Descriptor::create(position);
  tbb::parallel_for(size_t(0), layout.leaves.size(), [&](size_t l) {
    const LeafRows& range = layout.leaves[l];
    std::vector<PointLeaf::ValueType> offsets(PointLeaf::SIZE);  // end of each voxel's points
    size_t next = range.begin;
    for (size_t v = 0; v < offsets.size(); ++v) {
      while (next < range.end && (placed[next].key & 511) == v) ++next;
      offsets[v] = openvdb::PointDataIndex32(uint32_t(next - range.begin));
    }
    range.leaf->setOffsets(offsets);
    range.leaf->initializeAttributes(descriptor, openvdb::Index(range.end - range.begin));
  });
  return layout;
}

size_t checkedPointCount(const char* operation, const PointLeaf& leaf, const std::string& path) {
  leaf.validateOffsets();
  const size_t points = size_t(leaf.getLastValue());
  const auto& attributes = leaf.attributeSet();
  for (size_t a = 0; a < attributes.size(); ++a) {
    require(attributes.getConst(a)->size() >= points, operation, ": ", path,
            ": corrupt: a leaf has ", points, " points but ", attributes.getConst(a)->size(),
            " values of an attribute");
  }
  return points;
}

}  // namespace vdbc
