#pragma once
// The Z-order curve (Morton 1966): neighbours on it are mostly neighbours in space.
#include <cstdint>

namespace vdbc {

/// The place of cell (x, y, z) on the curve: the low 21 bits of the three in turn, x's first.
inline uint64_t zOrderCode(uint64_t x, uint64_t y, uint64_t z) {
  const auto spread = [](uint64_t v) {  // to every third bit
    v &= 0x1fffff;
    v = (v | v << 32) & 0x1f00000000ffffull;
    v = (v | v << 16) & 0x1f0000ff0000ffull;
    v = (v | v << 8) & 0x100f00f00f00f00full;
    v = (v | v << 4) & 0x10c30c30c30c30c3ull;
    return (v | v << 2) & 0x1249249249249249ull;
  };
  return spread(x) << 2 | spread(y) << 1 | spread(z);
}

}  // namespace vdbc
