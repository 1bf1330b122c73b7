#pragma once
// The main job: views in, completed place out.
#include <memory>
#include <string>
#include <vector>

#include "encoder/encoder.h"
#include "mar/completer.h"
#include "splat/detail.h"
#include "splat/join.h"
#include "vdb/scene_vdb.h"

namespace vdbc {

struct SceneSettings {
  ObserveSettings observing;  // voxel and patch sizes come from the encoder's weights
  CompleteSettings completion;
  float child_threshold = .05f;  // of BCE-up, for voxels that were not observed
  bool antialias = false;        // decoded Gaussians are made for RasterSettings::antialias
  DetailSettings detail;         // what views saw comes at the resolution of their pixels
  int threads = 0;               // that a call may use; 0: those of the caller's task arena
};

/// The place as observed: fits the volume (voxels as the encoder's weights want them), carves,
/// encodes, and where asked for makes discs of the views.
Place encodeScene(const std::vector<View>& views, const Encoder& encoder,
                  const SceneSettings& settings, Progress& progress);

/// The completed place: encodes, completes. Observed tokens are those of encodeScene().
Place completeScene(const std::vector<View>& views, const Encoder& encoder,
                    const Completer& completer, const SceneSettings& settings, Progress& progress);

/// What a place looks like.
struct Scene {
  SceneVoxels voxels;
  SplatScene splats;
};
/// Voxels with colour, density and provenance, from decoded content; a voxel's probability is its
/// token's. Gaussians: the decoded ones or, where the place has its views' detail, both joined.
Scene sceneOf(const DecodedGrid& decoded, const Place& place);

/// Picture: a row of input views, then for novel views (the mean camera place, four headings) a row
/// as observed and a row as completed.
Image contactSheet(const std::vector<View>& views, const Gaussians& observed,
                   const Gaussians& completed, const Eigen::Vector3d& up);

/// Throws Error unless a file can be created at `path`; makes its folder. For before any long work.
void requireCreatable(const std::string& path);

/// Endings of the files that a completion writes beside X.vdb; X.png only from views.
constexpr const char* kPointsEnding = ".points.vdb";
constexpr const char* kSceneEndings[] = {kPointsEnding, ".ply", ".vdb"};
constexpr const char* kLatentEnding = ".latent.vdb";
constexpr const char* kPictureEnding = ".png";

/// X of an output path X.vdb. Throws Error unless X.vdb can be created beside its siblings, those
/// of kSceneEndings and `more`; called before any long work.
std::string outputStem(const std::string& vdb_path, const std::vector<std::string>& more);

/// Decodes a completed place and writes X.vdb, X.points.vdb, X.ply, X.latent.vdb and, from views,
/// X.png; returns what was written. All are written to temporary names; a failure leaves none of
/// this run's files behind.
Scene writePlace(const Place& place, const std::vector<View>& views, const Encoder& encoder,
                 const SceneSettings& settings, const std::string& stem, Progress& progress);

/// X.vdb, X.points.vdb and X.ply alone; up is the grid's z.
void writeScene(const Scene& scene, const std::string& stem, Progress& progress);

/// What views saw of a finished place: the Gaussians of `stem`.points.vdb that are not generated,
/// and what `stem`.vdb has of what they measured. Throws Error where a file is missing or
/// unreadable, or there are none.
std::shared_ptr<const Detail> readDetail(const std::string& stem, const VoxelFrame& frame);

struct Rethresholded {
  int64_t voxels = 0, gaussians = 0, dropped_voxels = 0;
};
/// Raises tau of a finished place without any network: `from`.vdb and `from`.points.vdb less the
/// generated voxels and Gaussians whose probability does not exceed tau, also those that close
/// holes (no new ones are closed), as `to`.vdb, `to`.points.vdb, `to`.ply. Throws Error where a
/// file is missing or unreadable, and if every generated voxel exceeds tau.
Rethresholded rethreshold(const std::string& from, float tau, const std::string& to,
                          Progress& progress);

}  // namespace vdbc
