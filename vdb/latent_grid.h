#pragma once
// A sparse grid of latents: what the encoder makes, the completer extends and the decoder reads.
#include <cstdint>
#include <vector>

#include "vdb/carve.h"

namespace vdbc {

/// N tokens of tree level `level` (1: nodes of 2^3 voxels); arrays are parallel. Spec E10.
struct LatentGrid {
  VoxelFrame frame;
  int level = 1;
  int dim = 0;                     // latent channels
  std::vector<Coord> ijk;          // [N] in units of `level`
  std::vector<float> z;            // [N, dim]
  std::vector<uint8_t> observed;   // [N] 1: encoded from the views; 0: generated
  std::vector<float> probability;  // [N] occupancy probability; 1 for observed
  std::vector<int32_t> bfs_level;  // [N] growth level; 0 for observed

  int64_t size() const { return int64_t(ijk.size()); }
};

/// The tokens whose row `keep` accepts, in their order.
template <typename Keep>
LatentGrid keepTokens(const LatentGrid& from, const Keep& keep) {
  LatentGrid to;
  to.frame = from.frame, to.level = from.level, to.dim = from.dim;
  for (size_t i = 0; i < from.ijk.size(); ++i) {
    if (!keep(i)) continue;
    const auto z = from.z.begin() + std::ptrdiff_t(i * size_t(from.dim));
    to.z.insert(to.z.end(), z, z + from.dim);
    to.ijk.push_back(from.ijk[i]);
    to.observed.push_back(from.observed[i]);
    to.probability.push_back(from.probability[i]);
    to.bfs_level.push_back(from.bfs_level[i]);
  }
  return to;
}

}  // namespace vdbc
