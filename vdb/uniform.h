#pragma once
// Random numbers that are the same on every machine.
#include <random>

namespace vdbc {

/// In [0, 1), with 53 random bits. (What std::uniform_real_distribution draws depends on the
/// library.)
inline double uniform(std::mt19937_64& random) { return double(random() >> 11) * 0x1p-53; }
/// In [low, high).
inline double uniform(std::mt19937_64& random, double low, double high) {
  return low + (high - low) * uniform(random);
}

}  // namespace vdbc
