#include "encoder/inference.h"

#include <ATen/Parallel.h>
#include <omp.h>

namespace vdbc {

// A thread's first question makes torch set its number of threads; what follows overrides that.
OneThread::OneThread() : before_(at::get_num_threads()) { omp_set_num_threads(1); }
OneThread::~OneThread() { omp_set_num_threads(before_); }

}  // namespace vdbc
