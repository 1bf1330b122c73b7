#pragma once
// A place as a .vdb file: what the decoder takes and the completer goes on from.
#include <string>

#include "vdb/place.h"

namespace vdbc {

/// Writes a points grid `latent` with one point at each node's centre: P, z (half, stride dim),
/// probability, bfs_level, generated, row; bool grids `filled` and `empty` of the voxels seen;
/// metadata: latent_level, latent_dim, encoder_hash, growth, the frame (exactly), the volume,
/// counts. All but z, which is rounded to half precision, reads back bit for bit, rows in their
/// order. A checksum follows. Temporary name, then rename. docs/formats.md. Throws Error
/// for arrays of different lengths, tokens outside the volume or twice the same, values that are
/// not finite or too large for a half, and where the file cannot be written.
void writeLatentVdb(const Place& place, const std::string& path);

/// Reads what writeLatentVdb wrote, also when another program wrote the file again. Throws Error on
/// files that are missing, corrupt, lack a part or say what cannot be.
Place readLatentVdb(const std::string& path);

}  // namespace vdbc
