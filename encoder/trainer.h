#pragma once
// Private: what both training loops share: AdamW, schedule, averaging, checkpoints, the log.
#include <torch/optim/adamw.h>

#include "encoder/layers.h"
#include "encoder/train_settings.h"
#include "encoder/weights.h"

namespace vdbc {

class Trainer {
 public:
  /// `average` has the same shapes as `net`; it holds the moving average and is what gets shipped.
  /// `config_key` and `config` go into the files' metadata. With settings.resume continues from
  /// work_folder/checkpoint.safetensors; throws Error if there is none or it is of another network.
  Trainer(std::shared_ptr<torch::nn::Module> net, std::shared_ptr<torch::nn::Module> average,
          std::string config_key, std::string config, TrainSettings settings, TrainListener listener);

  int64_t step() const { return step_; }
  bool done() const { return step_ >= settings_.steps; }
  /// One optimiser step from the gradients that backward() left; skips steps whose gradient is not
  /// finite. Adds `values` to the running means of the log.
  void update(const std::map<std::string, double>& values);
  bool validationDue() const { return step_ % settings_.validate_every == 0 || done(); }
  /// Writes a log row: means since the last one, and `values` of the validation.
  void log(std::map<std::string, double> values);
  void saveIfDue();
  void saveCheckpoint() const;
  void saveWeights() const;

 private:
  void loadCheckpoint();

  std::shared_ptr<torch::nn::Module> net_, average_;
  std::string config_key_, config_;
  TrainSettings settings_;
  TrainListener listener_;
  torch::optim::AdamW optimiser_;
  int64_t step_ = 0;
  std::map<std::string, std::pair<double, int64_t>> running_;
};

}  // namespace vdbc
