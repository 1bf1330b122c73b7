// Laws of the completer's training and of its samples in files (docs/method.md, section 5).
#include "mar/completer_train.h"

#include <gtest/gtest.h>

#include <climits>
#include <cmath>
#include <limits>
#include <set>

#include "encoder/trainer.h"
#include "encoder/weights.h"
#include "tests/expect_error.h"
#include "tests/files.h"
#include "tests/toy_completer.h"

namespace vdbc {
namespace {

TEST(CompleterStep, LowersTheLossWithEitherWeight) {  // section 5.5
  for (const bool paper : {false, true}) {
    CompleterConfig c = toyConfig();
    c.paper_snr_weight = paper;
    const CompleterStep step = completerStep(c, toySample(), 20);
    EXPECT_TRUE(std::isfinite(step.before));
    EXPECT_LT(step.after, step.before);
    EXPECT_GT(step.gradient_sum, 0);
  }
}

TEST(CompleterStep, RefinementSendsNoGradientToTheTrunk) {  // section 4.6
  CompletionSample s = toySample();
  const CompleterStep step = completerStep(toyConfig(), s, 21);
  EXPECT_EQ(step.trunk_gradient_of_refinement, 0);
  EXPECT_GT(step.gradient_sum, 0);
  // The refinement loss is there: targets at the condition's own places enter nothing else.
  std::set<Coord> own(s.condition.ijk.begin(), s.condition.ijk.end());
  for (size_t i = 0; i < s.target.ijk.size(); ++i)
    if (own.count(s.target.ijk[i])) s.target.z[i * kDim] += 3;
  EXPECT_NE(completerStep(toyConfig(), s, 21).before, step.before);
}

TEST(CompleterStep, GarbageInTheUnobservedChangesNoBit) {  // section 5.2, the paper's option
  CompleterConfig c = toyConfig();
  c.unobserved_weight = 0;
  const auto withGarbage = [](float value) {
    CompletionSample s = toySample();
    for (auto n = s.target_nodes.box.begin(); n; ++n)
      if (s.target_nodes.at(*n) == NodeState::kUnobserved) {
        s.target.ijk.push_back(*n);
        s.target.z.insert(s.target.z.end(), kDim, value * float((*n).x() + 1));
        s.target.generated.push_back(0), s.target.probability.push_back(1),
            s.target.bfs_level.push_back(0);
      }
    return s;
  };
  for (uint64_t seed = 22; seed < 26; ++seed) {
    const CompleterStep clean = completerStep(c, toySample(), seed);
    for (const float value : {1.f, -777.f, std::numeric_limits<float>::quiet_NaN()}) {
      const CompleterStep step = completerStep(c, withGarbage(value), seed);
      EXPECT_EQ(step.before, clean.before);
      EXPECT_EQ(step.after, clean.after);
      EXPECT_EQ(step.gradient_sum, clean.gradient_sum);
    }
  }
}

TEST(CompleterStep, UnobservedTargetsWeighWhatTheConfigurationSays) {  // section 5.2
  // Nothing but U to learn from: with weight 0 occupancy gives no loss, and it is linear in the
  // weight.
  CompletionSample s = toySample();
  for (const auto& [truth, seen] :
       {std::pair(&s.target_nodes, &s.seen_nodes), std::pair(&s.target_coarse, &s.seen_coarse)})
    for (auto n = truth->box.begin(); n; ++n) setState(truth, *n, seen->at(*n));
  s.target = s.condition;
  const auto loss = [&](float weight) {
    CompleterConfig c = toyConfig();
    c.unobserved_weight = weight;
    return completerStep(c, s, 29).before;
  };
  const double none = loss(0), quarter = loss(.25f), full = loss(1);
  EXPECT_GT(full - none, .1);
  EXPECT_NEAR((quarter - none) / (full - none), .25, 1e-4);
}

// --- samples in files ----------------------------------------------------------------------------

class SampleFile : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_ / name; }

 private:
  TemporaryFolder folder_;
};

TEST_F(SampleFile, RoundTripIsExact) {
  const CompletionSample s = toySample();
  writeSample(s, path("sample"));
  const CompletionSample r = readSample(path("sample"));
  for (const auto& [a, b] :
       {std::make_pair(&s.condition, &r.condition), std::make_pair(&s.target, &r.target)}) {
    EXPECT_EQ(a->ijk, b->ijk);
    EXPECT_EQ(a->z, b->z);
    EXPECT_EQ(a->dim, b->dim);
    EXPECT_EQ(a->generated, b->generated);
    EXPECT_EQ(a->probability, b->probability);
    EXPECT_EQ(a->bfs_level, b->bfs_level);
    EXPECT_EQ(a->frame.bounds, b->frame.bounds);
    EXPECT_EQ(a->frame.voxel_m, b->frame.voxel_m);
  }
  for (const auto& [a, b] : {std::make_pair(&s.seen_nodes, &r.seen_nodes),
                             std::make_pair(&s.seen_coarse, &r.seen_coarse),
                             std::make_pair(&s.target_nodes, &r.target_nodes),
                             std::make_pair(&s.target_coarse, &r.target_coarse)}) {
    EXPECT_EQ(a->level, b->level);
    EXPECT_EQ(a->box, b->box);
    EXPECT_EQ(filledNodes(*a), filledNodes(*b));
    EXPECT_EQ(emptyNodes(*a), emptyNodes(*b));
  }
}

