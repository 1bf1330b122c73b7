#include "vdb/narrow_band.h"

#include <openvdb/tools/SignedFloodFill.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

#include "vdb/token_map.h"

namespace vdbc {
namespace {

using Leaf = FloatTree::LeafNodeType;

constexpr int kDim = int(Leaf::DIM), kSize = int(Leaf::SIZE);
constexpr int kNone = -1;
constexpr std::array<int, 3> kStride = {kDim * kDim, kDim, 1};  // of the axes in a leaf

// The leaves in the tree's order, with those at their faces: below and above along each axis.
struct Leaves {
  explicit Leaves(FloatTree* tree) {
    tree->getNodes(all);
    TokenMap<int> rows;
    for (const Leaf* leaf : all)
      rows.insert(leaf->origin() >> int(Leaf::LOG2DIM), int(rows.size()));
    beside.resize(all.size());
    tbb::parallel_for(size_t(0), all.size(), [&](size_t i) {
      for (int axis = 0; axis < 3; ++axis)
        for (int side : {0, 1}) {
          Coord place = all[i]->origin() >> int(Leaf::LOG2DIM);
          place[axis] += 2 * side - 1;
          const int* row = rows.find(place);
          beside[i][size_t(2 * axis + side)] = row ? *row : kNone;
        }
    });
  }

