#pragma once
// Private: what a scene is to the networks: tokens of both levels, chunks of targets, and what is
// put around a chunk. Shared by growth, refinement and training.
#include "mar/network.h"
#include "vdb/seen.h"
#include "vdb/token_map.h"

namespace vdbc {

/// What is known of a scene or a window of it; lists by x, then y, then z.
struct SceneTokens {
  SeenSpace nodes, coarse;           // levels 1 and 2
  std::vector<Coord> empty_shell;    // level-1 E nodes with an unobserved neighbour
  std::vector<Coord> coarse_filled;  // level-2 nodes with an F voxel
  std::vector<Coord> coarse_empty;   // level-2 E nodes with an unobserved neighbour
};
SceneTokens sceneTokens(const SeenSpace& nodes, const SeenSpace& coarse);
/// The part in a box of voxels, which may reach beyond what is known.
SceneTokens sceneIn(const SceneTokens& scene, const CoordBBox& voxels);

/// The coarse stage's probability of coarse nodes; 1 where they are filled.
using Gate = TokenMap<float>;

/// Inputs of the coarse stage for some target positions; `visible` are filled in truth.
TokenSets coarseInputs(const SceneTokens& scene, const std::vector<Coord>& visible,
                       const std::vector<Coord>& targets, int empty_tokens);

/// The coarse stage's probability of a chunk of unknown nodes, as inference asks for it; 1 without
/// a coarse stage. [targets].
std::vector<float> coarseProbability(CompleterNet& net, const SceneTokens& scene,
                                     const std::vector<Coord>& targets, const VoxelFrame& frame);

/// Level-1 nodes of the given coarse nodes that were not observed.
std::vector<Coord> unobservedChildren(const std::vector<Coord>& coarse, const SeenSpace& nodes);

/// The `count` of `coords` nearest to `centre`, by distance, ties by row: row indices.
std::vector<int64_t> nearestRows(const std::vector<Coord>& coords, const Eigen::Vector3d& centre,
                                 int64_t count);
/// Their coordinates.
std::vector<Coord> nearestOf(const std::vector<Coord>& coords, const Eigen::Vector3d& centre,
                             int64_t count);
Eigen::Vector3d centreOf(const std::vector<Coord>& coords);

/// Parts of at most `size`, about equal, of tokens that lie together.
std::vector<std::vector<Coord>> chunksOf(const std::vector<Coord>& tokens, int64_t size);

/// Inputs of the fine stage for a chunk of targets, all but the features of the context.
struct FineChunk {
  TokenSets tokens;
  /// Rows of the context that became condition and visible tokens: their features.
  std::array<std::vector<int64_t>, 2> rows;
};
/// Around `centre`: the `context_tokens` nearest of `context`, of which the first `conditions` are
/// condition tokens and the others visible, and the nearest of the empty shell. Targets carry the
/// gate's probability of their parent, 0 where it has none.
FineChunk fineChunk(const SceneTokens& scene, const Gate& gate, const std::vector<Coord>& context,
                    int64_t conditions, const std::vector<Coord>& targets,
                    const Eigen::Vector3d& centre, int context_tokens, int empty_tokens);

}  // namespace vdbc