TEST_F(SampleFile, BadFilesThrow) {
  writeSample(toySample(), path("sample"));
  const std::string bytes = bytesOf(path("sample"));
  for (size_t n = 0; n < bytes.size(); n += 97) {
    writeBytes(path("bad"), bytes.substr(0, n));
    EXPECT_THROW(readSample(path("bad")), Error) << n;
  }
  const TensorFile file = readTensors(path("sample"));
  const auto rejected = [&](const std::string& name, const Tensor& value) {
    TensorFile changed = file;
    changed.tensors[name] = value;
    writeTensors(changed, path("bad"));
    EXPECT_THROW(readSample(path("bad")), Error) << name;
  };
  rejected("condition.ijk", torch::zeros({3, 3}, torch::kInt32));
  rejected("condition.z", torch::zeros({2, kDim}));
  rejected("target.z", torch::zeros({5}));
  rejected("bounds", torch::zeros({5}, torch::kInt32));
  rejected("seen_nodes.box", torch::zeros({3}, torch::kInt32));
  rejected("seen_nodes.box", torch::tensor({1, 0, 0, 0, 8192, 5, 5}, torch::kInt32));
  rejected("seen_nodes.box", torch::tensor({1, 0, 0, 0, -1, -1, -1}, torch::kInt32));
  rejected("seen_nodes.box", torch::tensor({1, INT_MIN, 0, 0, INT_MAX, 5, 5}, torch::kInt32));
  rejected("seen_nodes.box", file.tensors.at("seen_nodes.box").to(torch::kFloat32));
  for (const std::string name : {"seen_nodes.filled", "target_coarse.empty"}) {
    Tensor nodes = file.tensors.at(name).clone();
    rejected(name, nodes.view({-1}));
    rejected(name, nodes.slice(1, 0, 2).contiguous());
    rejected(name, nodes.to(torch::kFloat32));
    nodes[1][0] = 12;  // no node of the box
    rejected(name, nodes);
    TensorFile lacking = file;
    lacking.tensors.erase(name);
    writeTensors(lacking, path("bad"));
    EXPECT_THROW(readSample(path("bad")), Error) << name;
  }
}

// --- training ------------------------------------------------------------------------------------

using CompleterResume = SampleFile;
const std::vector<float> kOneColour = {1, -1, 0, 0, 0, 0, 0, 0};

TEST_F(CompleterResume, AnInterruptedRunEndsAsAnUninterruptedOne) {  // section 5.5
  const CompleterConfig c = toyConfig();
  const SampleSource samples = [](uint64_t index) { return toySample(3 + int(index)); };
  TrainSettings settings;
  settings.steps = 6, settings.warmup = 2, settings.validate_every = settings.checkpoint_every = 3;
  settings.metadata["trained_on"] = "toys";
  const auto train = [&](const std::string& name, bool resume, Progress& progress) {
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    settings.resume = resume;
    std::vector<TrainLogRow> rows;
    trainCompleter(
        c, kOneColour, samples, 4, samples, 2, settings,
        [&](const TrainLogRow& row) { rows.push_back(row); }, progress);
    return rows;
  };
  Progress silent;
  const std::vector<TrainLogRow> rows = train("whole", false, silent);
  ASSERT_EQ(rows.size(), 2u);
  for (const char* value :
       {"loss", "coarse", "fine", "linear", "diffusion", "refinement", "val_f1"})
    EXPECT_TRUE(std::isfinite(rows[1].values.at(value))) << value;
  StopAtHalf stop;
  EXPECT_THROW(train("parts", false, stop), Cancelled);
  EXPECT_TRUE(bytesOf(path("parts.safetensors")) != bytesOf(path("whole.safetensors")));
  train("parts", true, silent);
  EXPECT_TRUE(bytesOf(path("parts.safetensors")) == bytesOf(path("whole.safetensors")));
  EXPECT_TRUE(bytesOf(path("parts/checkpoint.safetensors")) ==
              bytesOf(path("whole/checkpoint.safetensors")));
  EXPECT_TRUE(bytesOf(path("parts/log.csv")) == bytesOf(path("whole/log.csv")));
  const Completer completer(path("whole.safetensors"));
  EXPECT_EQ(completer.trainedOn(), "toys");
  // Latents were scaled to unit deviation, over the scenes it was trained on.
  const TensorFile file = readTensors(path("whole.safetensors"));
  std::vector<Tensor> all;
  for (uint64_t i = 0; i < 4; ++i)
    all.push_back(torch::tensor(samples(i).target.z).view({-1, kDim}));
  const Tensor z = torch::cat(all);
  EXPECT_LT(largestDifference((z - file.tensors.at("latent_mean")).mean(0), torch::zeros({kDim})),
            1e-5);
  EXPECT_LT(largestDifference(
                ((z - file.tensors.at("latent_mean")) / file.tensors.at("latent_deviation")).std(0),
                torch::ones({kDim})),
            1e-4);
  settings.resume = true;
  settings.work_folder = path("none");
  EXPECT_THROW(trainCompleter(c, kOneColour, samples, 4, samples, 0, settings, nullptr, silent),
               Error);
}

