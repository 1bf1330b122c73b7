#pragma once
// Private: sums over the processes of a training, by libtorch's c10d with Gloo.
#include <memory>

#include "encoder/layers.h"
#include "encoder/train_settings.h"

namespace vdbc {

class ProcessGroup {
 public:
  /// Waits for the others at the first process's address; alone (size 1) does nothing. Throws Error
  /// where they cannot be reached within five minutes.
  explicit ProcessGroup(const TrainProcesses& processes);
  ~ProcessGroup();
  int rank() const { return rank_; }
  int size() const { return size_; }
  /// Replaces float32 values by their sum over all processes, which all call it in the same order.
  void sum(Tensor* values);

 private:
  struct Impl;
  int rank_, size_;
  std::unique_ptr<Impl> impl_;
};

}  // namespace vdbc
