// vdb_lab: furnished rooms, training and studies.
#include "examples/lab/verbs_lab.h"
#include "houdini_style_tools/program.h"

int main(int argc, char** argv) { return vdbc::runProgram(vdbc::vdbLab(), argc, argv); }
