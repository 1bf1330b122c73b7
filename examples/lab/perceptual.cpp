#include "examples/lab/perceptual.h"

#include <ATen/ops/empty.h>
#include <torch/csrc/jit/serialization/import.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "vdb/error.h"

namespace vdbc {
namespace {

at::Tensor tensorOf(const Image& image) {
  at::Tensor t = at::empty({1, 3, image.height, image.width});
  float* to = t.data_ptr<float>();
  const size_t pixels = size_t(image.width) * size_t(image.height);
  for (size_t i = 0; i < pixels; ++i)
    for (size_t c = 0; c < 3; ++c)
      to[c * pixels + i] = 2 * std::clamp(image.data[3 * i + c], 0.f, 1.f) - 1;
  return t;
}

/// A TorchScript file and the option it came with, for messages.
struct ScriptedNet {
  ScriptedNet(const std::string& option, const std::string& path) : source(option + ": " + path) {
    require(std::filesystem::is_regular_file(path), source,
            ": no such file (expected a TorchScript network; none comes with the program)");
    try {
      net = torch::jit::load(path);
      net.eval();
    } catch (const std::exception& e) {
      throw Error(joinText(source, ": not a TorchScript network: ", firstLine(e)));
    }
    require(bool(net.find_method("forward")), source, ": the network has no method forward");
  }

  at::IValue run(std::vector<const Image*> images) {
    const Image& first = *images[0];
    std::vector<at::IValue> inputs;
    for (const Image* i : images) {
      require(i->channels == 3 && i->width == first.width && i->height == first.height, source,
              ": expected images of 3 channels and one size, found ", first.width, " x ",
              first.height, " x ", first.channels, " and ", i->width, " x ", i->height, " x ",
              i->channels);
      inputs.emplace_back(tensorOf(*i));
    }
    try {
      const at::NoGradGuard no_gradients;
      return net.forward(inputs);
    } catch (const std::exception& e) {
      throw Error(joinText(source, ": the network failed on pictures [1, 3, ", first.height, ", ",
                           first.width, "]: ", firstLine(e)));
    }
  }

  std::string source;
  torch::jit::Module net;
};

}  // namespace

struct PerceptualNet::Impl : ScriptedNet {
  using ScriptedNet::ScriptedNet;
};
struct FeatureNet::Impl : ScriptedNet {
  using ScriptedNet::ScriptedNet;
};

PerceptualNet::PerceptualNet(const std::string& path)
    : impl_(std::make_unique<Impl>("--lpips", path)) {}
PerceptualNet::~PerceptualNet() = default;

double PerceptualNet::distance(const Image& reference, const Image& test) const {
  const at::IValue out = impl_->run({&reference, &test});
  const bool is_number = out.isTensor() ? out.toTensor().numel() == 1 : out.isScalar();
  require(is_number, impl_->source, ": expected one number from the network, found ",
          out.tagKind());
  const double value =
      out.isTensor() ? out.toTensor().item().toDouble() : out.toScalar().toDouble();
  require(std::isfinite(value), impl_->source,
          ": expected a finite number from the network, found ", value);
  return value;
}

FeatureNet::FeatureNet(const std::string& path)
    : impl_(std::make_unique<Impl>("--features", path)) {}
FeatureNet::~FeatureNet() = default;

std::vector<float> FeatureNet::features(const Image& image) const {
  const at::IValue out = impl_->run({&image});
  require(out.isTensor() && out.toTensor().numel() > 0, impl_->source,
          ": expected features from the network, found ", out.tagKind());
  const at::Tensor row = out.toTensor().to(at::kFloat).contiguous();
  std::vector<float> result(row.data_ptr<float>(), row.data_ptr<float>() + row.numel());
  require(std::all_of(result.begin(), result.end(), [](float v) { return std::isfinite(v); }),
          impl_->source, ": expected finite features from the network");
  return result;
}

}  // namespace vdbc
