#pragma once
// Private: thins what growth made: where a network is not sure in which of two nodes a wall lies,
// both come out likely.
#include <vector>

#include "vdb/place.h"

namespace vdbc {

/// Which of `asked` [N] only thicken a surface: those beside a likelier token along the axis in
/// which the surface is thinnest there. How thick it is at a token: the run of face neighbours that
/// are at least eight tenths as likely; more than three tokens are no surface. What is thick does
/// not depend on which tokens are kept (docs/method.md, section 4.10).
std::vector<uint8_t> thickTokens(const Place& asked);

}  // namespace vdbc
