#pragma once
// Private: rasterize() as a torch autograd function. The only file of splat/ that knows torch.
#include <ATen/core/Tensor.h>

#include "splat/rasterize.h"

namespace vdbc {

/// Parameters as float32 CPU tensors: mean [N, 3], log_scale [N, 3], rotation [N, 4],
/// opacity_logit [N], sh [N, K, 3]. Returns [H, W, 5]: colour (3), alpha, depth; differentiable by
/// all five parameters.
at::Tensor rasterizeTorch(const at::Tensor& mean, const at::Tensor& log_scale,
                          const at::Tensor& rotation, const at::Tensor& opacity_logit,
                          const at::Tensor& sh, const Camera& camera,
                          const RasterSettings& settings);

}  // namespace vdbc
