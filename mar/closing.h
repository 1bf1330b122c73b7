#pragma once
// Private: closes holes of a completed place from what the occupancy head said of the tokens that
// growth dropped.
#include <map>
#include <vector>

#include "vdb/carve.h"

namespace vdbc {

/// The cheapest set of dropped tokens that parts the seen empty space from the border of the
/// volume: a token of probability p costs -log p, other unobserved nodes stay open (minimum cut,
/// paths through faces). Of the set, those with p > `least`. `occupied` are the tokens that are
/// there besides the filled ones of `nodes`. Where open nodes lead out, what can be closed is.
std::vector<Coord> closingTokens(const NodeStates& nodes, const std::vector<Coord>& occupied,
                                 const std::map<Coord, float>& dropped, float least);

}  // namespace vdbc
