#pragma once
// Progress on the terminal, JSON lines, and Ctrl-C.
#include <chrono>
#include <mutex>
#include <string>

#include "vdb/progress.h"

namespace vdbc {

/// Draws one line per stage on stderr where that is a terminal; with `json` writes one JSON object
/// a line to stderr instead. wasInterrupted() turns true after SIGINT or SIGTERM; a second one ends
/// the process at once, with code 130.
class Console : public Progress {
 public:
  /// Installs the signal handlers (once per process is enough).
  explicit Console(bool json);
  /// Ends a line that an Error left unfinished.
  ~Console() override;
  void start(const char* stage = nullptr) override;
  void end() override;
  bool wasInterrupted(int percent = -1) override;

 private:
  void draw(int percent, bool finished);

  const bool json_, terminal_;
  std::mutex mutex_;
  std::string stage_;
  int shown_ = -1;
  std::chrono::steady_clock::time_point started_;
};

}  // namespace vdbc