  std::vector<Leaf*> all;
  std::vector<std::array<int, 6>> beside;
};

// --- parts --------------------------------------------------------------------------------------

// Connected negative voxels: of one leaf at first, then of all that `parent` leads to.
struct Part {
  CoordBBox box;
  bool is_kept = false;
  size_t parent = 0;
};
using Labels = std::array<int16_t, Leaf::SIZE>;  // of the leaf's parts

std::vector<Part> partsOfLeaf(const Leaf& leaf, const std::function<bool(const Coord&)>& kept,
                              Labels* labels) {
  std::vector<Part> parts;
  std::vector<int> open;
  labels->fill(kNone);
  const auto reach = [&](int n) {
    if ((*labels)[size_t(n)] != kNone || !(leaf.getValue(openvdb::Index(n)) < 0)) return;
    (*labels)[size_t(n)] = int16_t(parts.size() - 1);
    open.push_back(n);
  };
  for (int first = 0; first < kSize; ++first) {
    if ((*labels)[size_t(first)] != kNone || !(leaf.getValue(openvdb::Index(first)) < 0)) continue;
    parts.emplace_back();
    reach(first);
    while (!open.empty()) {
      const int n = open.back();
      open.pop_back();
      const Coord local = Leaf::offsetToLocalCoord(openvdb::Index(n)), ijk = local + leaf.origin();
      parts.back().box.expand(ijk);
      parts.back().is_kept = parts.back().is_kept || kept(ijk);
      for (int axis = 0; axis < 3; ++axis) {
        if (local[axis] > 0) reach(n - kStride[size_t(axis)]);
        if (local[axis] < kDim - 1) reach(n + kStride[size_t(axis)]);
      }
    }
  }
  return parts;
}

size_t rootOf(std::vector<Part>* parts, size_t i) {
  while ((*parts)[i].parent != i) i = (*parts)[i].parent = (*parts)[(*parts)[i].parent].parent;
  return i;
}

void join(std::vector<Part>* parts, size_t a, size_t b) {
  a = rootOf(parts, a), b = rootOf(parts, b);
  if (a == b) return;
  Part &to = (*parts)[std::min(a, b)], &from = (*parts)[std::max(a, b)];
  from.parent = std::min(a, b);
  to.box.expand(from.box);
  to.is_kept = to.is_kept || from.is_kept;
}

// --- distances ----------------------------------------------------------------------------------

constexpr float kFar = 1e6f;     // voxels: not known yet
constexpr int kSide = kDim + 2;  // of a block: a leaf and the voxels at its faces
constexpr std::array<int, 3> kStep = {kSide * kSide, kSide, 1};
using Values = std::array<float, Leaf::SIZE>;
using Block = std::array<float, kSide * kSide * kSide>;

int inBlock(int n) {
  const Coord c = Leaf::offsetToLocalCoord(openvdb::Index(n));
  return (c.x() + 1) * kStep[0] + (c.y() + 1) * kStep[1] + c.z() + 1;
}

// Values of a leaf and those at its faces; `none` where there is no leaf.
Block blockOf(const std::vector<Values>& values, const Leaves& leaves, size_t i, float none) {
  Block block;
  for (int n = 0; n < kSize; ++n) block[size_t(inBlock(n))] = values[i][size_t(n)];
  for (size_t axis = 0; axis < 3; ++axis)
    for (size_t side : {0, 1}) {
      const int row = leaves.beside[i][2 * axis + side];
      const int stride = kStride[axis], from = side ? 0 : (kDim - 1) * stride;
      const int outward = side ? kStep[axis] : -kStep[axis];
      const int face = side ? (kDim - 1) * stride : 0;
      const int u = kStride[(axis + 1) % 3], v = kStride[(axis + 2) % 3];
      for (int a = 0; a < kDim; ++a)
        for (int b = 0; b < kDim; ++b) {
          const int at = a * u + b * v;
          block[size_t(inBlock(face + at) + outward)] =
              row == kNone ? none : values[size_t(row)][size_t(from + at)];
        }
    }
  return block;
}

// Voxels from where the value crosses 0, taken as a plane; far where no neighbour's sign differs.
float distanceToCrossing(const float* here) {
  float inverse2 = 0;
  for (int step : kStep) {
    float least = kFar;
    for (float beside : {here[-step], here[step]})
      if ((beside < 0) != (*here < 0)) least = std::min(least, *here / (*here - beside));
    if (least < kFar) inverse2 += 1 / std::max(least * least, 1e-12f);
  }
  return inverse2 > 0 ? 1 / std::sqrt(inverse2) : kFar;
}

// The distance whose upwind slope is 1, from the lower neighbour along each axis.
float upwindDistance(float a, float b, float c) {
  if (a > b) std::swap(a, b);
  if (b > c) std::swap(b, c);
  if (a > b) std::swap(a, b);
  if (a + 1 <= b) return a + 1;
  const float two = (a + b + std::sqrt(2 - (a - b) * (a - b))) / 2;
  if (two <= c) return two;
  const float sum = a + b + c;
  return (sum + std::sqrt(std::max(0.f, sum * sum - 3 * (a * a + b * b + c * c - 1)))) / 3;
}

// Each voxel that is not beside the surface, from its neighbours as they were.
void sweep(const std::vector<Values>& first, const std::vector<Values>& before, float half_width,
           const Leaves& leaves, std::vector<Values>* after) {
  tbb::parallel_for(size_t(0), before.size(), [&](size_t i) {
    const Block block = blockOf(before, leaves, i, kFar);
    (*after)[i] = before[i];
    if (*std::min_element(block.begin(), block.end()) >= half_width) return;
    for (int n = 0; n < kSize; ++n) {
      if (first[i][size_t(n)] < kFar) continue;
      const float* here = &block[size_t(inBlock(n))];
      std::array<float, 3> lower;
      for (size_t axis = 0; axis < 3; ++axis)
        lower[axis] = std::min(here[-kStep[axis]], here[kStep[axis]]);
      if (std::min({lower[0], lower[1], lower[2]}) < half_width)
        (*after)[i][size_t(n)] = std::min(*here, upwindDistance(lower[0], lower[1], lower[2]));
    }
  });
}

}  // namespace

int64_t dropSmallParts(int least_voxels, const std::function<bool(const Coord&)>& kept,
                       FloatTree* tree) {
  const Leaves leaves(tree);
  std::vector<Labels> labels(leaves.all.size());
  std::vector<std::vector<Part>> of_leaf(leaves.all.size());
  tbb::parallel_for(size_t(0), of_leaf.size(),
                    [&](size_t i) { of_leaf[i] = partsOfLeaf(*leaves.all[i], kept, &labels[i]); });
  std::vector<Part> parts;
  std::vector<size_t> first;  // of each leaf, in `parts`
  for (const std::vector<Part>& some : of_leaf) {
    first.push_back(parts.size());
    parts.insert(parts.end(), some.begin(), some.end());
  }
  for (size_t i = 0; i < parts.size(); ++i) parts[i].parent = i;
  for (size_t i = 0; i < leaves.all.size(); ++i)
    for (size_t axis = 0; axis < 3; ++axis) {
      const int above = leaves.beside[i][2 * axis + 1];
      if (above == kNone) continue;
      const int u = kStride[(axis + 1) % 3], v = kStride[(axis + 2) % 3];
      for (int a = 0; a < kDim; ++a)
        for (int b = 0; b < kDim; ++b) {
          const int at = a * u + b * v;
          const int here = labels[i][size_t(at + (kDim - 1) * kStride[axis])],
                    there = labels[size_t(above)][size_t(at)];
          if (here != kNone && there != kNone)
            join(&parts, first[i] + size_t(here), first[size_t(above)] + size_t(there));
        }
    }
  const auto isDropped = [&](size_t root) {
    const Coord dim = parts[root].box.dim();
    return !parts[root].is_kept && std::max({dim.x(), dim.y(), dim.z()}) < least_voxels;
  };
  int64_t dropped = 0;
  for (size_t i = 0; i < parts.size(); ++i) {
    const size_t root = rootOf(&parts, i);
    dropped += root == i && isDropped(i);
  }
  for (size_t i = 0; i < leaves.all.size(); ++i)
    for (int n = 0; n < kSize; ++n)
      if (labels[i][size_t(n)] != kNone &&
          isDropped(rootOf(&parts, first[i] + size_t(labels[i][size_t(n)]))))
        leaves.all[i]->setValueOnly(openvdb::Index(n), tree->background());
  return dropped;
}

void solveDistances(float voxel, int half_width, FloatTree* tree) {
  const Leaves leaves(tree);
  const size_t count = leaves.all.size();
  std::vector<Values> values(count), first(count);
  tbb::parallel_for(size_t(0), count, [&](size_t i) {
    for (int n = 0; n < kSize; ++n)
      values[i][size_t(n)] = leaves.all[i]->getValue(openvdb::Index(n));
  });
  tbb::parallel_for(size_t(0), count, [&](size_t i) {
    const Block block = blockOf(values, leaves, i, tree->background());
    for (int n = 0; n < kSize; ++n)
      first[i][size_t(n)] = distanceToCrossing(&block[size_t(inBlock(n))]);
  });
  // A voxel's distance exceeds that of the nearest on which it depends by 1 / sqrt(3) or more.
  const int sweeps = int(std::ceil(std::sqrt(3.) * half_width));
  std::vector<Values> distances = first, next(count);
  for (int k = 0; k < sweeps; ++k) {
    sweep(first, distances, float(half_width), leaves, &next);
    std::swap(distances, next);
  }
  tbb::parallel_for(size_t(0), count, [&](size_t i) {
    for (int n = 0; n < kSize; ++n) {
      const float sign = values[i][size_t(n)] < 0 ? -1.f : 1.f, d = distances[i][size_t(n)];
      if (d < float(half_width))
        leaves.all[i]->setValueOn(openvdb::Index(n), sign * d * voxel);
      else
        leaves.all[i]->setValueOff(openvdb::Index(n), sign * float(half_width) * voxel);
    }
  });
  openvdb::tools::signedFloodFill(*tree);
}

}  // namespace vdbc
