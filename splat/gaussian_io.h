#pragma once
// Gaussians to files and back: INRIA PLY (formats.md 1.1) and OpenVDB points (formats.md 2.2).
#include <string>
#include <vector>

#include "splat/gaussians.h"

namespace vdbc {

/// Writes the INRIA layout: binary little endian, x y z nx ny nz f_dc f_rest opacity scale rot, LF,
/// only `float` properties. Gaussians with NaN or Inf are dropped, opacity logits clamped to +-15,
/// quaternions normalised (zero ones are dropped too). `up`, unless zero, becomes the comment
/// `Vertical axis: x y z`. Temporary name, then rename. Throws Error.
void writePly(const Gaussians& gaussians, const std::string& path,
              const Eigen::Vector3f& up = Eigen::Vector3f::Zero());
/// Reads INRIA-like PLY by any conforming writer: any property order, normals and f_rest optional.
/// Gaussians with NaN or Inf are dropped, quaternions stay as they are.
/// Throws Error on anything else: truncated, no splat properties, compressed PLY, lists, ASCII.
Gaussians readPly(const std::string& path);

/// Per-Gaussian provenance that only the VDB points file carries (decision 4 of the design).
struct Provenance {
  std::vector<uint8_t> generated;  // [N] 0 or 1
  std::vector<float> probability;  // [N] 0-1
};

/// One points grid `splats`: P fixed point 16 bit, scale vec3s, orient quats (x y z w), GS_Alpha,
/// Cd scene-linear, GS_SPH_R/G/B float[16], groups `completed` (generated ones), `probability`.
/// Counts are mirrored in metadata. Voxel size is chosen for about 8 points a voxel. Points are
/// sorted by voxel, so the order of Gaussians is not kept. Empty provenance means observed, 1.
/// Drops and normalises as writePly() does. Temporary name, then rename. Throws Error.
void writePointsVdb(const Gaussians& gaussians, const Provenance& provenance,
                    const std::string& path);
/// Reads the points grid `splats` (or else the first points grid) with attributes P, scale, orient,
/// GS_Alpha and GS_SPH_R/G/B (or Cd alone); `provenance` defaults to observed, 1 where the file has
/// none. Throws Error on other points, other grids, corrupt files.
Gaussians readPointsVdb(const std::string& path, Provenance* provenance = nullptr);

}  // namespace vdbc
