#include "examples/lab/judge.h"

#include <algorithm>
#include <cmath>

#include "examples/lab/scores.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

constexpr float kBlockedM = .3f, kRightM = .1f, kRightShare = .05f;

using Lookup = openvdb::tree::ValueAccessor<const TokenMask>;

bool hasNeighbour(const Lookup& mask, const Coord& ijk) {
  for (const Coord& c : CoordBBox(ijk.offsetBy(-1), ijk.offsetBy(1)))
    if (mask.isValueOn(c)) return true;
  return false;
}

double share(int64_t part, int64_t whole) {
  return whole > 0 ? double(part) / double(whole) : kNan;
}

Scores scoresOf(int64_t hits, int64_t decided, int64_t found, int64_t truth) {
  Scores s{share(hits, decided), share(found, truth), 0};
  if (s.precision > 0 && s.recall > 0) s.f1 = 2 * s.precision * s.recall / (s.precision + s.recall);
  if (truth == 0) s.f1 = kNan;
  return s;
}

}  // namespace

VoxelVerdict judgeVoxels(const SeenSpace& input, const SeenSpace& all,
                         const std::vector<Coord>& filled) {
  require(input.level == 0 && all.level == 0, "judgeVoxels: expected states of voxels");
  StateLookup given(input), known(all);
  const Lookup solid(all.filled);
  TokenMask generated;
  VoxelVerdict v;
  int64_t near_hits = 0;
  for (const Coord& ijk : filled) {
    if (given(ijk) != NodeState::kUnobserved || generated.isValueOn(ijk)) continue;
    generated.setValueOn(ijk);
    const NodeState state = known(ijk);
    v.confirmed += state == NodeState::kFilled, v.contradicted += state == NodeState::kEmpty;
    v.undecided += state == NodeState::kUnobserved;
    near_hits += state != NodeState::kUnobserved && hasNeighbour(solid, ijk);
  }
  const Lookup made(generated);
  int64_t truth = 0, near_found = 0;
  for (const Coord& ijk : filledNodes(all)) {
    if (given(ijk) != NodeState::kUnobserved) continue;
    ++truth, near_found += hasNeighbour(made, ijk);
  }
  const int64_t decided = v.confirmed + v.contradicted;
  v.exact = scoresOf(v.confirmed, decided, v.confirmed, truth);
  v.near = scoresOf(near_hits, decided, near_found, truth);
  return v;
}

PixelVerdict judgePixels(const std::vector<float>& depth, const std::vector<float>& truth) {
  require(depth.size() == truth.size(), "judgePixels: expected as many depths as true ones");
  int64_t n = 0, blocked = 0, right = 0, behind = 0, open = 0;
  for (size_t i = 0; i < truth.size(); ++i) {
    if (!(truth[i] > 0) || !std::isfinite(truth[i])) continue;
    ++n;
    const float off = depth[i] - truth[i], slack = std::max(kRightM, kRightShare * truth[i]);
    if (!(depth[i] > 0))
      ++open;
    else if (std::abs(off) <= slack)
      ++right;
    else if (off > 0)
      ++behind;
    else if (off < -kBlockedM)
      ++blocked;
  }
  return {share(blocked, n), share(right, n), share(behind, n), share(open, n)};
}

}  // namespace vdbc
