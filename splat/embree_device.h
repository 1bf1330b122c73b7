#pragma once
// Private: the one Embree device of the process.
#include <embree3/rtcore.h>

namespace vdbc {

/// Making one costs milliseconds and it holds no scene data. Scenes keep a reference to their
/// device, so the order of destruction at exit does not matter. Throws Error where Embree cannot
/// start.
RTCDevice embreeDevice();

}  // namespace vdbc
