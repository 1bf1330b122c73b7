#pragma once
// The matrix library that torch calls, and its kernels for this CPU.
#include <string>

namespace vdbc {

/// What torch and OpenBLAS offer for a whole process or thread only. Call it first in main():
/// nothing of either may be running. A host that has decided about them leaves it out: our
/// inference still computes the same, with one thread a task, but maybe with slower kernels.
/// - One thread for each operation that the calling thread asks of them, whatever it is for;
///   inference has that anyway. An OpenBLAS of pthreads has started its own threads when it was
///   loaded (OPENBLAS_NUM_THREADS=1 prevents that); they sleep.
/// - OpenBLAS's kernels. It picks them from a list of CPU models; one that is newer than the
/// library
///   may get those of a CPU without AVX (measured: 5 times slower). Where the CPU can do more than
///   the kernels that were picked, picks SKYLAKEX (AVX-512) or HASWELL (AVX2) instead, by
///   OPENBLAS_CORETYPE. Leaves alone: a user's choice in that variable, a good choice, other
///   libraries.
void setUpProcess();

struct BlasInfo {
  std::string library;           // file that torch's sgemm_ comes from
  std::string core = "unknown";  // kernels in use, "SkylakeX" say; "unknown" if not OpenBLAS
  int threads = 1;               // that one product is spread over
  double gflops = 0;  // of a 1024^3 float product as torch would call it; 0 = not measured
};

/// Describes the library; `measure` takes a tenth of a second (a slow library: one or two).
BlasInfo blasInfo(bool measure);

}  // namespace vdbc
