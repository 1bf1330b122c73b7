#include "examples/rooms/light_cache.h"

#include <array>

namespace vdbc {

using Eigen::Vector3f;

LightCache::LightCache(const std::vector<Sample>& samples) {
  const size_t count = samples.size();
  int bits = 4;
  while (size_t(1) << bits < count * 3) ++bits;
  table_.resize(size_t(1) << bits);
  shift_ = 64 - bits;
  // Cells are numbered in the order of samples, each after those of its coarser levels.
  std::vector<std::array<int32_t, kLevels>> cells(count);
  std::vector<int32_t> parent;
  for (size_t s = 0; s < count; ++s)
    for (int level = kLevels - 1; level >= 0; --level) {
      const uint64_t key = cellKey(samples[s].position, samples[s].normal, level);
      size_t i = slot(key);
      while (table_[i].cell >= 0 && table_[i].key != key) i = (i + 1) & (table_.size() - 1);
      if (table_[i].cell < 0) {
        table_[i] = {key, int32_t(parent.size())};
        parent.push_back(level + 1 < kLevels ? cells[s][size_t(level + 1)] : -1);
      }
      cells[s][size_t(level)] = table_[i].cell;
    }
  const size_t cell_count = parent.size();
  std::vector<Vector3f> direct(cell_count, Vector3f::Zero()), bounced(cell_count);
  std::vector<float> weight(cell_count, 0), links(cell_count, 0);
  Vector3f direct_mean = Vector3f::Zero();
  float link_count = 0;
  for (size_t s = 0; s < count; ++s) {
    direct_mean += samples[s].direct;
    link_count += samples[s].link != kUnknown;
    for (int32_t c : cells[s]) {
      direct[size_t(c)] += samples[s].direct, weight[size_t(c)] += 1;
      links[size_t(c)] += samples[s].link != kUnknown;
    }
  }
  direct_mean /= std::max(1.f, float(count));
  for (size_t c = 0; c < cell_count; ++c) {
    const Vector3f& prior = parent[c] < 0 ? direct_mean : direct[size_t(parent[c])];
    direct[c] = (direct[c] + kPrior * prior) / (weight[c] + kPrior);
  }
  // Each round adds a bounce to what the links bring.
  irradiance_ = direct;
  for (int bounce = 0; bounce < 24; ++bounce) {
    std::fill(bounced.begin(), bounced.end(), Vector3f::Zero());
    Vector3f bounced_mean = Vector3f::Zero();
    for (size_t s = 0; s < count; ++s) {
      if (samples[s].link < 0) continue;
      const Sample& next = samples[size_t(samples[s].link)];
      Vector3f light = irradiance_[size_t(cells[size_t(samples[s].link)][0])];
      if (samples[s].link_sees_spots) light += next.sun;
      light = light.cwiseProduct(samples[s].link_weight).cwiseProduct(next.albedo);
      bounced_mean += light;
      for (int32_t c : cells[s]) bounced[size_t(c)] += light;
    }
    bounced_mean /= std::max(1.f, link_count);
    float change = 0, total = 0;
    for (size_t c = 0; c < cell_count; ++c) {
      const Vector3f& prior = parent[c] < 0 ? bounced_mean : bounced[size_t(parent[c])];
      bounced[c] = (bounced[c] + kPrior * prior) / (links[c] + kPrior);
      const Vector3f next = direct[c] + bounced[c];
      change += (next - irradiance_[c]).sum(), total += next.sum();
      irradiance_[c] = next;
    }
    mean_ = direct_mean + bounced_mean;
    if (change <= 1e-3f * total) break;
  }
}

}  // namespace vdbc
