#include "splat/gaussians.h"

#include <gtest/gtest.h>

#include "tests/some_gaussians.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

TEST(Gaussians, NewOnesAreUnitSpheresThatSitAtTheOrigin) {
  Gaussians g = someGaussians(2, 1, 1);
  const Gaussians before = g;
  g.resize(3, 1);
  EXPECT_TRUE(equalRows(keepRows(g, [](size_t i) { return i < 2; }), before));
  EXPECT_EQ(g.mean[2], Eigen::Vector3f::Zero());
  EXPECT_EQ(g.log_scale[2], Eigen::Vector3f::Zero());
  EXPECT_EQ(g.rotation[2], Eigen::Vector4f(1, 0, 0, 0));
  EXPECT_EQ(g.sh.size(), 3u * 4 * 3);
  EXPECT_THROW(g.resize(-1, 0), Error);
  EXPECT_THROW(g.resize(1, 4), Error);
}

TEST(Gaussians, ArraysOfDifferentLengthsThrow) {
  const Gaussians good = someGaussians(4, 2, 1);
  EXPECT_NO_THROW(requireConsistent(good));
  for (int array = 0; array < 6; ++array) {
    Gaussians g = good;
    if (array == 0) g.mean.pop_back();
    if (array == 1) g.log_scale.pop_back();
    if (array == 2) g.rotation.pop_back();
    if (array == 3) g.opacity_logit.pop_back();
    if (array == 4) g.sh.pop_back();
    if (array == 5) g.sh_degree = 4;
    EXPECT_THROW(requireConsistent(g), Error) << array;
  }
}

}  // namespace
}  // namespace vdbc
