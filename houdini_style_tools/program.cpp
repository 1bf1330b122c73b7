#include "houdini_style_tools/program.h"

#include <malloc.h>

#include <algorithm>
#include <cstdio>

#include "houdini_style_tools/blas.h"
#include "houdini_style_tools/console.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

// Answers what asks about the program itself.
bool answer(const Program& program, const Words& words, const Verb* verb) {
  const auto asks = [&](const char* option) {
    return std::find(words.begin(), words.end(), option) != words.end();
  };
  if (asks("--help") || asks("-h"))
    std::fputs(
        (verb && !verb->name.empty() ? helpText(program, *verb) : frontPage(program)).c_str(),
        stdout);
  else if (words == Words{"--version"})
    std::puts(VDBC_VERSION);
  else if (words == Words{"--reference"})  // how docs/reference.md is made
    std::fputs(referencePage(program).c_str(), stdout);
  else
    return false;
  return true;
}

void cook(const Program& program, const Words& words) {
  const Verb* verb = findVerb(program, words);
  if (answer(program, words, verb)) return;
  if (!verb) throw UsageError(joinText("expected a verb (", program.name, " --help)"));
  Run run;
  parse(program, *verb, words, &run);
  Console console(run.json);
  try {
    withThreads(run.threads, [&] { verb->cook(run, console); });
  } catch (const UsageError& e) {
    throw UsageError(inOptions(*verb, e.what()));
  }
}

}  // namespace

int runProgram(const Program& program, int argc, char** argv) {
  setUpProcess();
  // Tensors of some megabytes come and go: keep their pages instead of asking the kernel each time.
  mallopt(M_MMAP_THRESHOLD, 1 << 30);
  mallopt(M_TRIM_THRESHOLD, 1 << 30);
  const auto fail = [&](const std::string& line, int code) {
    std::fprintf(stderr, "%s: %s\n", program.name.c_str(), line.c_str());
    return code;
  };
  try {
    cook(program, Words(argv + 1, argv + argc));
    require(std::fflush(stdout) == 0, "standard output: cannot write the results");
    return 0;
  } catch (const Cancelled&) {
    return fail("interrupted", 130);
  } catch (const UsageError& e) {
    return fail(e.what(), 2);
  } catch (const std::exception& e) {
    return fail(firstLine(e), 1);
  }
}

}  // namespace vdbc
