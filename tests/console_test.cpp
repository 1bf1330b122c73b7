// Laws of Ctrl-C: once asks, twice ends.
#include "houdini_style_tools/console.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <csignal>

namespace vdbc {
namespace {

TEST(ConsoleDeathTest, ASecondSignalEndsAProcessThatDoesNotListen) {
  GTEST_FLAG_SET(death_test_style, "threadsafe");
  for (const int second : {SIGINT, SIGTERM})
    EXPECT_EXIT(
        {
          Console console(false);
          std::raise(SIGINT);
          if (!console.wasInterrupted()) _exit(1);
          std::raise(second);
          _exit(2);
        },
        testing::ExitedWithCode(130), "");
}

}  // namespace
}  // namespace vdbc
