#pragma once
// Gaussians as pictures: from the cameras of views, on a turntable, on a flight through views.
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "splat/points_vdb.h"
#include "vdb/camera.h"
#include "vdb/progress.h"

namespace vdbc {

struct RenderSettings {
  std::string splats;   // .ply or .points.vdb
  std::string cameras;  // views whose cameras to take; none for a turntable
  double scale = 0;     // metres per unit of cameras from an .npz; 0 = as the file says
  std::string output;   // a folder for 0000.png, ..., or a name with #### that ends in .png or .exr
  std::vector<int> frames;  // numbers of those to render; empty = all
  int turntable = 0;        // frames of a full turn around the splats
  int flythrough = 0;       // frames from the first of the cameras to the last
  int width = 0,
      height = 0;          // pixels; 0 = the view's, or in its proportion; 960 x 540 on a turntable
  double fov_degrees = 0;  // across the picture; 0 = the view's, 60 on a turntable
  Eigen::Vector3d up = Eigen::Vector3d::UnitZ();  // axis of the turntable
  std::optional<bool> antialias;                  // empty = as the file says
  bool preview = false;                           // a .png beside each .exr
};

/// What was written for one frame.
struct RenderedFrame {
  int number = 0;
  std::string image, preview;  // paths; preview is empty without one
  std::string view;            // name of the view whose camera it is, if any
};

/// Renders and writes frame by frame: a file is there whole or not at all. An EXR has R, G, B, A
/// half (scene-linear, premultiplied), Z (expected) and depth.median float (planar, metres,
/// kNoDepth where there is nothing) and, where the splats' file records provenance, `provenance`
/// (the generated share) and `confidence` half, both premultiplied by A; and the camera as
/// writeExr() stores it. Throws UsageError for settings that contradict each other, Error for bad
/// files, Cancelled.
void renderFrames(const RenderSettings& settings,
                  const std::function<void(const RenderedFrame&)>& written, Progress& progress);

/// `count` cameras on a circle around the bulk of the Gaussians (2 % at each side of the box do not
/// count), outside of it, 20 degrees above its middle, all of it in the picture.
std::vector<Camera> turntableCameras(const Gaussians& gaussians, int count, int width, int height,
                                     double fov_degrees, const Eigen::Vector3d& up);
/// `count` cameras from the first to the last, through all of them: Catmull-Rom between places, the
/// shorter arc between rotations, straight between focal lengths. Sizes are the first one's.
std::vector<Camera> flythroughCameras(const std::vector<Camera>& through, int count);

/// `pattern` with its last run of # replaced by the number, with zeros in front to the run's
/// length.
std::string framePath(const std::string& pattern, int number);

/// By the name's ending. Throws UsageError for others, Error for bad files.
Gaussians readSplats(const std::string& path, Provenance* provenance = nullptr);

}  // namespace vdbc
