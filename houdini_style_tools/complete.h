#pragma once
// The main job: views in, completed place out.
#include <optional>
#include <string>
#include <vector>

#include "encoder/encoder.h"
#include "mar/completer.h"
#include "vdb/scene_volume.h"

namespace vdbc {

struct SceneSettings {
  VolumeSettings volume;          // voxel size comes from the encoder's weights
  CarveSettings carving;
  CompleteSettings completion;
  float child_threshold = .05f;   // of BCE-up, for voxels that were not observed
};

/// A completed place, before it is written.
struct Completion {
  Observation observation;
  LatentGrid seen, whole;         // latents of the observed tokens; the same and generated ones
  DecodedGrid seen_decoded, whole_decoded;
};

/// What was observed, encoded.
struct Encoding {
  Observation observation;
  LatentGrid latents;
};

/// Fits the volume (voxels as the encoder's weights want them), carves, pools pixels into voxels.
Observation observeScene(const std::vector<View>& views, const Encoder& encoder,
                         const SceneSettings& settings, Progress& progress);

/// Carves and encodes.
Encoding encodeScene(const std::vector<View>& views, const Encoder& encoder,
                     const SceneSettings& settings, Progress& progress);

/// Carves, encodes, completes, decodes. Observed tokens of `whole` are bit-identical to `seen`.
Completion completeScene(const std::vector<View>& views, const Encoder& encoder,
                         const Completer& completer, const SceneSettings& settings,
                         Progress& progress);

/// Voxels with colour, density and provenance, from decoded content.
SceneVoxels sceneVoxels(const DecodedGrid& decoded, const LatentGrid& latents, const ObservedSpace& space);
/// Provenance of each Gaussian.
Provenance gaussianProvenance(const SceneVoxels& voxels, int64_t gaussians_per_voxel);

/// Picture: a row of input views, then for novel views (the mean camera place, four headings) a row as
/// observed and a row as completed.
Image contactSheet(const std::vector<View>& views, const Completion& completion,
                   const Eigen::Vector3d& up);

/// Throws Error unless a file can be created at `path`; makes its folder. For before any long work.
void requireCreatable(const std::string& path);

/// Throws Error unless X.vdb can be created beside its siblings (X.png only `with_picture`); called
/// before any long work. Returns X of an output path X.vdb.
std::string outputStem(const std::string& vdb_path, bool with_picture = true);

/// X.vdb, X.points.vdb, X.ply and X.png. All are written to temporary names; a failure leaves none of
/// this run's files behind.
void writeCompletion(const std::vector<View>& views, const Completion& completion, const std::string& stem,
                     const Eigen::Vector3d& up, Progress& progress);

/// The same without X.png, from decoded latents alone; up is the grid's z.
void writeDecoded(const DecodedGrid& decoded, const LatentGrid& latents, const ObservedSpace& space,
                  const std::string& stem, Progress& progress);

}  // namespace vdbc
