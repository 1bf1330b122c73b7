#pragma once
// Views to voxels: which voxels the pixels fill, what they look like, and which image patches see
// which token. No torch, no network: the geometry that the encoder stands on. See docs/method.md,
// section 2.
#include <memory>
#include <optional>
#include <vector>

#include "splat/view.h"
#include "vdb/carve.h"
#include "vdb/fit_volume.h"
#include "vdb/token_grid.h"

namespace vdbc {

/// What a voxel's pixels say, kVoxelFeatures floats a voxel; where each part begins.
constexpr int kOctantColours =
    0;                           // 8 octants x (mean display sRGB 3, share of the voxel's pixels 1)
constexpr int kMeanColour = 32;  // display sRGB, 3
constexpr int kPixelCount = 35;  // log(1 + pixels) / 8
constexpr int kMeanPlace = 36;   // in the voxel, 3 x 0-1, less .5
constexpr int kMeanNormal = 39;  // grid axes, towards the camera, 3
constexpr int kVoxelFeatures = 42;

/// Patches of one view on a gw x gh lattice over its image.
struct PatchLattice {
  int columns = 0, rows = 0;
  int first = 0;  // index of its first patch among those of all views
};

/// What views saw, in the grid's terms.
struct Observation {
  VoxelFrame frame;
  std::shared_ptr<const SeenSpace> seen;  // F, E of the views
  TokenGrid tokens;                       // of F
  std::vector<float> voxel_features;      // [N0, kVoxelFeatures]
  std::vector<PatchLattice> lattices;     // one a view
  int patches = 0;                        // of all views
  /// Mean point of each patch's pixels in grid metres and its share of valid pixels, [patches, 4].
  std::vector<float> patch_points;
  /// Pixels of patch p whose point lies in token v of the latent level, as compressed sparse rows
  /// over v.
  std::vector<int32_t> row_begin;  // [N + 1]
  std::vector<int32_t> patch;      // [nnz]
  std::vector<float> count;        // [nnz]
};

struct ObserveSettings {
  VolumeSettings volume;            // of the grid that is fitted to the views
  std::optional<VoxelFrame> frame;  // the grid, where it is given
  CarveSettings carving;
  float lens_m = .3f;       // round every camera nothing is there: somebody stood in that place
  int patches_across = 14;  // patches along the image's width; rows follow the aspect ratio
  int level = 1;            // tree level of the latents, whose tokens' pixels are counted
};

/// Fits the volume (or takes the given frame), carves it, opens the space round the cameras where
/// no pixel's point lies, and pools pixels into voxels and patches.
/// Throws Error if no pixel of any view falls into the frame's bounds, and as fitVolume() does.
Observation observe(const std::vector<View>& views, const ObserveSettings& settings,
                    Progress& progress);

/// The pixels of `view` whose surface was observed, [H * W], 1 or 0: those with a usable depth
/// whose point lies in one of the observation's tokens of `level`. What a reconstruction can be
/// held to.
std::vector<uint8_t> observedPixels(const View& view, const Observation& observation, int level,
                                    const CarveSettings& carving);

}  // namespace vdbc