TEST_F(CompleterResume, AnInterruptedRunInBatchesEndsAsAnUninterruptedOne) {  // section 5.5
  const SampleSource samples = [](uint64_t index) { return toySample(3 + int(index)); };
  TrainSettings settings;
  settings.steps = 4, settings.batch = 2, settings.fine_draws = 3;
  settings.validate_every = settings.checkpoint_every = 2;
  const auto train = [&](const std::string& name, bool resume, Progress& progress) {
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    settings.resume = resume;
    trainCompleter(toyConfig(), kOneColour, samples, 4, samples, 0, settings, nullptr, progress);
  };
  Progress silent;
  StopAtHalf stop;
  train("whole", false, silent);
  EXPECT_THROW(train("parts", false, stop), Cancelled);
  train("parts", true, silent);
  for (const char* file : {".safetensors", "/checkpoint.safetensors", "/log.csv"})
    EXPECT_TRUE(bytesOf(path("parts") + file) == bytesOf(path("whole") + file)) << file;
}

TEST_F(CompleterResume, ABatchHasTheMeanGradientOfItsSamples) {  // section 5.5
  CompleterConfig c = toyConfig();
  c.own_gate_share = 0;
  const SampleSource samples = [](uint64_t index) { return toySample(3 + int(index)); };
  TrainSettings settings;
  settings.learning_rate = 0, settings.clip_norm = 1e9;  // the network stays as it is
  Progress silent;
  // AdamW's first moment of every parameter: .1 of the gradient, and .9 of what it was before.
  const auto moments = [&](const std::string& name, int64_t steps, int64_t batch) {
    settings.steps = steps, settings.batch = batch;
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    trainCompleter(c, kOneColour, samples, 2, samples, 0, settings, nullptr, silent);
    std::map<std::string, Tensor> first;
    for (const auto& [key, tensor] : readTensors(path(name + "/checkpoint.safetensors")).tensors)
      if (key.rfind("first.", 0) == 0) first[key] = tensor;
    return first;
  };
  const auto both = moments("both", 1, 2), one = moments("one", 1, 1), two = moments("two", 2, 1);
  ASSERT_GT(both.size(), 20u);
  double largest = 0;
  for (const auto& [name, moment] : both) {
    const auto of = [&](const auto& moments) {
      return moments.count(name) ? moments.at(name) : torch::zeros_like(moment);
    };
    const Tensor first = of(one), second = of(two) - .9 * of(one);
    EXPECT_LT(largestDifference(moment, (first + second) / 2),
              1e-6 + 1e-4 * moment.abs().max().item<double>())
        << name;
    largest = std::max(largest, largestDifference(first, second));
  }
  EXPECT_GT(largest, 1e-3);  // the samples differ
}

TEST_F(CompleterResume, ATrainingCanStartFromGivenWeights) {
  CompleterConfig c = toyConfig();
  const SampleSource samples = [](uint64_t index) { return toySample(3 + int(index)); };
  TrainSettings settings;
  settings.steps = 2, settings.validate_every = settings.checkpoint_every = 2;
  Progress silent;
  const auto train = [&](const std::string& name) {
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    trainCompleter(c, kOneColour, samples, 2, samples, 0, settings, nullptr, silent);
    return readTensors(settings.weights_path).tensors;
  };
  const auto first = train("first");
  // Other samples' latents, another seed and other settings: with a rate of 0 nothing of them
  // shows.
  settings.from = path("first.safetensors"), settings.learning_rate = 0, settings.seed = 2;
  c.rotary_positions = false;
  for (const auto& [name, tensor] : train("second"))
    EXPECT_TRUE(torch::equal(tensor, first.at(name))) << name;
  c.width = 16;
  EXPECT_THROW(train("third"), Error);
}

}  // namespace
}  // namespace vdbc
