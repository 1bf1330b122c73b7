#include "splat/rasterize_torch.h"

#include <ATen/ops/empty.h>
#include <torch/csrc/autograd/custom_function.h>

#include <cstring>

#include "vdb/error.h"

namespace vdbc {
namespace {

/// Copies a tensor into an array of floats (or of Eigen vectors of floats).
template <typename T>
void copyInto(const at::Tensor& tensor, std::vector<T>* out) {
  const at::Tensor dense = tensor.contiguous();
  out->resize(size_t(dense.numel()) * sizeof(float) / sizeof(T));
  if (!out->empty())
    std::memcpy(static_cast<void*>(out->data()), dense.data_ptr<float>(), out->size() * sizeof(T));
}

template <typename T>
at::Tensor tensorFrom(const std::vector<T>& values, at::IntArrayRef shape) {
  at::Tensor out = at::empty(shape, at::kFloat);
  if (!values.empty()) std::memcpy(out.data_ptr<float>(), values.data(), values.size() * sizeof(T));
  return out;
}

Gaussians gaussiansFrom(const at::Tensor& mean, const at::Tensor& log_scale,
                        const at::Tensor& rotation, const at::Tensor& opacity_logit,
                        const at::Tensor& sh) {
  const auto requireShape = [](const at::Tensor& t, at::IntArrayRef shape, const char* name) {
    require(
        t.defined() && t.device().is_cpu() && t.scalar_type() == at::kFloat && t.sizes() == shape,
        "rasterizeTorch: ", name, ": expected a float32 CPU tensor ", shape, ", found ",
        t.defined() ? joinText(t.scalar_type(), " ", t.device(), " ", t.sizes()) : "none");
  };
  require(mean.defined() && mean.dim() == 2 && sh.defined() && sh.dim() == 3,
          "rasterizeTorch: expected mean [N, 3] and sh [N, K, 3]");
  const int64_t n = mean.size(0), k = sh.size(1);
  require(k == 1 || k == 4 || k == 9 || k == 16,
          "rasterizeTorch: sh: expected 1, 4, 9 or 16 coefficients, found ", k);
  requireShape(mean, {n, 3}, "mean");
  requireShape(log_scale, {n, 3}, "log_scale");
  requireShape(rotation, {n, 4}, "rotation");
  requireShape(opacity_logit, {n}, "opacity_logit");
  requireShape(sh, {n, k, 3}, "sh");
  Gaussians g;
  g.sh_degree = k == 1 ? 0 : k == 4 ? 1 : k == 9 ? 2 : 3;
  copyInto(mean, &g.mean);
  copyInto(log_scale, &g.log_scale);
  copyInto(rotation, &g.rotation);
  copyInto(opacity_logit, &g.opacity_logit);
  copyInto(sh, &g.sh);
  return g;
}

/// [H, W, 5]: colour, alpha, depth.
at::Tensor stack(const RasterOutput& out) {
  const int width = out.alpha.width, height = out.alpha.height;
  at::Tensor image = at::empty({height, width, 5}, at::kFloat);
  float* to = image.data_ptr<float>();
  const float* colour = out.colour.data.data();
  for (size_t i = 0; i < out.alpha.data.size(); ++i, to += 5, colour += 3) {
    to[0] = colour[0], to[1] = colour[1], to[2] = colour[2];
    to[3] = out.alpha.data[i], to[4] = out.depth.data[i];
  }
  return image;
}

/// What one forward call leaves for its backward call.
struct SavedCall : torch::CustomClassHolder {
  Gaussians gaussians;
  Camera camera;
  RasterStatePtr state;
};

struct RasterizeFunction : torch::autograd::Function<RasterizeFunction> {
  static at::Tensor forward(torch::autograd::AutogradContext* context, const at::Tensor& mean,
                            const at::Tensor& log_scale, const at::Tensor& rotation,
                            const at::Tensor& opacity_logit, const at::Tensor& sh,
                            const Camera& camera, const RasterSettings& settings) {
    auto saved = c10::make_intrusive<SavedCall>();
    saved->gaussians = gaussiansFrom(mean, log_scale, rotation, opacity_logit, sh);
    saved->camera = camera;
    const RasterOutput out = rasterize(saved->gaussians, camera, settings, &saved->state);
    context->saved_data["call"] = c10::IValue::make_capsule(std::move(saved));
    return stack(out);
  }

  static torch::autograd::variable_list backward(torch::autograd::AutogradContext* context,
                                                 torch::autograd::variable_list d_output) {
    const auto capsule = context->saved_data["call"].toCapsule();
    const auto& saved = static_cast<const SavedCall&>(*capsule);
    const int width = saved.camera.width, height = saved.camera.height;
    Image d_colour(width, height, 3), d_alpha(width, height, 1), d_depth(width, height, 1);
    const at::Tensor dense = d_output[0].contiguous();
    const float* from = dense.data_ptr<float>();
    bool any_alpha = false, any_depth = false;
    for (size_t i = 0; i < d_alpha.data.size(); ++i, from += 5) {
      for (size_t j = 0; j < 3; ++j) d_colour.data[3 * i + j] = from[j];
      d_alpha.data[i] = from[3], d_depth.data[i] = from[4];
      any_alpha |= from[3] != 0.f, any_depth |= from[4] != 0.f;
    }
    const GaussianGradients d =
        rasterizeBackward(saved.gaussians, saved.camera, *saved.state, d_colour,
                          any_alpha ? &d_alpha : nullptr, any_depth ? &d_depth : nullptr);
    const int64_t n = saved.gaussians.size(), k = saved.gaussians.shCoefficients();
    return {tensorFrom(d.mean, {n, 3}),
            tensorFrom(d.log_scale, {n, 3}),
            tensorFrom(d.rotation, {n, 4}),
            tensorFrom(d.opacity_logit, {n}),
            tensorFrom(d.sh, {n, k, 3}),
            at::Tensor(),
            at::Tensor()};
  }
};

}  // namespace

at::Tensor rasterizeTorch(const at::Tensor& mean, const at::Tensor& log_scale,
                          const at::Tensor& rotation, const at::Tensor& opacity_logit,
                          const at::Tensor& sh, const Camera& camera,
                          const RasterSettings& settings) {
  const bool differentiate =
      at::GradMode::is_enabled() &&
      (mean.requires_grad() || log_scale.requires_grad() || rotation.requires_grad() ||
       opacity_logit.requires_grad() || sh.requires_grad());
  if (!differentiate)
    return stack(
        rasterize(gaussiansFrom(mean, log_scale, rotation, opacity_logit, sh), camera, settings));
  return RasterizeFunction::apply(mean, log_scale, rotation, opacity_logit, sh, camera, settings);
}

}  // namespace vdbc
