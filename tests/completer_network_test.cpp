// Laws of the masked transformer (docs/method.md, sections 4.2 and 4.3), on networks of toy size.
#include <gtest/gtest.h>

#include <algorithm>

#include "mar/network.h"
#include "tests/toy_completer.h"

namespace vdbc {
namespace {

TokenSets toyInputs() {
  const CompletionSample s = toySample();
  TokenSets in;
  torch::manual_seed(9);
  for (int64_t i = 0; i < 20; ++i) in[kCondition].coords.push_back(s.condition.ijk[size_t(i)]);
  in[kVisible].coords = {Coord(5, 2, 1), Coord(6, 2, 1), Coord(6, 3, 1)};
  in[kEmptyToken].coords = {Coord(4, 2, 2), Coord(4, 4, 3)};
  in[kTarget].coords = {Coord(7, 2, 1), Coord(7, 2, 2), Coord(7, 3, 1), Coord(8, 9, 2),
                        Coord(9, 1, 1)};
  in[kCondition].features = torch::randn({20, kDim});
  in[kVisible].features = torch::randn({3, kDim});
  in[kTarget].features = torch::rand({5, 1});
  return in;
}

TEST(MaskedTransformer, FirstHalfDoesNotSeeTheTargets) {  // section 4.2
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const auto net = makeNet(toyConfig(), 10);
  TokenSets in = toyInputs();
  const auto before = net->trunk->forward(in, 1, s.condition.frame);
  in[kTarget].coords = {Coord(0, 0, 0), Coord(11, 9, 5)};
  in[kTarget].features = torch::full({2, 1}, 100.f);
  const auto after = net->trunk->forward(in, 1, s.condition.frame);
  EXPECT_EQ(before.context.size(0), 25);
  EXPECT_TRUE(torch::equal(before.context, after.context));
  // The second half does see them.
  EXPECT_GT(largestDifference(before.tokens.slice(0, 0, 25), after.tokens.slice(0, 0, 25)), 1e-3);
}

TEST(MaskedTransformer, EveryKindOfContextReachesTheTargets) {  // section 4.2
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const auto net = makeNet(toyConfig(), 11);
  const Tensor before = net->fine(toyInputs(), s.condition.frame).logits;
  for (int kind : {kCondition, kVisible, kEmptyToken, kTarget}) {
    TokenSets in = toyInputs();
    if (kind == kEmptyToken)
      in[kEmptyToken].coords[0] = Coord(3, 3, 3);
    else
      in[size_t(kind)].features[0] += 1;
    EXPECT_GT(largestDifference(net->fine(in, s.condition.frame).logits, before), 1e-6) << kind;
  }
}

TEST(MaskedTransformer, PermutedTargetsGivePermutedLogits) {
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  const auto net = makeNet(toyConfig(), 12);
  TokenSets in = toyInputs();
  const Tensor before = net->fine(in, s.condition.frame).logits;
  std::reverse(in[kTarget].coords.begin(), in[kTarget].coords.end());
  in[kTarget].features = in[kTarget].features.flip({0});
  EXPECT_LT(largestDifference(net->fine(in, s.condition.frame).logits, before.flip({0})), 1e-5);
}

TEST(MaskedTransformer, ParameterCountIsItsFormula) {  // section 4.2
  for (const auto& [width, layers] : {std::pair<int64_t, int>{24, 2}, {48, 5}}) {
    const StageSizes sizes{int(width), 2, layers, {kDim, kDim, 0, 1}};
    const int64_t block = 12 * width * width + 13 * width;  // 4 projections, MLP of 4 x, 2 norms
    const int64_t embeddings = (kDim + kDim + 1 + 1) * width + kTokenKinds * (width + 2 * width);
    const int64_t positions = (kSinusoidalDim + 1) * width;
    EXPECT_EQ(parameterCount(MaskedTransformer(sizes, toyConfig())),
              embeddings + positions + 2 * layers * block + 2 * width);
  }
  const CompleterConfig paper = CompleterConfig::paper();
  EXPECT_EQ(paper.layers, 5);
  EXPECT_EQ(paper.width, 512);
  EXPECT_EQ(paper.coarse_layers, 2);
  EXPECT_EQ(paper.unobserved_weight, 0);
}

TokenSets shifted(TokenSets in, const Coord& by) {
  for (TokenSet& set : in)
    for (Coord& c : set.coords) c += by;
  return in;
}

TEST(MaskedTransformer, OnlyTheSinusoidalCodeKnowsWhereTheSceneIs) {  // section 4.3
  torch::NoGradGuard no_grad;
  const CompletionSample s = toySample();
  for (const bool code : {false, true}) {
    CompleterConfig c = toyConfig();
    c.position_code = code;
    const auto net = makeNet(c, 13);
    const Tensor here = net->fine(toyInputs(), s.condition.frame).logits;
    const Tensor there = net->fine(shifted(toyInputs(), Coord(8, -6, 4)), s.condition.frame).logits;
    if (code) {
      EXPECT_GT(largestDifference(here, there), 1e-3);
    } else {
      EXPECT_LT(largestDifference(here, there), 1e-5);
      // Rotary positions know where tokens are to each other.
      TokenSets in = toyInputs();
      in[kTarget].coords[0] += Coord(0, 0, 2);
      EXPECT_GT(largestDifference(net->fine(in, s.condition.frame).logits, here), 1e-4);
    }
  }
}

TEST(CompleterNet, StandardiseAndRestoreAreInverse) {  // section 5.1
  const auto net = makeNet(toyConfig(), 14);
  const Tensor z = torch::randn({9, kDim});
  EXPECT_LT(largestDifference(net->restore(net->standardise(z)), z), 1e-6);
}

}  // namespace
}  // namespace vdbc
