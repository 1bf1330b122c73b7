#pragma once
// Private: a place grows from what was observed: the coarse gate, then tokens level by level, then
// the observed ones rewritten where asked for (paper sec. 4).
#include <functional>

#include "mar/completer.h"
#include "mar/context.h"
#include "mar/windows.h"

namespace vdbc {

/// The growing place, observed rows first; `z` [N, D] has its latents standardised.
struct Growth {
  Place place;
  Tensor z;
  std::vector<Coord> observed;
  int64_t given = 0;  // rows that growth began with

  int64_t seeds() const { return int64_t(observed.size()); }
  void append(const Place& more, CompleterNet& net);
};

/// The rows of `start` to go on from; `dropped` gets those that a completion cut short had dropped.
/// Throws Error for latents of other sizes, without observed tokens, and observed ones that do not
/// come first.
Growth beginGrowth(CompleterNet& net, const Place& start, const CompleteSettings& settings,
                   Place* dropped);

/// What is known of a whole place.
struct GrowthScene {
  SceneTokens tokens;
  Windows windows;
  Gate gate;
};
GrowthScene growthScene(const Place& start, const CompleterConfig& config);

/// Asks the coarse stage wherever growth can get to: chunks of unknown nodes that touch what is
/// filled, then those that touch an open node. A node is open where its probability exceeds
/// `coarse_tau` and it is filled or an open node touches it: nothing grows out of nothing. The open
/// nodes, by x, then y, then z.
std::vector<Coord> openGate(CompleterNet& net, float coarse_tau, GrowthScene* scene,
                            Progress& progress);

/// Visits candidates level by level; keeps those that `keep` accepts given their probability, the
/// others are added to `dropped`. Levels are distances from what was observed, whatever of them is
/// done already or may not be generated.
void growLevels(CompleterNet& net, const GrowthScene& scene, const std::vector<Coord>& candidates,
                const CompleteSettings& settings, const std::function<bool(float)>& keep,
                Progress& progress, const LevelListener& listener, Growth* growth, Place* dropped);

/// Moves to `dropped` what only thickens surfaces (mar/thinning.h); what was given stays.
void thinSurfaces(Growth* growth, Place* dropped);

/// Condition latents rewritten from everything that was decoded, chunk by chunk.
void refineObserved(CompleterNet& net, const GrowthScene& scene, const CompleteSettings& settings,
                    Growth* growth);

}  // namespace vdbc
