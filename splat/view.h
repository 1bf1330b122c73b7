#pragma once
// One posed RGB-D view: a picture, what was measured behind it, and the camera that took it.
#include <string>
#include <vector>

#include "splat/image.h"
#include "vdb/camera.h"
#include "vdb/carve.h"

namespace vdbc {

struct View {
  std::string name;          // file name, for messages and contact sheets
  Camera camera;             // OpenCV axes, camera-to-world, metres
  Image colour;              // [H, W, 3] display sRGB, 0-1
  std::vector<float> depth;  // [H * W] planar z, metres; 0 where there is none

  DepthView depthView() const { return {camera, depth.data()}; }
};

}  // namespace vdbc
