#pragma once
// Private: what all evaluations share. Results are plain structs with `scene`, `method`, `views`,
// `gaussians` and numbers; one list of a result's numbers serves JSON, means and deviations.
#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <numeric>
#include <string>
#include <vector>

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
    j[s.name] =
        std::isfinite(r.*s.value) ? nlohmann::ordered_json(r.*s.value) : nlohmann::ordered_json();
  j["gaussians"] = r.gaussians;
  return j.dump();
}

/// NaN without values.
inline double meanOf(const std::vector<double>& values) {
  return values.empty() ? kNan
                        : std::accumulate(values.begin(), values.end(), 0.) / double(values.size());
}
/// Of the sample (n - 1); NaN with fewer than two values.
inline double deviationOf(const std::vector<double>& values) {
  if (values.size() < 2) return kNan;
  const double mean = meanOf(values);
  double sum = 0;
  for (double v : values) sum += (v - mean) * (v - mean);
  return std::sqrt(sum / double(values.size() - 1));
}

/// A result of each method, in the order they appear, named `scene`: each number is `summary` of
/// its values over the scenes. Values that are NaN in a scene are left out there.
template <typename Result>
std::vector<Result> summaries(const std::vector<Result>& results,
                              const std::vector<Score<Result>>& scores, const char* scene,
                              double summary(const std::vector<double>&)) {
  std::vector<Result> all;
  for (const Result& first : results) {
    const auto same = [&](const Result& r) { return r.method == first.method; };
    if (std::any_of(all.begin(), all.end(), same)) continue;
    Result one;
    one.scene = scene, one.method = first.method, one.views = first.views;
    std::vector<double> gaussians;
    for (const Result& r : results)
      if (same(r)) gaussians.push_back(double(r.gaussians));
    const double count = summary(gaussians);
    one.gaussians = std::isfinite(count) ? std::llround(count) : 0;
    for (const auto& s : scores) {
      std::vector<double> values;
      for (const Result& r : results)
        if (same(r) && std::isfinite(r.*s.value)) values.push_back(r.*s.value);
      one.*s.value = summary(values);
    }
    all.push_back(one);
  }
  return all;
}

}  // namespace vdbc
