#pragma once
// What both programs do with their verbs: exit codes, threads, the terminal.
#include "houdini_style_tools/verb.h"

namespace vdbc {

/// Runs the verb that the command line names and returns the process's exit code: 0 ok, 1 failed,
/// 2 wrong usage, 130 interrupted. A failure is one line on stderr.
int runProgram(const Program& program, int argc, char** argv);

}  // namespace vdbc
