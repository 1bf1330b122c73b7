#pragma once
// Gaussians as INRIA's PLY (docs/formats.md).
#include <string>

#include "splat/gaussians.h"

namespace vdbc {

/// Writes the INRIA layout: binary little endian, x y z nx ny nz f_dc f_rest opacity scale rot, LF,
/// only `float` properties. Gaussians with NaN or Inf are dropped, opacity logits clamped to +-15,
/// quaternions normalised (zero ones are dropped too). `up`, unless zero, becomes the comment
/// `Vertical axis: x y z`; `SplatRenderMode: mip` or `default` tells whether they are antialiased.
/// Temporary name, then rename. Throws Error.
void writePly(const Gaussians& gaussians, const std::string& path,
              const Eigen::Vector3f& up = Eigen::Vector3f::Zero());

/// The step (metres) between the single-precision numbers by which a PLY says where these Gaussians
/// are, at the farthest from the world's origin.
double plyStep(const Gaussians& gaussians);

/// Reads INRIA-like PLY by any conforming writer: any property order, normals and f_rest optional.
/// Gaussians with NaN or Inf are dropped, quaternions stay as they are. Comments `SplatRenderMode:
/// mip` and `antialiased 1` make them antialiased. Throws Error on anything else: truncated, no
/// splat properties, compressed PLY, lists, ASCII.
Gaussians readPly(const std::string& path);

}  // namespace vdbc
