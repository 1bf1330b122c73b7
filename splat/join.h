#pragma once
// What completion made, joined with what the views saw. See docs/method.md, section 6.4.
#include <vector>

#include "splat/points_vdb.h"
#include "vdb/camera.h"

namespace vdbc {

struct JoinSettings {
  float voxel_m = .1f;       // edge of the decoded voxels
  float slack_m = .01f;      // what stands no farther in front of a measured depth may stay
  float off_plane_m = .05f;  // generated voxels within lie in a seen plane that goes on
  float reach_m = 1.5f;      // how far beyond its discs a seen plane goes on
  uint64_t seed = 1;         // of the search for planes
};

/// Gaussians and, row by row, where they come from.
struct SplatScene {
  Gaussians gaussians;
  Provenance provenance;
};

/// `discs` (all observed), then what is left of the decoded Gaussians, `per_voxel` to a voxel:
/// - those of voxels that were not generated give way where a view saw their surface; the rest of
///   them count as generated, for no view saw what they show;
/// - what is left of a voxel becomes one Gaussian, or one flat disc where it continues a plane of
///   the discs; neighbours that agree become one, away from the discs;
/// - their colours are fitted to those of the discs where both meet, and less so farther away;
/// - what comes before the discs in one of the `cameras`, those of the views that the discs were
///   made of, is moved behind them or shrunk, or else dropped.
/// Origins have to be equal. Parallel; the same bytes for any number of threads. Throws Error where
/// rows do not fit each other.
SplatScene join(const Gaussians& discs, const Gaussians& decoded, const Provenance& provenance,
                int per_voxel, const std::vector<Camera>& cameras, const JoinSettings& settings);

}  // namespace vdbc
