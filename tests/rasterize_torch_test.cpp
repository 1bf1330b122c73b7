// The autograd wrapper against the core it wraps, and by finite differences through torch.
#include "splat/rasterize_torch.h"

#include <ATen/ATen.h>
#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/csrc/autograd/variable.h>

#include <cmath>

#include "vdb/error.h"

namespace vdbc {
namespace {

Camera frontCamera(int width, int height) {
  Camera camera;
  camera.width = width, camera.height = height;
  camera.fx = camera.fy = width;
  camera.cx = 0.5 * width, camera.cy = 0.5 * height;
  return camera;
}

struct SceneTensors {
  at::Tensor mean, log_scale, rotation, opacity_logit, sh;
  std::vector<at::Tensor> all() const { return {mean, log_scale, rotation, opacity_logit, sh}; }
};

SceneTensors randomScene(int64_t n, int64_t coefficients, uint64_t seed) {
  at::manual_seed(seed);
  SceneTensors s;
  s.mean = at::rand({n, 3}) * 1.6 - 0.8;
  s.mean.select(1, 2) += 2.2;
  s.log_scale = at::randn({n, 3}) * 0.4 - 1.9;
  s.rotation = at::randn({n, 4});
  s.opacity_logit = at::randn({n});
  s.sh = at::randn({n, coefficients, 3}) * 0.3;
  return s;
}

at::Tensor render(const SceneTensors& s, const Camera& camera) {
  return rasterizeTorch(s.mean, s.log_scale, s.rotation, s.opacity_logit, s.sh, camera,
                        RasterSettings());
}

template <typename T>
void expectSame(const at::Tensor& tensor, const std::vector<T>& values, const char* name) {
  ASSERT_EQ(size_t(tensor.numel()) * sizeof(float), values.size() * sizeof(T)) << name;
  const at::Tensor dense = tensor.contiguous();
  EXPECT_EQ(std::memcmp(dense.data_ptr<float>(), values.data(), values.size() * sizeof(T)), 0)
      << name;
}

TEST(RasterizeTorch, AgreesWithTheCoreForwardAndBackward) {
  const Camera camera = frontCamera(45, 37);
  SceneTensors s = randomScene(200, 4, 1);
  Gaussians g;
  g.resize(200, 1);
  const auto copy = [](const at::Tensor& from, void* to) {
    std::memcpy(to, from.data_ptr<float>(), size_t(from.numel()) * sizeof(float));
  };
  copy(s.mean, g.mean.data()), copy(s.log_scale, g.log_scale.data());
  copy(s.rotation, g.rotation.data()), copy(s.opacity_logit, g.opacity_logit.data());
  copy(s.sh, g.sh.data());
  RasterStatePtr state;
  const RasterOutput truth = rasterize(g, camera, RasterSettings(), &state);

  EXPECT_FALSE(render(s, camera).requires_grad());
  for (at::Tensor t : s.all()) t.set_requires_grad(true);
  const at::Tensor image = render(s, camera);
  ASSERT_EQ(image.sizes(), at::IntArrayRef({37, 45, 5}));
  EXPECT_TRUE(image.requires_grad());
  expectSame(image.detach().slice(2, 0, 3), truth.colour.data, "colour");
  expectSame(image.detach().slice(2, 3, 4), truth.alpha.data, "alpha");
  expectSame(image.detach().slice(2, 4, 5), truth.depth.data, "depth");

  const at::Tensor d = at::randn({37, 45, 5});
  torch::autograd::backward({image}, {d});
  Image d_colour(45, 37, 3), d_alpha(45, 37, 1), d_depth(45, 37, 1);
  copy(d.slice(2, 0, 3).contiguous(), d_colour.data.data());
  copy(d.slice(2, 3, 4).contiguous(), d_alpha.data.data());
  copy(d.slice(2, 4, 5).contiguous(), d_depth.data.data());
  const GaussianGradients expected =
      rasterizeBackward(g, camera, *state, d_colour, &d_alpha, &d_depth);
  expectSame(s.mean.grad(), expected.mean, "mean");
  expectSame(s.log_scale.grad(), expected.log_scale, "log_scale");
  expectSame(s.rotation.grad(), expected.rotation, "rotation");
  expectSame(s.opacity_logit.grad(), expected.opacity_logit, "opacity_logit");
  expectSame(s.sh.grad(), expected.sh, "sh");
}

TEST(RasterizeTorch, GradientsMatchFiniteDifferencesAlongRandomDirections) {
  const Camera camera = frontCamera(40, 40);
  SceneTensors s = randomScene(30, 9, 2);
  // The image jumps where alpha crosses min_alpha, so that is tiny; depth jumps there from 0, so it
  // counts by alpha. Then float differences are good to a percent.
  RasterSettings settings;
  settings.min_alpha = 1e-6f;
  const auto loss = [&](const SceneTensors& m) {
    const at::Tensor image =
        rasterizeTorch(m.mean, m.log_scale, m.rotation, m.opacity_logit, m.sh, camera, settings);
    const at::Tensor weight = at::cos(at::arange(40 * 40 * 5, at::kFloat)).view({40, 40, 5});
    const at::Tensor values =
        at::cat({image.slice(2, 0, 4), image.slice(2, 4, 5) * image.slice(2, 3, 4)}, 2);
    return (values.square() * weight).to(at::kDouble).sum();
  };
  for (at::Tensor t : s.all()) t.set_requires_grad(true);
  torch::autograd::backward({loss(s)}, {});
  for (size_t array = 0; array < 5; ++array) {
    const at::Tensor gradient = s.all()[array].grad();
    const auto moved = [&](double step) {
      at::NoGradGuard guard;
      SceneTensors m = s;
      at::Tensor* const tensors[] = {&m.mean, &m.log_scale, &m.rotation, &m.opacity_logit, &m.sh};
      *tensors[array] = s.all()[array].detach() + gradient.sign() * step;
      return loss(m).item<double>();
    };
    const double step = 2e-4, slope = (moved(step) - moved(-step)) / (2 * step);
    const double expected = gradient.abs().sum().item<double>();
    EXPECT_GT(expected, 0.1);
    EXPECT_NEAR(slope, expected, 0.02 * expected) << "array " << array;
  }
}

TEST(RasterizeTorch, FollowsTheGraphOnlyWhereAsked) {
  const Camera camera = frontCamera(20, 20);
  SceneTensors s = randomScene(20, 1, 3);
  s.sh.set_requires_grad(true);
  const at::Tensor leaf = s.opacity_logit.clone().set_requires_grad(true);
  s.opacity_logit = leaf * 2;
  const at::Tensor image = render(s, camera);
  torch::autograd::backward({image.slice(2, 0, 3).sum()});
  EXPECT_TRUE(s.sh.grad().defined());
  EXPECT_GT(leaf.grad().abs().sum().item<float>(), 0.f);
  EXPECT_FALSE(s.mean.grad().defined());
  at::NoGradGuard guard;
  EXPECT_FALSE(render(s, camera).requires_grad());
}

TEST(RasterizeTorch, TakesStridedTensorsAndNone) {
  const Camera camera = frontCamera(20, 20);
  const SceneTensors s = randomScene(20, 1, 4);
  SceneTensors strided = s;
  strided.mean = s.mean.t().contiguous().t();
  ASSERT_FALSE(strided.mean.is_contiguous());
  EXPECT_TRUE(at::equal(render(s, camera), render(strided, camera)));
  SceneTensors none = randomScene(0, 1, 5);
  none.mean.set_requires_grad(true);
  const at::Tensor image = render(none, camera);
  EXPECT_EQ(image.abs().sum().item<float>(), 0.f);
  torch::autograd::backward({image.sum()});
}

TEST(RasterizeTorch, GradientsAreFinite) {
  const Camera camera = frontCamera(30, 30);
  SceneTensors s = randomScene(50, 4, 6);
  s.rotation[0].zero_();
  s.mean[1][2] = 0;
  s.mean[2][0] = std::nan("");
  s.log_scale[3].fill_(60);
  s.log_scale[4].fill_(-90);
  s.opacity_logit[5] = 1e9;
  for (at::Tensor t : s.all()) t.set_requires_grad(true);
  const at::Tensor image = render(s, camera);
  EXPECT_TRUE(image.isfinite().all().item<bool>());
  torch::autograd::backward({image.square().sum()});
  for (const at::Tensor& t : s.all()) EXPECT_TRUE(t.grad().isfinite().all().item<bool>());
}

TEST(RasterizeTorch, WrongShapesThrow) {
  const Camera camera = frontCamera(20, 20);
  const SceneTensors good = randomScene(20, 1, 7);
  SceneTensors s = good;
  s.mean = at::rand({20, 4});
  EXPECT_THROW(render(s, camera), Error);
  s = good, s.sh = at::rand({20, 2, 3});
  EXPECT_THROW(render(s, camera), Error);
  s = good, s.rotation = at::rand({19, 4});
  EXPECT_THROW(render(s, camera), Error);
  s = good, s.opacity_logit = good.opacity_logit.to(at::kDouble);
  EXPECT_THROW(render(s, camera), Error);
}

}  // namespace
}  // namespace vdbc
