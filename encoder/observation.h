#pragma once
// Views to voxels: which voxels the pixels fill, what they look like, and which image patches see
// which token. No torch, no network: the geometry that the encoder stands on. Spec E2-E5, E7.
#include <vector>

#include "splat/view.h"
#include "vdb/carve.h"
#include "vdb/token_grid.h"

namespace vdbc {

/// What each voxel's pixels say, kVoxelFeatures floats:
/// 8 octants x (mean sRGB colour 3, pixel share 1), mean colour 3, log(1 + pixels) / 8,
/// mean place in the voxel 3 (0-1, less .5), mean normal 3 (grid axes).
constexpr int kVoxelFeatures = 42;

/// Patches of one view on a gw x gh lattice over its image.
struct PatchLattice {
  int columns = 0, rows = 0;
  int first = 0;  // index of its first patch among those of all views
};

struct Observation {
  Observation(const VoxelFrame& f, const ObservedSpace& s) : frame(f), space(s), tokens(s.filled) {}
  VoxelFrame frame;
  ObservedSpace space;                 // F, E of the views
  TokenGrid tokens;                    // of F
  std::vector<float> voxel_features;   // [N0, kVoxelFeatures]
  std::vector<PatchLattice> lattices;  // one a view
  int patches = 0;                     // of all views
  /// Mean point of each patch's pixels in grid metres and its share of valid pixels, [patches, 4].
  std::vector<float> patch_points;
  /// Pixels of patch p whose point lies in token v of the latent level, as compressed sparse rows
  /// over v.
  std::vector<int32_t> row_begin;  // [N + 1]
  std::vector<int32_t> patch;      // [nnz]
  std::vector<float> count;        // [nnz]
};

struct ObservationSettings {
  CarveSettings carving;
  int patches_across = 14;  // patches along the image's width; rows follow the aspect ratio
  int level = 1;            // tree level of the latents, whose tokens' pixels are counted
};

/// Throws Error if no pixel of any view falls into the frame's bounds.
Observation observe(const std::vector<View>& views, const VoxelFrame& frame,
                    const ObservationSettings& settings, Progress& progress);

/// The pixels of `view` whose surface was observed, [H * W], 1 or 0: those with a usable depth
/// whose point lies in one of the observation's tokens of `level`. What a reconstruction can be
/// held to.
std::vector<uint8_t> observedPixels(const View& view, const Observation& observation, int level,
                                    const CarveSettings& carving);

}  // namespace vdbc
