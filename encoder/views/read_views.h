#pragma once
// Posed RGB-D views from files, and to files (docs/formats.md, Views).
#include <string>
#include <vector>

#include "splat/view.h"

namespace vdbc {

struct ReadViewsSettings {
  std::vector<int> frames;     // indices into the folder's frames; empty = all
  bool cameras_only = false;   // colour and depth stay empty and need not be there
  double metres_per_unit = 0;  // of an .npz; 0 = from the file (PointmapScale), if it tells
};

/// Reads views from: a folder with transforms.json, a transforms.json, an .exr or a folder of .exr
/// with Z or P and worldToCamera + worldToNDC, pointmaps (.npz, docs/formats.md), or a level set or
/// fog volume (.vdb), of which views are made by ray casting. Adds no frame
/// conversion beyond camera axes; a transforms.json's applied_transform and applied_scale are
/// undone. Pointmaps become planar depth (points that do not reproject within half a pixel of their
/// own pixel are invalid). 0 and 65535 in a 16-bit depth PNG are no measurement. Frames are read in
/// parallel; the first bad frame's Error is thrown.
/// Throws Error: no views, views without depth, mismatched sizes, corrupt files, frames out of
/// range or named twice, distortion other than zero, singular or non-rigid poses, depth without one
/// valid pixel, a pointmap of unknown scale, a scale for what is in metres already, a volume
/// without surface or without free space for a camera.
std::vector<View> readViews(const std::string& path, const ReadViewsSettings& settings = {});

/// The unit vector that points up in the world of views read from `path`: +Z for transforms.json
/// (turned back by its applied_transform), +Y for EXR, the mean of the cameras' up for .npz; for
/// .vdb the grid's own z where this program wrote it, +Y where Houdini did, else +Z.
Eigen::Vector3d conventionalUp(const std::string& path);

/// What the units of an .npz are in metres, and how that is known.
struct PointmapScale {
  double metres_per_unit = 1;
  std::string source;  // "given", "camera baseline" (extrinsic against c2w) or "c2w" (is metric)
};
/// `given`, unless it is 0, or else what the file tells. Throws Error where neither does.
PointmapScale pointmapScale(const std::string& npz_path, double given);

/// A folder that readViews() reads back: transforms.json, PNG colour, 16-bit millimetre depth PNG
/// (depth beyond 65.534 m becomes none). transforms.json is written last. Throws Error.
void writeViews(const std::vector<View>& views, const std::string& folder);

}  // namespace vdbc
