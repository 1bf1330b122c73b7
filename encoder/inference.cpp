#include "encoder/inference.h"

#include <ATen/Parallel.h>
#include <dlfcn.h>

namespace vdbc {
namespace {

// By the OpenMP that torch brought along: a setting of any other would not reach it.
void setOpenMpThreads(int count) {
  static const auto set =
      reinterpret_cast<void (*)(int)>(dlsym(RTLD_DEFAULT, "omp_set_num_threads"));
  if (set) set(count);
}

}  // namespace

// A thread's first question makes torch set its number of threads; what follows overrides that.
OneThread::OneThread() : before_(at::get_num_threads()) { setOpenMpThreads(1); }
OneThread::~OneThread() { setOpenMpThreads(before_); }

}  // namespace vdbc
