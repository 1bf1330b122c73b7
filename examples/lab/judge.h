#pragma once
// Completion judged by views that it was not given. No mesh is needed: captures are judged like
// rooms. See docs/method.md, section 7.
#include <cstdint>
#include <vector>

#include "vdb/seen.h"

namespace vdbc {

/// NaN is 0/0.
struct Scores {
  double precision = 0, recall = 0, f1 = 0;
};

/// Generated voxels against what all views say of the voxels that the input left unobserved.
struct VoxelVerdict {
  int64_t confirmed = 0, contradicted = 0, undecided = 0;  // filled, seen empty, unobserved by all
  Scores exact;                                            // undecided ones count for nothing
  Scores near;  // the same where a neighbour (of 26) is good enough
};
/// `input` and `all` are of voxels, of the input views and of these and others. Of `filled` those
/// count that `input` left unobserved. Without any, precision is NaN and F1 is 0.
VoxelVerdict judgeVoxels(const SeenSpace& input, const SeenSpace& all,
                         const std::vector<Coord>& filled);

/// Shares of the pixels that have a true depth. A quarter of a metre before the truth is none of
/// these.
struct PixelVerdict {
  double blocked = 0;  // something stands more than .3 m before it
  double right = 0;    // within .1 m, or 5 % of the true depth
  double behind = 0;   // farther than that
  double open = 0;     // nothing is there
};
/// Depths of the same pixels, metres; 0: none. NaN without true ones.
PixelVerdict judgePixels(const std::vector<float>& depth, const std::vector<float>& truth);

}  // namespace vdbc
