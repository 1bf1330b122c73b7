#pragma once
// What views saw, at the resolution of their pixels: flat Gaussians placed from pictures and depth,
// then fitted. No network. See docs/method.md, section 6.3.
#include <vector>

#include "splat/gaussians.h"
#include "splat/view.h"
#include "vdb/grid_instances.h"
#include "vdb/progress.h"

namespace vdbc {

struct DetailSettings {
  /// Of fitting, by a fixed cost model (fitSeconds()): the clock never decides what is computed. 0:
  /// nothing is made of the views, and of a little no more than placed. Fitting stops before where
  /// more would not help.
  double seconds = 2;
  /// Of discs, at most; 0: as many as what was seen asks for. Plain walls ask for few.
  int64_t splats = 0;
  float voxel_m = 0;  // of the level set (FuseSettings)
  uint64_t seed = 1;
};

/// Seconds that a step of fitting so many discs to a picture of so many pixels takes on two cores
/// (measured on an AVX2 machine, docs/performance.md).
double fitSeconds(int64_t splats, int64_t pixels);

struct Detail {
  Gaussians discs;               // SH degree 0, antialias
  int steps = 0;                 // of fitting that were taken
  double estimated_seconds = 0;  // of them, by fitSeconds()
  FloatGrid::ConstPtr distance;  // what the views measured (fuseDepth()); null where not asked for
  double seconds = 0;            // that making the discs took
};

/// Discs of everything that the views saw; `carving` says which pixels have a depth, means are from
/// `origin`. Views of more than a million pixels are looked at reduced. Parallel; the same bytes
/// for any number of threads. Throws Error for views without colour or depth, and Cancelled.
Detail seenDetail(const std::vector<View>& views, const DetailSettings& settings,
                  const CarveSettings& carving, const Eigen::Vector3d& origin, Progress& progress);

}  // namespace vdbc
