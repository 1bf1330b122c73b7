#pragma once
// How functions are expected to fail, and to be stopped.
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "vdb/error.h"
#include "vdb/progress.h"

namespace vdbc {

/// Expects `attempt` to throw an Error of one line that contains all of `parts`.
template <typename Attempt>
void expectError(const Attempt& attempt, const std::vector<std::string>& parts) {
  try {
    attempt();
    ADD_FAILURE() << "expected an Error";
  } catch (const Error& error) {
    const std::string message = error.what();
    EXPECT_EQ(message.find('\n'), std::string::npos) << message;
    for (const std::string& part : parts)
      EXPECT_NE(message.find(part), std::string::npos) << message << "\nlacks " << part;
  }
}

/// Asks to stop when half of the work is done.
class StopAtHalf : public Progress {
 public:
  bool wasInterrupted(int percent = -1) override { return percent == 50; }
};

}  // namespace vdbc
