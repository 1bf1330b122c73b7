#pragma once
// Files of views, for tests of what reads them.
#include <string>
#include <vector>

#include "splat/exr.h"
#include "splat/view.h"

namespace vdbc {

/// The view as a renderer leaves it: half R, G, B scene-linear, float Z planar, kNoDepth where
/// there is none.
inline void writeViewExr(const View& view, const std::string& path) {
  std::vector<float> linear, depth;
  for (float v : view.colour.data) linear.push_back(linearFromSrgb(v));
  for (float z : view.depth) depth.push_back(z > 0 ? z : kNoDepth);
  writeExr(view.camera,
           {{"R", linear.data(), 3, true},
            {"G", linear.data() + 1, 3, true},
            {"B", linear.data() + 2, 3, true},
            {"Z", depth.data(), 1, false}},
           path);
}

}  // namespace vdbc
