#pragma once
// What the operating system knows of this process.

namespace vdbc {

/// Largest resident memory since the start or the last resetPeakMemory(), megabytes; NaN where it
/// is not known.
double peakMemoryMb();
/// Starts the peak afresh where the system can (Linux).
void resetPeakMemory();

}  // namespace vdbc
