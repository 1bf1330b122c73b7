#pragma once
// A place: what views saw of it and, as tokens with latents, what it is made of. The one thing that
// flows from views to files: the encoder makes it, the completer adds tokens, the decoder reads it.
#include <memory>
#include <string>

#include "vdb/carve.h"
#include "vdb/columns.h"

namespace vdbc {

struct Detail;

/// N tokens of tree level `level` (1: nodes of 2^3 voxels), observed ones and generated ones, and
/// the space that the views saw. docs/method.md, section 1.
struct Place {
  VoxelFrame frame;
  std::shared_ptr<const SeenSpace>
      seen;                  // F and E of the views, voxels; never null in a finished place
  std::string encoder_hash;  // of the weights that made the latents, Encoder::hash()
  std::string growth;        // of a completion that was cut short: where it goes on; else empty
  /// What the views saw at the resolution of their pixels, from the grid's origin (splat/detail.h);
  /// null where it was not asked for, and in files of latents.
  std::shared_ptr<const Detail> detail;
  /// The views' cameras. Files of latents hold them where there is detail, which needs them.
  std::vector<Camera> cameras;
  int level = 1;
  int dim = 0;                     // latent channels
  std::vector<Coord> ijk;          // [N] in units of `level`
  std::vector<float> z;            // [N, dim] latents, in half precision as files hold them
  std::vector<float> probability;  // [N] of occupancy; 1 for observed tokens
  std::vector<int32_t> bfs_level;  // [N] growth level; 0 for observed tokens
  std::vector<uint8_t> generated;  // [N] 1: by the completer; 0: encoded from the views

  int64_t size() const { return int64_t(ijk.size()); }

  template <typename Self>
  static auto columns(Self& p) {
    return std::make_tuple(column("ijk", p.ijk), halfColumn("z", p.z, size_t(p.dim)),
                           column("probability", p.probability), column("bfs_level", p.bfs_level),
                           column("generated", p.generated));
  }
};

/// The observed tokens alone.
inline Place observedPart(const Place& place) {
  return keepRows(place, [&](size_t i) { return !place.generated[i]; });
}

}  // namespace vdbc
