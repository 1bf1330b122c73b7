// The tests of the networks are a host as the program is one.
#include <gtest/gtest.h>

#include "houdini_style_tools/blas.h"

int main(int argc, char** argv) {
  vdbc::setUpProcess();
  testing::InitGoogleTest(&argc, argv);
  return RUN_ALL_TESTS();
}
