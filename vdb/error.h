#pragma once
// The one error type. Everything that can go wrong with input is thrown as Error, at the door, with
// one line: operation, object, what was expected, what was found.
#include <algorithm>
#include <sstream>
#include <stdexcept>
#include <string>

namespace vdbc {

/// Bad input or a failed operation; what() is one complete line for the user. Exit code 1.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The command line itself is wrong. Exit code 2.
class UsageError : public Error {
 public:
  using Error::Error;
};

/// The user asked to stop (Progress::wasInterrupted returned true). Exit code 130.
class Cancelled : public std::runtime_error {
 public:
  Cancelled() : std::runtime_error("interrupted") {}
};

/// Concatenates its arguments with operator<<.
template <typename... Parts>
std::string joinText(const Parts&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

/// The first line of what() that says something: libtorch's exceptions append its stack.
inline std::string firstLine(const std::exception& error) {
  const std::string text = error.what();
  const size_t begin = std::min(text.find_first_not_of("\n "), text.size());
  return text.substr(begin, text.find('\n', begin) - begin);
}

/// Throws Error with the joined parts unless `ok`.
/// Parts are only formatted when the check fails.
template <typename... Parts>
void require(bool ok, const Parts&... parts) {
  if (!ok) throw Error(joinText(parts...));
}

}  // namespace vdbc
