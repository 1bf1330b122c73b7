#pragma once
// One object serves OpenVDB's tools and our own loops: reports progress and asks whether to stop.
#include <openvdb/util/NullInterrupter.h>

#include <chrono>

#include "vdb/error.h"

namespace vdbc {

/// Receives progress of long work; this base class is silent and never interrupts.
/// The command line derives one that draws on stderr. Calls come from one thread at a time, except
/// wasInterrupted(), which must be thread-safe (OpenVDB calls it from its workers).
class Progress : public openvdb::util::NullInterrupter {
 public:
  ~Progress() override = default;
  void start(const char* /*stage*/ = nullptr) override {}
  void end() override {}
  /// percent in [0, 100], or -1 where unknown. True: stop as soon as possible.
  bool wasInterrupted(int /*percent*/ = -1) override { return false; }
};

inline double secondsSince(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

/// Reports `percent` and throws Cancelled if the user asked to stop.
inline void report(Progress& progress, int percent) {
  if (progress.wasInterrupted(percent)) throw Cancelled();
}

}  // namespace vdbc
