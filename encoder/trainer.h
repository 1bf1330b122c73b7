#pragma once
// Private: what both training loops share: AdamW, schedule, batches over processes, averaging,
// checkpoints, the log. Only the first process writes files and logs.
#include <torch/optim/adamw.h>

#include "encoder/layers.h"
#include "encoder/process_group.h"
#include "encoder/train_settings.h"
#include "encoder/weights.h"
#include "vdb/progress.h"

namespace vdbc {

class Trainer {
 public:
  /// `average` has the same shapes as `net`; it holds the moving average and is what gets shipped.
  /// `config_key` and `config` go into the files' metadata. With settings.resume continues from
  /// work_folder/checkpoint.safetensors; throws Error if there is none or it is of another network.
  Trainer(std::shared_ptr<torch::nn::Module> net, std::shared_ptr<torch::nn::Module> average,
          std::string config_key, std::string config, TrainSettings settings,
          TrainListener listener);

  int64_t step() const { return step_; }
  bool done() const { return step_ >= settings_.steps; }
  /// Samples of the whole training are numbered; this step's are [step * batch, (step + 1) *
  /// batch), and this process's among them:
  int64_t firstSample() const { return step_ * settings_.batch + processes_.rank() * samples(); }
  int64_t samples() const { return settings_.batch / processes_.size(); }
  /// Adds a sample's loss, or a part of it: its share of the gradient of the mean loss, and of the
  /// `values` of the log.
  void addLoss(const Tensor& loss, const std::map<std::string, double>& values);
  /// One optimiser step from all samples' gradients; skips steps whose gradient is not finite.
  void update();
  bool validationDue() const {
    return first() && (step_ % settings_.validate_every == 0 || done());
  }
  /// Writes a log row: means since the last one, and `values` of the validation.
  void log(std::map<std::string, double> values);
  void saveIfDue();
  /// Saves a checkpoint and throws Cancelled if any process was asked to stop.
  void stopIfInterrupted(Progress& progress);
  void saveWeights() const;

 private:
  bool first() const { return processes_.rank() == 0; }
  void sumOverProcesses();
  void saveCheckpoint() const;
  void loadCheckpoint();

  const OneThread one_thread_;
  std::shared_ptr<torch::nn::Module> net_, average_;
  std::string config_key_, config_;
  TrainSettings settings_;
  TrainListener listener_;
  ProcessGroup processes_;
  torch::optim::AdamW optimiser_;
  int64_t step_ = 0;
  std::map<std::string, double> values_;  // of this step, mean over its samples
  std::map<std::string, std::pair<double, int64_t>> running_;
};

}  // namespace vdbc
