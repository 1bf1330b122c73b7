#pragma once
// How many threads a piece of work may use.
#include <tbb/task_arena.h>

namespace vdbc {

/// Runs `work` in a task arena of its own: all that runs in parallel within uses at most `threads`
/// threads, the calling one among them; 0 leaves it to the caller's arena, by default all cores.
/// With 1 no thread is started. Returns what `work` returns.
template <typename Work>
auto withThreads(int threads, const Work& work) {
  if (threads == 0) return work();
  tbb::task_arena arena(threads);
  return arena.execute(work);
}

}  // namespace vdbc
