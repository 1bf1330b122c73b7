#pragma once
// Private: what all evaluations share. Results are plain structs with `scene`, `method`, `views`,
// `gaussians` and numbers; one list of a result's numbers serves JSON and means.
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "vdb/progress.h"

namespace vdbc {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// A number of a result: its name in JSON and where it is.
template <typename Result>
struct Score {
  const char* name;
  double Result::*value;
};

/// One JSON object; numbers that are not finite become null.
template <typename Result>
std::string scoresJson(const Result& r, const std::vector<Score<Result>>& scores) {
  nlohmann::ordered_json j{{"scene", r.scene}, {"views", r.views}, {"method", r.method}};
  for (const auto& s : scores)
    j[s.name] = std::isfinite(r.*s.value) ? nlohmann::ordered_json(r.*s.value) : nlohmann::ordered_json();
  j["gaussians"] = r.gaussians;
  return j.dump();
}

/// Mean over scenes of each method, in the order they appear, scene "mean". Values that are NaN in a scene
/// are left out there.
template <typename Result>
std::vector<Result> meanScores(const std::vector<Result>& results, const std::vector<Score<Result>>& scores) {
  std::vector<Result> means;
  for (const Result& first : results) {
    const auto same = [&](const Result& r) { return r.method == first.method; };
    if (std::any_of(means.begin(), means.end(), same)) continue;
    Result mean;
    mean.scene = "mean", mean.method = first.method;
    int64_t scenes = 0;
    for (const Result& r : results)
      if (same(r)) mean.gaussians += r.gaussians, mean.views = r.views, ++scenes;
    mean.gaussians /= scenes;
    for (const auto& s : scores) {
      double sum = 0, n = 0;
      for (const Result& r : results)
        if (same(r) && std::isfinite(r.*s.value)) sum += r.*s.value, ++n;
      mean.*s.value = n > 0 ? sum / n : kNan;
    }
    means.push_back(mean);
  }
  return means;
}

// The kernel keeps the peak; writing 5 to clear_refs starts it afresh (Linux).
inline void resetPeakMemory() { std::ofstream("/proc/self/clear_refs") << "5"; }
inline double peakMemoryMb() {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmHWM:", 0) == 0) return std::atof(line.c_str() + 6) / 1024;
  return kNan;
}

}  // namespace vdbc
