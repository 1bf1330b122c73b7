#include "encoder/trainer.h"

#include <torch/nn/utils/clip_grad.h>

#include <filesystem>
#include <fstream>

#include "vdb/error.h"

namespace vdbc {

namespace fs = std::filesystem;

Trainer::Trainer(std::shared_ptr<torch::nn::Module> net, std::shared_ptr<torch::nn::Module> average,
                 std::string config_key, std::string config, TrainSettings settings,
                 TrainListener listener)
    : net_(std::move(net)),
      average_(std::move(average)),
      config_key_(std::move(config_key)),
      config_(std::move(config)),
      settings_(std::move(settings)),
      listener_(std::move(listener)),
      processes_(settings_.processes),
      optimiser_(
          net_->parameters(),
          torch::optim::AdamWOptions(settings_.learning_rate).betas({.9, .98}).weight_decay(.01)) {
  require(settings_.batch >= 1 && settings_.batch % processes_.size() == 0,
          "train: expected a batch that ", processes_.size(), " processes can share evenly, found ",
          settings_.batch);
  std::error_code error;
  fs::create_directories(settings_.work_folder, error);
  require(!error, "train: ", settings_.work_folder,
          ": cannot create the folder: ", error.message());
  torch::NoGradGuard no_grad;
  for (auto& p : average_->parameters()) p.set_requires_grad(false);
  if (settings_.resume) {
    loadCheckpoint();
  } else {
    const auto from = net_->parameters(), to = average_->parameters();
    for (size_t i = 0; i < to.size(); ++i) to[i].copy_(from[i]);
    if (first()) fs::remove(settings_.work_folder + "/log.csv", error);
  }
}

void Trainer::addLoss(const Tensor& loss, const std::map<std::string, double>& values) {
  if (loss.requires_grad()) (loss / double(settings_.batch)).backward();
  for (const auto& [name, value] : values) values_[name] += value / double(settings_.batch);
}

// Gradients and logged values of all processes, in one message.
void Trainer::sumOverProcesses() {
  if (processes_.size() == 1) return;
  const auto parameters = net_->parameters();
  int64_t count = int64_t(values_.size());
  for (const Tensor& p : parameters) count += p.numel();
  Tensor all = torch::zeros({count});
  int64_t at = 0;
  for (const Tensor& p : parameters) {
    if (p.grad().defined()) all.slice(0, at, at + p.numel()).copy_(p.grad().flatten());
    at += p.numel();
  }
  for (const auto& entry : values_) all[at++] = entry.second;
  processes_.sum(&all);
  at = 0;
  for (const Tensor& p : parameters) {
    if (p.requires_grad()) {
      if (!p.grad().defined()) p.mutable_grad() = torch::zeros_like(p);
      p.mutable_grad().copy_(all.slice(0, at, at + p.numel()).view_as(p));
    }
    at += p.numel();
  }
  for (auto& entry : values_) entry.second = all[at++].item<double>();
}

void Trainer::update() {
  sumOverProcesses();
  const double rate =
      cosineRate(settings_.learning_rate, step_, settings_.steps, settings_.warmup, .02);
  static_cast<torch::optim::AdamWOptions&>(optimiser_.param_groups()[0].options()).lr(rate);
  const double norm = torch::nn::utils::clip_grad_norm_(net_->parameters(), settings_.clip_norm);
  if (std::isfinite(norm)) {
    optimiser_.step();
    // Early on the average follows closely, else it would remember the random start.
    const double decay =
        std::min(settings_.average_decay, (1.0 + double(step_)) / (10.0 + double(step_)));
    std::vector<Tensor> average = average_->parameters();
    updateAverage(average, net_->parameters(), decay);
  }
  // To none, as a run that goes on finds them: what gets no gradient in a step is left alone,
  // momentum too.
  for (const Tensor& p : net_->parameters()) p.mutable_grad() = Tensor();
  ++step_;
  auto add = [&](const std::string& name, double value) {
    running_[name].first += value;
    ++running_[name].second;
  };
  for (const auto& [name, value] : values_)
    if (std::isfinite(value)) add(name, value);
  values_.clear();
  add("skipped", std::isfinite(norm) ? 0 : 1);
}

void Trainer::log(std::map<std::string, double> values) {
  for (const auto& [name, sum] : running_) values[name] = sum.first / double(sum.second);
  running_.clear();
  const std::string path = settings_.work_folder + "/log.csv";
  const bool fresh = !fs::exists(path);
  std::ofstream out(path, std::ios::app);
  if (fresh) {
    out << "step";
    for (const auto& v : values) out << ',' << v.first;
    out << '\n';
  }
  out << step_;
  for (const auto& v : values) out << ',' << v.second;
  out << '\n';
  require(out.good(), "train: ", path, ": cannot write the log");
  if (listener_) listener_({step_, values});
}

void Trainer::saveIfDue() {
  if (!first() || (step_ % settings_.checkpoint_every != 0 && !done())) return;
  saveCheckpoint();
  saveWeights();
}

void Trainer::stopIfInterrupted(Progress& progress) {
  Tensor asked = torch::zeros({1});
  asked[0] = progress.wasInterrupted(int(100 * step_ / settings_.steps)) ? 1.f : 0.f;
  processes_.sum(&asked);
  if (asked.item<float>() == 0) return;
  if (first()) saveCheckpoint();
  throw Cancelled();
}

void Trainer::saveWeights() const {
  TensorFile file;
  addModule(*average_, "", &file);
  file.metadata = settings_.metadata;
  file.metadata[config_key_] = config_;
  file.metadata["steps"] = std::to_string(step_);
  writeTensors(file, settings_.weights_path);
}

void Trainer::saveCheckpoint() const {
  TensorFile file;
  addModule(*net_, "net.", &file);
  addModule(*average_, "average.", &file);
  for (const auto& p : net_->named_parameters()) {
    const auto found =
        optimiser_.state().find(c10::guts::to_string(p.value().unsafeGetTensorImpl()));
    if (found == optimiser_.state().end()) continue;
    const auto& state = static_cast<const torch::optim::AdamWParamState&>(*found->second);
    file.tensors["first." + p.key()] = state.exp_avg();
    file.tensors["second." + p.key()] = state.exp_avg_sq();
    file.tensors["step." + p.key()] = torch::tensor({state.step()});
  }
  file.metadata[config_key_] = config_;
  file.metadata["step"] = std::to_string(step_);
  writeTensors(file, settings_.work_folder + "/checkpoint.safetensors");
}

void Trainer::loadCheckpoint() {
  const std::string path = settings_.work_folder + "/checkpoint.safetensors";
  const TensorFile file = readTensors(path);
  const auto config = file.metadata.find(config_key_);
  require(config != file.metadata.end() && config->second == config_ && file.metadata.count("step"),
          "train: ", path, ": expected a checkpoint of this network and preset, found another");
  loadModule(*net_, "net.", file, path);
  loadModule(*average_, "average.", file, path);
  step_ = std::atoll(file.metadata.at("step").c_str());
  for (const auto& p : net_->named_parameters()) {
    const auto first = file.tensors.find("first." + p.key());
    if (first == file.tensors.end()) continue;
    auto state = std::make_unique<torch::optim::AdamWParamState>();
    state->exp_avg(first->second);
    state->exp_avg_sq(file.tensors.at("second." + p.key()));
    state->step(file.tensors.at("step." + p.key()).item<int64_t>());
    optimiser_.state()[c10::guts::to_string(p.value().unsafeGetTensorImpl())] = std::move(state);
  }
}

}  // namespace vdbc
