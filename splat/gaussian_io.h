#pragma once
// Gaussians to files and back: INRIA PLY (formats.md 1.1) and OpenVDB points (formats.md 2.2).
#include <string>
#include <vector>

#include "splat/gaussians.h"

namespace vdbc {

/// Writes the INRIA layout: binary little endian, x y z nx ny nz f_dc f_rest opacity scale rot, LF,
/// only `float` properties. Gaussians with NaN or Inf are dropped, opacity logits clamped to +-15,
/// quaternions normalised (zero ones are dropped too). `up`, unless zero, becomes the comment
/// `Vertical axis: x y z`; `SplatRenderMode: mip` or `default` tells whether they are antialiased.
/// Temporary name, then rename. Throws Error.
void writePly(const Gaussians& gaussians, const std::string& path,
              const Eigen::Vector3f& up = Eigen::Vector3f::Zero());
/// Reads INRIA-like PLY by any conforming writer: any property order, normals and f_rest optional.
/// Gaussians with NaN or Inf are dropped, quaternions stay as they are. Comments `SplatRenderMode:
/// mip` and `antialiased 1` make them antialiased. Throws Error on anything else: truncated, no
/// splat properties, compressed PLY, lists, ASCII.
Gaussians readPly(const std::string& path);

/// Per-Gaussian provenance that only the VDB points file carries (decision 4 of the design).
struct Provenance {
  std::vector<uint8_t> generated;  // [N] 0 or 1
  std::vector<float> probability;  // [N] 0-1
  bool recorded = false;           // read from the file, which has both or one of them

  int64_t size() const { return int64_t(generated.size()); }

  template <typename Self>
  static auto columns(Self& p) {
    return std::make_tuple(column("generated", p.generated), column("probability", p.probability));
  }
};

/// One points grid `splats`: P fixed point 16 bit, scale vec3s (half, if all sigmas are within its
/// normal range, else 16 significant bits), orient quats (x y z w, 16 significant bits), GS_Alpha,
/// Cd scene-linear half, GS_SPH_R/G/B half[(degree + 1)^2] (not for degree 0: Cd is all its
/// colour), `probability`, group `completed` (generated ones). Metadata: counts, `sh_degree`,
/// `splat_render_mode` (`mip` if antialiased, or `default`). Voxel size is chosen for about 8
/// points a voxel. Points are sorted by voxel, so the order of Gaussians is not kept. Empty
/// provenance means observed, 1. Drops and normalises as writePly() does. Temporary name, then
/// rename. Throws Error.
void writePointsVdb(const Gaussians& gaussians, const Provenance& provenance,
                    const std::string& path);
/// Reads the points grid `splats` (or else the first points grid) with attributes P, scale, orient,
/// GS_Alpha and GS_SPH_R/G/B (or Cd alone); `provenance` defaults to observed, 1 where the file has
/// none. Throws Error on other points, other grids, corrupt files.
Gaussians readPointsVdb(const std::string& path, Provenance* provenance = nullptr);

}  // namespace vdbc
