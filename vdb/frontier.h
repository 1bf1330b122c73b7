#pragma once
// Growth order: breadth-first levels over candidate tokens, by topology (paper sec. 4;
// docs/method.md, section 4.8).
#include <vector>

#include "vdb/token_grid.h"

namespace vdbc {

/// Which tokens count as neighbours: sharing a face, face or edge, or face, edge or corner.
enum class Neighbours { kFaces6 = 6, kEdges18 = 18, kCorners26 = 26 };

/// Length of the shortest path from any seed to each candidate, through candidates. [N], 1 =
/// touches a seed, 0 = is one. Candidates that no path reaches get one more than the largest level
/// reached (nothing is forgotten). Duplicated candidates get equal levels. Seeds and candidates are
/// coordinates of one tree level. Works by dilating the topology of a standard 5-4-3 mask tree.
std::vector<int32_t> breadthFirstLevels(const std::vector<Coord>& candidates,
                                        const std::vector<Coord>& seeds,
                                        Neighbours neighbours = Neighbours::kCorners26);

/// Tokens adjacent to `tokens` (and not among them). Sorted in tree order, that of activeCoords().
std::vector<Coord> neighbourRing(const std::vector<Coord>& tokens,
                                 Neighbours neighbours = Neighbours::kCorners26);

}  // namespace vdbc
