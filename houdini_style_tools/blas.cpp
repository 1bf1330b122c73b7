#include "houdini_style_tools/blas.h"

#include <dlfcn.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <vector>

#include "encoder/inference.h"

namespace vdbc {
namespace {

/// A function of whatever library torch's BLAS symbols resolve to, null where it has none.
template <typename Function>
Function* symbol(const char* name) {
  return reinterpret_cast<Function*>(dlsym(RTLD_DEFAULT, name));
}

std::string coreName() {
  const auto core = symbol<const char*()>("openblas_get_corename");
  return core ? core() : "unknown";
}

/// Width in bits of the vectors that the kernels of an OpenBLAS core use; 0 for names we do not
/// know (newer than this list: then OpenBLAS knows better).
int coreVectorBits(const std::string& core) {
  for (const char* name : {"SkylakeX", "Cooperlake", "SapphireRapids"})
    if (core == name) return 512;
  for (const char* name : {"Haswell", "Zen"})
    if (core == name) return 256;
  for (const char* name :
       {"Katmai",     "Coppermine",  "Northwood", "Prescott", "Banias",      "Core2",
        "Penryn",     "Dunnington",  "Nehalem",   "Athlon",   "Opteron",     "Opteron_SSE3",
        "Barcelona",  "Nano",        "Atom",      "Bobcat",   "Sandybridge", "Bulldozer",
        "Piledriver", "Steamroller", "Excavator"})
    if (core == name) return 128;
  return 0;
}

void chooseCore() {
#if defined(__x86_64__)
  if (const char* chosen = std::getenv("OPENBLAS_CORETYPE"); chosen && *chosen) return;
  // OpenBLAS reads the variable when the library loads, before any code of ours; its own dispatcher
  // is exported and can be run again as long as no kernel is running.
  const auto quit = symbol<void()>("gotoblas_dynamic_quit");
  const auto init = symbol<void()>("gotoblas_dynamic_init");
  const int picked_bits = coreVectorBits(coreName());
  if (!quit || !init || picked_bits == 0) return;

  // The supports-queries also ask whether the system saves the wide registers.
  const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
                      __builtin_cpu_supports("avx512cd");
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const int cpu_bits = avx512 ? 512 : avx2 ? 256 : 128;
  if (cpu_bits <= picked_bits) return;
  setenv("OPENBLAS_CORETYPE", avx512 ? "SKYLAKEX" : "HASWELL", 1);
  quit();
  init();
#endif
}

}  // namespace

void setUpProcess() {
  static const OneThread one_thread;
  if (const auto set = symbol<void(int)>("openblas_set_num_threads")) set(1);
  chooseCore();
}

BlasInfo blasInfo(bool measure) {
  using Sgemm =
      void(const char*, const char*, const int*, const int*, const int*, const float*, const float*,
           const int*, const float*, const int*, const float*, float*, const int*);
  BlasInfo info;
  const auto sgemm = symbol<Sgemm>("sgemm_");
  Dl_info where{};
  if (!sgemm || !dladdr(reinterpret_cast<void*>(sgemm), &where)) return info;
  char* path = realpath(where.dli_fname, nullptr);
  info.library = path ? path : where.dli_fname;
  std::free(path);
  // OpenBLAS may be loaded for LAPACK only: then its core says nothing about this library.
  const bool openblas = info.library.find("openblas") != std::string::npos;
  if (openblas) info.core = coreName();
  // The OpenMP build follows the calling thread's count; others have their own.
  constexpr int kOpenMp = 2;
  const auto parallel = symbol<int()>("openblas_get_parallel");
  const auto threads = !openblas ? nullptr
                       : parallel && parallel() == kOpenMp
                           ? symbol<int()>("omp_get_max_threads")
                           : symbol<int()>("openblas_get_num_threads");
  if (threads) info.threads = threads();
  if (!measure) return info;

  constexpr int n = 1024;
  const std::vector<float> a(n * n, 0.5f), b(n * n, 0.25f);
  std::vector<float> c(n * n);
  const float one = 1, zero = 0;
  using Clock = std::chrono::steady_clock;
  const auto seconds = [](Clock::duration d) { return std::chrono::duration<double>(d).count(); };
  double best_s = 1e9;
  const auto begin = Clock::now();
  do {  // the best of several: the first ones start threads and wake vector units
    const auto start = Clock::now();
    sgemm("N", "N", &n, &n, &n, &one, a.data(), &n, b.data(), &n, &zero, c.data(), &n);
    best_s = std::min(best_s, seconds(Clock::now() - start));
  } while (seconds(Clock::now() - begin) < 0.1);
  info.gflops = 2.0 * n * n * n / best_s * 1e-9;
  return info;
}

}  // namespace vdbc
