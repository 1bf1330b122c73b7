#pragma once
// One posed RGB-D view, and the readers that make views from files (formats.md 3).
#include <string>
#include <vector>

#include "splat/image.h"
#include "vdb/camera.h"
#include "vdb/carve.h"

namespace vdbc {

/// A posed view. Pointmaps become planar depth when read (points that do not reproject within half
/// a pixel of their own pixel are invalid), so there is one representation. Spec E1, E2.
struct View {
  std::string name;          // file name, for messages and contact sheets
  Camera camera;             // OpenCV axes, camera-to-world, metres
  Image colour;              // [H, W, 3] display sRGB, 0-1
  std::vector<float> depth;  // [H * W] planar z, metres; 0 where there is none

  DepthView depthView() const { return {camera, depth.data()}; }
};

struct ReadViewsSettings {
  std::vector<int> frames;  // indices into the folder's frames; empty = all
  int max_side = 0;  // shrink so that the longer side is at most this; 0 = as stored. Colour is
                     // area-averaged, depth takes the nearest sample
  bool cameras_only =
      false;  // colour and depth stay empty and need not be there; max_side is not heeded
  double metres_per_unit = 0;  // of an .npz; 0 = from the file (PointmapScale), if it tells
};

/// Reads views from: a folder with transforms.json, a transforms.json, an .exr or a folder of .exr
/// with Z or P and worldToCamera + worldToNDC, pointmaps (.npz, docs/formats.md), or a level set or
/// fog volume (.vdb), of which views are made by ray casting. Adds no frame
/// conversion beyond camera axes; a transforms.json's applied_transform and applied_scale are
/// undone. 0 and 65535 in a 16-bit depth PNG are no measurement. Frames are read in parallel; the
/// first bad frame's Error is thrown.
/// Throws Error: no views, views without depth, mismatched sizes, corrupt files, frames out of
/// range, distortion other than zero, singular or non-rigid poses, depth without one valid pixel, a
/// pointmap of unknown scale, a scale for what is in metres already, a volume without surface or
/// without free space for a camera.
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

/// A channel of an EXR: values[i * stride] of pixel i, row-major from the top. Scene-linear for
/// colours, metres for Z.
struct ExrChannel {
  std::string name;  // R, G, B, A, Z, N.X, ...
  const float* values = nullptr;
  size_t stride = 1;
  bool is_half = true;  // stored as half, else as float
};

/// Planar Z of a pixel without depth, as Blender writes it.
constexpr float kNoDepth = 1e10f;

/// One EXR with spec-conforming worldToCamera and worldToNDC. Temporary name, then rename. Throws
/// Error.
void writeExr(const Camera& camera, const std::vector<ExrChannel>& channels,
              const std::string& path);

/// One multi-channel EXR (half RGB scene-linear, float Z planar) with spec-conforming worldToCamera
/// and worldToNDC; pixels without depth get 1e10. Temporary name, then rename. Throws Error.
void writeViewExr(const View& view, const std::string& path);

}  // namespace vdbc
