#pragma once
// Private: what a training step hides from the completer (paper sec. 4; docs/method.md,
// section 5.3).
#include "encoder/layers.h"
#include "mar/completer_train.h"

namespace vdbc {

/// A random share (.3-1) of the unknown coarse nodes, split into what is shown and what is asked.
struct CoarseMask {
  std::vector<Coord> visible;  // filled in truth
  std::vector<Coord> targets;  // the rest, whatever it is; the loss is on these
};
/// Half of the masks hide everything, which is what inference asks; half a random .5-1 of the
/// truth.
CoarseMask drawCoarseMask(const std::vector<Coord>& unknown, const SeenSpace& truth,
                          torch::Generator& random);

/// Which tokens a roll-out might have made when it comes to its next level: a partition of the
/// candidates.
struct FineMask {
  std::vector<Coord> visible;        // filled in truth
  std::vector<Coord> false_visible;  // not filled, yet taken for it: up to the given share
  std::vector<Coord> frontier;       // asked next: one BFS level, or one step from what is visible
  std::vector<Coord> others;         // hidden, or visited and rejected
};
/// `alone_share` show nothing but the condition tokens and ask about one BFS level, any of them,
/// which is what growth does; an eighth are growth states that see what they made (BFS depth 0-5),
/// an eighth hide a random .5-1 of the truth.
FineMask drawFineMask(const std::vector<Coord>& candidates, const CompletionSample& sample,
                      const CompleterConfig& config, torch::Generator& random);

/// Bounds of a larger volume around the sample's, or of a window cut from it: each side moves by up
/// to 2.8 m outwards or a quarter of its length inwards, in whole coarse nodes, to at most 16 m.
/// `window_share` of the draws move; the others, and those that would hold nothing filled, are the
/// sample's own.
CoordBBox drawBounds(const CompletionSample& sample, const CompleterConfig& config,
                     torch::Generator& random);

}  // namespace vdbc
