#include "mar/windows.h"

#include <algorithm>
#include <cmath>
#include <set>

#include "vdb/token_grid.h"

namespace vdbc {

Windows::Windows(const VoxelFrame& whole, const CoordBBox& content, const CompleterConfig& config)
    : whole_(whole) {
  constexpr int kCoarse = 1 << (kTokenLevels - 1);  // voxels: no window cuts a coarse node
  const double extent = double(config.positions.extent_m) / whole.voxel_m;  // voxels
  overlap_ = int(std::lround(config.window_overlap_m / whole.voxel_m / kCoarse)) * kCoarse;
  const int64_t pitch =
      std::max<int64_t>(kCoarse, int64_t((extent - 2 * overlap_) / kCoarse) * kCoarse);
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t begin = whole.bounds.min()[axis], end = int64_t(whole.bounds.max()[axis]) + 1,
                  low = content.min()[axis], high = int64_t(content.max()[axis]) + 1;
    begin_[size_t(axis)] = {int(begin)};
    if (double(end - begin) <= extent) continue;
    // As few windows as can hold the content, and it in their middle.
    const int64_t parts = std::max<int64_t>(1, (high - low + pitch - 1) / pitch),
                  first = ((low + high - parts * pitch) / 2) & ~(kCoarse - 1);
    for (int64_t cut = first + (begin - first) / pitch * pitch; cut < end; cut += pitch)
      if (cut > begin) begin_[size_t(axis)].push_back(int(cut));
  }
}

Window Windows::window(size_t number) const {
  Window w{{}, whole_};
  for (int axis = 2; axis >= 0; --axis) {
    const std::vector<int>& begin = begin_[size_t(axis)];
    const size_t part = number % begin.size();
    number /= begin.size();
    w.core.min()[axis] = begin[part];
    w.core.max()[axis] = part + 1 < begin.size() ? begin[part + 1] - 1 : whole_.bounds.max()[axis];
  }
  w.frame.bounds = w.core;
  w.frame.bounds.expand(overlap_);
  w.frame.bounds.intersect(whole_.bounds);
  return w;
}

size_t Windows::at(const Coord& voxel) const {
  size_t number = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const std::vector<int>& begin = begin_[size_t(axis)];
    const auto after = std::upper_bound(begin.begin() + 1, begin.end(), voxel[axis]);
    number = number * begin.size() + size_t(after - begin.begin() - 1);
  }
  return number;
}

size_t Windows::of(const Coord& node, int level) const { return at(firstVoxel(node, level)); }

std::vector<size_t> Windows::around(const std::vector<Coord>& nodes, int level) const {
  std::set<size_t> numbers;
  for (const Coord& node : nodes) {
    const Coord voxel = firstVoxel(node, level);
    // An overlap is shorter than any window but the outermost: these reach every window that is
    // near enough.
    for (int x : {-overlap_, 0, overlap_})
      for (int y : {-overlap_, 0, overlap_})
        for (int z : {-overlap_, 0, overlap_}) numbers.insert(at(voxel.offsetBy(x, y, z)));
  }
  return {numbers.begin(), numbers.end()};
}

std::map<size_t, std::vector<Coord>> Windows::split(const std::vector<Coord>& tokens) const {
  std::map<size_t, std::vector<Coord>> parts;
  for (const Coord& token : tokens) parts[of(token, 1)].push_back(token);
  return parts;
}

}  // namespace vdbc
