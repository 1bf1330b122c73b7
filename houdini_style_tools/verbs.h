#pragma once
// The verbs of vdb_complete.
#include "houdini_style_tools/verb.h"

namespace vdbc {

Verb completeVerb();  // verbs_complete.cpp
Verb rethresholdVerb();
Verb encodeVerb();  // verbs_latents.cpp
Verb decodeVerb();
Verb renderVerb();  // verbs_look.cpp
Verb checkVerb();
Verb infoVerb();

/// The program: all of them.
Program vdbComplete();

}  // namespace vdbc
