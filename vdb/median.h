#pragma once
// Private: the median that estimates of noise rest on.
#include <algorithm>
#include <cstddef>
#include <vector>

namespace vdbc {

/// The upper median, 0 of nothing. Reorders `values`.
inline double median(std::vector<double>* values) {
  if (values->empty()) return 0;
  const auto middle = values->begin() + std::ptrdiff_t(values->size() / 2);
  std::nth_element(values->begin(), middle, values->end());
  return *middle;
}

}  // namespace vdbc
