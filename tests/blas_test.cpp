// Laws of the choice of BLAS kernels: a slow choice is mended, a user's is not, products stay
// right.
#include "houdini_style_tools/blas.h"

#include <ATen/ATen.h>
#include <dlfcn.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <string>

namespace vdbc {
namespace {

/// Makes OpenBLAS start with the kernels of `core`, as it would on a CPU that it takes for one.
/// False where that cannot be done: another library, another build of it.
bool startWith(const char* core) {
  const auto quit = reinterpret_cast<void (*)()>(dlsym(RTLD_DEFAULT, "gotoblas_dynamic_quit"));
  const auto init = reinterpret_cast<void (*)()>(dlsym(RTLD_DEFAULT, "gotoblas_dynamic_init"));
  if (!quit || !init || blasInfo(false).core == "unknown") return false;
  setenv("OPENBLAS_CORETYPE", core, 1);
  quit();
  init();
  return true;
}

float productError() {
  const at::Tensor a = at::randn({67, 129}), b = at::randn({129, 45});
  const at::Tensor truth = at::matmul(a.to(at::kDouble), b.to(at::kDouble)).to(at::kFloat);
  const at::Tensor sums = (a.unsqueeze(2) * b.unsqueeze(0)).sum(1);
  return std::max((at::mm(a, b) - truth).abs().max().item<float>(),
                  (sums - truth).abs().max().item<float>());
}

class Blas : public testing::Test {
 protected:
  void SetUp() override {
    if (const char* value = std::getenv("OPENBLAS_CORETYPE")) before_ = value;
    first_core_ = blasInfo(false).core;
    if (!startWith("PRESCOTT")) GTEST_SKIP() << "no OpenBLAS that chooses at run time";
  }
  void TearDown() override {
    if (startWith(first_core_.c_str()) && before_.empty()) unsetenv("OPENBLAS_CORETYPE");
    if (!before_.empty()) setenv("OPENBLAS_CORETYPE", before_.c_str(), 1);
  }
  std::string before_, first_core_;
};

TEST_F(Blas, SlowKernelsAreReplacedByThoseTheCpuCanRun) {
  ASSERT_EQ(blasInfo(false).core, "Prescott");
  unsetenv("OPENBLAS_CORETYPE");
  setUpProcess();
#if defined(__x86_64__)
  const char* expected = __builtin_cpu_supports("avx512bw") ? "SkylakeX"
                         : __builtin_cpu_supports("avx2")   ? "Haswell"
                                                            : "Prescott";
  EXPECT_EQ(blasInfo(false).core, expected);
#endif
  EXPECT_LT(productError(), 1e-4f);
}

TEST_F(Blas, TheUsersChoiceStays) {
  setUpProcess();  // OPENBLAS_CORETYPE says PRESCOTT
  EXPECT_EQ(blasInfo(false).core, "Prescott");
  EXPECT_LT(productError(), 1e-4f);
}

TEST_F(Blas, AGoodChoiceStays) {
  if (!__builtin_cpu_supports("avx512bw")) GTEST_SKIP() << "needs AVX-512";
  startWith("COOPERLAKE");
  const std::string core = blasInfo(false).core;
  unsetenv("OPENBLAS_CORETYPE");
  setUpProcess();
  EXPECT_EQ(blasInfo(false).core, core);
}

TEST(BlasInfo, NamesTheLibraryAndMeasures) {
  const BlasInfo info = blasInfo(true);
  EXPECT_NE(info.library.find("blas"), std::string::npos) << info.library;
  EXPECT_GE(info.threads, 1);
  EXPECT_GT(info.gflops, 0.1);
  EXPECT_EQ(blasInfo(false).gflops, 0);
}

}  // namespace
}  // namespace vdbc
