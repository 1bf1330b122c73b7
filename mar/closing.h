#pragma once
// Private: closes holes of a completed place from what the occupancy head said of the tokens that
// growth dropped.
#include <vector>

#include "vdb/place.h"
#include "vdb/seen.h"

namespace vdbc {

/// The cheapest set of dropped tokens that parts the seen empty space from the border of the
/// volume: a token of probability p costs -log p, other unobserved nodes stay open (minimum cut,
/// paths through faces). Of the set, those with p > `least`: rows of `dropped`, by coordinates.
/// `occupied` are the tokens that are there besides the filled ones of `nodes`. Where open nodes
/// lead out, what can be closed is. Nodes within half a metre of a camera of `dropped` stay open,
/// and so do holes of more than a hundred tokens (neighbours through corners too). Time and memory
/// follow the tokens and `nodes`, not the volume.
std::vector<int64_t> closingTokens(const SeenSpace& nodes, const std::vector<Coord>& occupied,
                                   const Place& dropped, float least);

}  // namespace vdbc
