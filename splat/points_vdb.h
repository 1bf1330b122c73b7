#pragma once
// Gaussians as OpenVDB points (docs/formats.md).
#include <cstdint>
#include <string>
#include <vector>

#include "splat/gaussians.h"

namespace vdbc {

/// Where each Gaussian comes from, which only the VDB points file carries.
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
/// points a voxel. The grid's transform places its origin at the Gaussians' own, in double
/// precision. Points are sorted by voxel, so the order of Gaussians is not kept. Empty
/// provenance means observed, 1. Drops and normalises as writePly() does. Temporary name, then
/// rename. Throws Error.
void writePointsVdb(const Gaussians& gaussians, const Provenance& provenance,
                    const std::string& path);

/// Reads the points grid `splats` (or else the first points grid) with attributes P, scale, orient,
/// GS_Alpha and GS_SPH_R/G/B (or Cd alone); `provenance` defaults to observed, 1 where the file has
/// none. Their origin is the grid's, or the first voxel where that is farther than 10 km. Throws
/// Error on other points, other grids, corrupt files.
Gaussians readPointsVdb(const std::string& path, Provenance* provenance = nullptr);

}  // namespace vdbc
