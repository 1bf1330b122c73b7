#include "houdini_style_tools/console.h"

#include <unistd.h>

#include <atomic>
#include <csignal>
#include <cstdio>

namespace vdbc {
namespace {
std::atomic<bool> g_interrupted{false};  // a signal handler can reach nothing else

// Whoever asks twice does not want to wait for a stage that rarely looks.
extern "C" void onSignal(int) {
  if (g_interrupted.exchange(true)) _exit(130);
}
}  // namespace

Console::Console(bool json) : json_(json), terminal_(isatty(STDERR_FILENO) != 0) {
  std::signal(SIGINT, onSignal);
  std::signal(SIGTERM, onSignal);
}

Console::~Console() {
  if (terminal_ && !json_ && !stage_.empty()) std::fputc('\n', stderr);
}

void Console::start(const char* stage) {
  const std::lock_guard<std::mutex> lock(mutex_);
  stage_ = stage ? stage : "";
  shown_ = -1;
  started_ = std::chrono::steady_clock::now();
  draw(0, false);
}

void Console::end() {
  const std::lock_guard<std::mutex> lock(mutex_);
  if (!stage_.empty()) draw(100, true);
  stage_.clear();
}

bool Console::wasInterrupted(int percent) {
  if (percent >= 0) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (!stage_.empty() && percent != shown_) draw(percent, false);
  }
  return g_interrupted;
}

void Console::draw(int percent, bool finished) {
  shown_ = percent;
  const double seconds =
      std::chrono::duration<double>(std::chrono::steady_clock::now() - started_).count();
  if (json_) {
    std::fprintf(stderr, "{\"stage\": \"%s\", \"percent\": %d, \"seconds\": %.2f}\n",
                 stage_.c_str(), percent, seconds);
  } else if (terminal_) {
    std::fprintf(stderr, "\r\033[K%-22s %3d %%  %.1f s%s", stage_.c_str(), percent, seconds,
                 finished ? "\n" : "");
    std::fflush(stderr);
  }
}

}  // namespace vdbc
