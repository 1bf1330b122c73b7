#pragma once
// The verbs of vdb_lab.
#include "houdini_style_tools/verb.h"

namespace vdbc {

Verb evalVerb();          // verbs_lab.cpp
Verb trainEncoderVerb();  // verbs_train.cpp
Verb trainMarVerb();
Verb packVerb();       // verbs_pack.cpp
Verb calibrateVerb();  // verbs_calibrate.cpp
Verb tablesVerb();     // verbs_tables.cpp
Verb compareVerb();
std::vector<Verb> makeRoomsVerbs();  // verbs_rooms.cpp

/// The program: all of them.
Program vdbLab();

}  // namespace vdbc
