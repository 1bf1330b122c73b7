#include "mar/thinning.h"

#include <algorithm>
#include <array>

#include "vdb/token_map.h"

namespace vdbc {
namespace {

// Chosen on tuning rooms 200-206 and the kitchen: to count what was seen too, and to take more
// for a surface, is more precise in rooms, but costs captures recall.
constexpr float kAsLikely = .8f;
constexpr int kThickest = 3;  // tokens: 60 cm

}  // namespace

std::vector<uint8_t> thickTokens(const Place& asked) {
  const TokenMap<float> likely(asked.ijk, asked.probability);
  const auto at = [&](const Coord& c) {
    const float* p = likely.find(c);
    return p ? *p : 0;
  };
  const auto beside = [](Coord c, int axis, int step) {
    c[axis] += step;
    return c;
  };
  std::vector<uint8_t> thick;
  for (size_t i = 0; i < asked.ijk.size(); ++i) {
    const Coord& c = asked.ijk[i];
    const float p = asked.probability[i];
    std::array<int, 3> run = {1, 1, 1};
    for (int axis = 0; axis < 3; ++axis)
      for (int side : {-1, 1})
        for (int step = 1; run[size_t(axis)] <= kThickest; ++step, ++run[size_t(axis)])
          if (at(beside(c, axis, side * step)) < kAsLikely * p) break;
    const auto thinnest = std::min_element(run.begin(), run.end());
    const int axis = int(thinnest - run.begin());
    thick.push_back(*thinnest <= kThickest &&
                    (at(beside(c, axis, -1)) > p || at(beside(c, axis, 1)) > p));
  }
  return thick;
}

}  // namespace vdbc
