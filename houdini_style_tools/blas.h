#pragma once
// The matrix library that torch calls, and its kernels for this CPU.
#include <string>

namespace vdbc {

/// OpenBLAS picks its kernels from a list of CPU models; one that is newer than the library may get
/// those of a CPU without AVX (measured: 5 times slower). Where the CPU can do more than the
/// kernels that were picked, picks SKYLAKEX (AVX-512) or HASWELL (AVX2) instead. Leaves alone: a
/// user's OPENBLAS_CORETYPE, a good choice, other libraries. Takes microseconds. Call it first in
/// main(): no matrix product may be running.
void chooseBlasCore();

struct BlasInfo {
  std::string library;           // file that torch's sgemm_ comes from
  std::string core = "unknown";  // kernels in use, "SkylakeX" say; "unknown" if not OpenBLAS
  int threads = 1;               // that one product is spread over
  double gflops = 0;  // of a 1024^3 float product as torch would call it; 0 = not measured
};

/// Describes the library; `measure` takes a tenth of a second (a slow library: one or two).
BlasInfo blasInfo(bool measure);

}  // namespace vdbc
