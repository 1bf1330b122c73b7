#pragma once
// How long and how to train; shared by the encoder's and the completer's training.
#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "splat/view.h"

namespace vdbc {

/// All views of scene `index`; the same views for the same index. Training knows nothing else about
/// where scenes come from.
using SceneSource = std::function<std::vector<View>(uint64_t index)>;

/// The processes that train together, a thread each; every one works on its share of every step's
/// samples.
struct TrainProcesses {
  int rank = 0, size = 1;
  std::string address = "127.0.0.1";  // where the process of rank 0 listens
  uint16_t port = 29500;
};

struct TrainSettings {
  std::string weights_path;  // result: averaged weights (safetensors)
  std::string work_folder;   // checkpoint, log.csv, validation pictures
  int64_t steps = 4000;
  int64_t batch = 1;  // samples a step, their gradients averaged; a multiple of the processes
  /// Of the completer: fine samples of each, behind its one coarse sample; they count as one.
  int64_t fine_draws = 1;
  TrainProcesses processes;
  bool mixed_precision = false;  // matrix products in bfloat16; parameters and sums stay float32
  double learning_rate = 8e-4;   // peak; linear warm-up, then cosine to 2 %
  int64_t warmup = 150;
  double average_decay = .998;  // of the exponential moving average that is shipped
  double clip_norm = 1;
  int64_t validate_every = 250;
  int64_t checkpoint_every = 250;
  uint64_t seed = 1;
  bool resume = false;
  std::string from;  // weights to start from instead of random ones; "" or of the same shapes
  std::map<std::string, std::string> metadata;  // goes into the weights: scenes trained on, ...
};

/// One line of the log: what `validate_every` steps gave.
struct TrainLogRow {
  int64_t step = 0;
  std::map<std::string, double> values;
};
using TrainListener = std::function<void(const TrainLogRow&)>;

}  // namespace vdbc
