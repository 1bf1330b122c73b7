#pragma once
// For the benchmark of rooms: the rays that renderers trace.
#include <embree3/rtcore.h>

#include <atomic>
#include <mutex>
#include <vector>

namespace vdbc {

/// Packets in the order in which they are traced.
class RayLog {
 public:
  struct Packet {
    alignas(64) RTCRay16 ray;
    alignas(64) int valid[16];
    bool is_coherent, is_shadow;
  };

  void add(const int* valid, const RTCRay16& ray, bool is_coherent, bool is_shadow) {
    const std::lock_guard<std::mutex> lock(mutex_);
    packets_.push_back({ray, {}, is_coherent, is_shadow});
    for (int k = 0; k < 16; ++k) packets_.back().valid[k] = valid[k];
  }
  const std::vector<Packet>& packets() const { return packets_; }

 private:
  std::mutex mutex_;
  std::vector<Packet> packets_;
};

/// Where every renderer of the process writes its rays; null, as it is normally: nowhere.
extern std::atomic<RayLog*> ray_log;

}  // namespace vdbc
