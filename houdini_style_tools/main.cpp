// vdb_complete: what an artist installs.
#include "houdini_style_tools/program.h"
#include "houdini_style_tools/verbs.h"

int main(int argc, char** argv) { return vdbc::runProgram(vdbc::vdbComplete(), argc, argv); }
