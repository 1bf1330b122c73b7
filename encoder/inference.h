#pragma once
// Private: how inference uses threads. TBB runs whole pieces of the work side by side, and within a
// piece torch and BLAS run in the thread that calls them. With threads of their own they would meet
// at a barrier in every small operation and, wherever another program takes a core, spin there.
#include <ATen/core/grad_mode.h>
#include <ATen/ops/cat.h>
#include <ATen/ops/slice.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <cstdint>
#include <vector>

namespace vdbc {

/// While it lives, torch and BLAS start no threads for what this thread asks of them. OpenMP keeps
/// its number of threads for each thread that asks, so no other thread of the process notices.
class OneThread {
 public:
  OneThread();
  ~OneThread();
  OneThread(const OneThread&) = delete;

 private:
  const int before_;
};

/// What a thread has to set before it runs a network: OneThread and no gradients. Neither passes
/// from a thread to the tasks that it starts.
struct Inference {
  const OneThread one_thread;
  const at::NoGradGuard no_grad;
};

/// Runs piece(0) to piece(count - 1) as tasks of the current arena, each in Inference. For the same
/// bytes on any number of threads pieces are cut by sizes of the work alone, draw from random
/// generators of their own and write to places of their own. Where gradients are wanted, one after
/// the other in this thread.
template <typename Piece>
void inTasks(int64_t count, const Piece& piece) {
  if (at::GradMode::is_enabled()) {
    for (int64_t i = 0; i < count; ++i) piece(i);
    return;
  }
  tbb::parallel_for(
      tbb::blocked_range<int64_t>(0, count),
      [&](const tbb::blocked_range<int64_t>& range) {
        const Inference inference;
        for (int64_t i = range.begin(); i < range.end(); ++i) piece(i);
      },
      tbb::simple_partitioner());
}

/// Rows [begin, end); the tensor itself where those are all: autograd would copy a slice's
/// gradient.
inline at::Tensor rowRange(const at::Tensor& t, int64_t begin, int64_t end) {
  return begin == 0 && end == t.size(0) ? t : t.slice(0, begin, end);
}

/// [n, ...] of rows that do not depend on each other: rows(begin, end) makes some of them. Blocks
/// of at least 256 rows are tasks.
template <typename Rows>
at::Tensor inRowBlocks(int64_t n, const Rows& rows) {
  constexpr int64_t kRows = 256;
  const int64_t blocks = n / kRows;
  if (blocks < 2 || at::GradMode::is_enabled()) return rows(int64_t(0), n);
  std::vector<at::Tensor> parts(static_cast<size_t>(blocks));
  inTasks(blocks, [&](int64_t b) {
    parts[size_t(b)] = rows(b * kRows, b + 1 == blocks ? n : (b + 1) * kRows);
  });
  return at::cat(parts);
}

}  // namespace vdbc
