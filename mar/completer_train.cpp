#include "mar/completer_train.h"

#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <cmath>

#include "encoder/trainer.h"
#include "mar/context.h"
#include "mar/training_masks.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

double drawUniform(torch::Generator& random) { return torch::rand({1}, random).item<double>(); }
double drawUniform(double low, double high, torch::Generator& random) {
  return low + (high - low) * drawUniform(random);
}

std::vector<Coord> selectRandom(const std::vector<Coord>& from, double share,
                                torch::Generator& random) {
  const Tensor draws = torch::rand({int64_t(from.size())}, random);
  std::vector<Coord> chosen;
  for (size_t i = 0; i < from.size(); ++i)
    if (draws.data_ptr<float>()[i] < share) chosen.push_back(from[i]);
  return chosen;
}

}  // namespace

CoarseMask drawCoarseMask(const std::vector<Coord>& unknown, const SeenSpace& truth,
                          torch::Generator& random) {
  CoarseMask m;
  const std::vector<Coord> worked_on = selectRandom(unknown, drawUniform(.3, 1, random), random);
  // Inference is one shot from the condition tokens; half of the samples train just that.
  const double hidden = drawUniform(random) < .5 ? 1.0 : drawUniform(.5, 1, random);
  const Tensor draws = torch::rand({int64_t(worked_on.size())}, random);
  for (size_t i = 0; i < worked_on.size(); ++i) {
    const bool shown =
        truth.at(worked_on[i]) == NodeState::kFilled && draws.data_ptr<float>()[i] >= hidden;
    (shown ? m.visible : m.targets).push_back(worked_on[i]);
  }
  return m;
}

FineMask drawFineMask(const std::vector<Coord>& candidates, const CompletionSample& s,
                      const CompleterConfig& config, torch::Generator& random) {
  FineMask m;
  const double kind = drawUniform(random);
  const double share = double(config.alone_share);
  const bool alone = kind < share, growth = kind < (1 + share) / 2;
  const std::vector<int32_t> levels = breadthFirstLevels(candidates, s.condition.ijk);
  const int32_t deepest = levels.empty() ? 1 : *std::max_element(levels.begin(), levels.end());
  const int32_t depth = int32_t(torch::randint(alone ? deepest : 6, {1}, random).item<int64_t>());
  const Tensor draws = torch::rand({int64_t(candidates.size()), 2}, random);
  const double hidden = drawUniform(.5, 1, random);
  const double wrong = drawUniform(0, config.context_false_positives, random);
  std::vector<Coord> open;
  for (size_t i = 0; i < candidates.size(); ++i) {
    const float* d = draws.data_ptr<float>() + 2 * i;
    const bool filled = s.target_nodes.at(candidates[i]) == NodeState::kFilled;
    const bool reached = growth ? levels[i] <= depth : d[0] >= hidden;
    if (!alone && reached && filled) {
      m.visible.push_back(candidates[i]);
    } else if (!alone && reached && d[1] < wrong) {
      m.false_visible.push_back(candidates[i]);
    } else if (growth && levels[i] <= depth) {
      m.others.push_back(candidates[i]);  // visited and rejected: not the frontier any more
    } else {
      open.push_back(candidates[i]);
      if (growth) {
        (levels[i] == depth + 1 ? m.frontier : m.others).push_back(candidates[i]);
      }
    }
  }
  if (!growth) {
    std::vector<Coord> context = s.condition.ijk;
    context.insert(context.end(), m.visible.begin(), m.visible.end());
    const std::vector<int32_t> distance = breadthFirstLevels(open, context);
    for (size_t i = 0; i < open.size(); ++i)
      (distance[i] == 1 ? m.frontier : m.others).push_back(open[i]);
  }
  return m;
}

CoordBBox drawBounds(const CompletionSample& s, const CompleterConfig& config,
                     torch::Generator& random) {
  const VoxelFrame& frame = s.condition.frame;
  if (drawUniform(random) >= config.window_share) return frame.bounds;
  const int outwards = int(2.8 / frame.voxel_m / 4), most = int(16 / frame.voxel_m / 4);
  CoordBBox bounds = frame.bounds;
  for (int axis = 0; axis < 3; ++axis) {
    const int side = frame.bounds.dim()[axis] / 4;
    auto move = [&](int room) {
      return int(torch::randint(-side / 4, room + 1, {1}, random).item<int64_t>());
    };
    const int low = move(std::clamp(most - side, 0, outwards)),
              high = move(std::clamp(most - side - low, 0, outwards));
    bounds.min()[axis] -= 4 * low, bounds.max()[axis] += 4 * high;
  }
  const bool holds =
      std::any_of(s.condition.ijk.begin(), s.condition.ijk.end(),
                  [&](const Coord& token) { return bounds.isInside(firstVoxel(token, 1)); });
  return holds ? bounds : frame.bounds;
}

namespace {

// Truth and weight of positions: F 1, E 0, U 0 with the configured low weight (docs/method.md,
// section 5.2).
struct Labels {
  Tensor truth, weight;  // [N]
};
Labels labelsOf(const std::vector<Coord>& positions, const SeenSpace& truth,
                float unobserved_weight) {
  const int64_t n = int64_t(positions.size());
  Labels l{torch::zeros({n}), torch::ones({n})};
  for (int64_t i = 0; i < n; ++i) {
    const NodeState s = truth.at(positions[size_t(i)]);
    l.truth.data_ptr<float>()[i] = s == NodeState::kFilled;
    if (s == NodeState::kUnobserved) l.weight.data_ptr<float>()[i] = unobserved_weight;
  }
  return l;
}

Tensor occupancyLoss(const Tensor& logits, const Labels& l, const CompleterConfig& c) {
  // Positions of weight 0 leave the graph: whatever stands there cannot reach loss or gradients.
  const Tensor rows = l.weight.nonzero().flatten();
  if (rows.size(0) == 0) return logits.sum() * 0;
  return 2 * focalLoss(logits.index_select(0, rows), l.truth.index_select(0, rows),
                       l.weight.index_select(0, rows), c.focal_gamma, c.focal_alpha);
}

// Of one fine sample.
struct FineLosses {
  Tensor fine = torch::zeros({}), linear = torch::zeros({}), diffusion = torch::zeros({}),
         refinement = torch::zeros({});
  Tensor total(const CompleterConfig& c) const {
    return fine + linear + c.diffusion_weight * diffusion + c.refinement_weight * refinement;
  }
};

// Target latents by position, where the dense views saw a surface: what else a file holds is no
// truth (docs/method.md, section 5.2).
struct TargetRows {
  TokenMap<int64_t> row;
  std::vector<int64_t> all;
  explicit TargetRows(const CompletionSample& s) {
    for (size_t i = 0; i < s.target.ijk.size(); ++i) {
      if (s.target_nodes.at(s.target.ijk[i]) != NodeState::kFilled) continue;
      row.set(s.target.ijk[i], int64_t(i));
      all.push_back(int64_t(i));
    }
  }
  int64_t find(const Coord& c) const {
    const int64_t* found = row.find(c);
    return found ? *found : -1;
  }
};

// The coarse stage: loss on a random subset of the unknown positions (docs/method.md, section 5.3),
// and its probabilities there.
Tensor coarseLoss(CompleterNet& net, const SceneTokens& scene, const CompletionSample& s,
                  const std::vector<Coord>& unknown, const VoxelFrame& frame,
                  torch::Generator& random, Gate* gate) {
  for (const Coord& c : scene.coarse_filled) gate->set(c, 1);
  CoarseMask mask = drawCoarseMask(unknown, s.target_coarse, random);
  for (const Coord& c : mask.visible) gate->set(c, 1);
  if (mask.targets.empty()) return torch::zeros({});
  // Inference asks in chunks of neighbours; so does training.
  const Coord around = mask.targets[size_t(
      torch::randint(int64_t(mask.targets.size()), {1}, random).item<int64_t>())];
  const std::vector<Coord> targets =
      nearestOf(mask.targets, {double(around.x()), double(around.y()), double(around.z())},
                net.config.coarse_chunk_tokens);
  const Tensor logits = net.coarseLogits(
      coarseInputs(scene, mask.visible, targets, net.config.coarse_empty_tokens), frame);
  const Tensor p = logits.detach().sigmoid().contiguous();
  for (size_t i = 0; i < targets.size(); ++i) gate->set(targets[i], p.data_ptr<float>()[i]);
  // Positions not worked on get the probability that a middling coarse stage would give them, so
  // that the fine stage sees whole neighbourhoods.
  const Tensor draws = torch::rand({int64_t(unknown.size()), 2}, random);
  for (size_t i = 0; i < unknown.size(); ++i) {
    const float* d = draws.data_ptr<float>() + 2 * i;
    if (s.target_coarse.at(unknown[i]) == NodeState::kFilled) {
      gate->insert(unknown[i], .3f + .7f * d[0]);
    } else if (d[1] < .08f) {
      gate->insert(unknown[i], .05f + .45f * d[0]);
    }
  }
  return occupancyLoss(logits, labelsOf(targets, s.target_coarse, net.config.unobserved_weight),
                       net.config);
}

// A sample as a step sees it: through a window, with what lies behind the gate.
struct DrawnScene {
  VoxelFrame frame;
  SceneTokens scene;
  TargetRows rows;
  Tensor condition_z, target_z;  // [N, latent_dim] standardised
  bool own = false;              // the gate is the coarse stage as it is
  Gate drawn{}, asked{};
  std::vector<Coord> candidates{};  // of the fine stage
  Tensor coarse_loss = torch::zeros({});

  const Gate& gate() const { return own ? asked : drawn; }
};

DrawnScene drawScene(CompleterNet& net, const CompletionSample& s, double own_gate,
                     torch::Generator& random) {
  const CompleterConfig& c = net.config;
  VoxelFrame frame = s.condition.frame;
  frame.bounds = drawBounds(s, c, random);
  DrawnScene d{
      frame,
      sceneTokens(seenIn(s.seen_nodes, nodesIn(frame.bounds, 1)),
                  seenIn(s.seen_coarse, nodesIn(frame.bounds, 2))),
      TargetRows(s),
      net.standardise(torch::tensor(s.condition.z).view({s.condition.size(), c.latent_dim})),
      net.standardise(torch::tensor(s.target.z).view({s.target.size(), c.latent_dim}))};
  const SceneTokens& scene = d.scene;
  const std::vector<Coord> unknown = unobservedNodes(scene.coarse, scene.coarse.box);
  if (c.coarse_stage) d.coarse_loss = coarseLoss(net, scene, s, unknown, frame, random, &d.drawn);

  // The fine stage works inside what the coarse stage keeps, as it is or as a better one would be:
  // all of the truth and what it takes for true.
  d.own = !c.coarse_stage || drawUniform(random) < own_gate;
  const double tau = d.own ? CompleteSettings().coarse_tau : drawUniform(.05, .5, random);
  if (d.own) {
    torch::NoGradGuard no_grad;
    for (const Coord& node : scene.coarse_filled) d.asked.set(node, 1);
    // What a larger window adds is all unseen: none of it is worth the fine stage's time.
    std::vector<Coord> near;
    for (const Coord& node : unknown)
      if (s.seen_coarse.box.isInside(node)) near.push_back(node);
    for (const std::vector<Coord>& chunk : chunksOf(near, c.coarse_chunk_tokens)) {
      const std::vector<float> p = coarseProbability(net, scene, chunk, frame);
      for (size_t i = 0; i < chunk.size(); ++i) d.asked.set(chunk[i], p[i]);
    }
  }
  const Gate& gate = d.gate();
  std::vector<Coord> open;
  for (size_t i = 0; i < gate.size(); ++i) {
    const Coord& node = gate.tokens()[i];
    if (double(gate.values()[i]) > tau ||
        (!d.own && s.target_coarse.at(node) == NodeState::kFilled))
      open.push_back(node);
  }
  std::sort(open.begin(), open.end());
  d.candidates = unobservedChildren(open, scene.nodes);
  return d;
}

// Of one mask and one chunk of targets behind the gate; 0 where nothing lies behind it.
FineLosses fineLosses(CompleterNet& net, const CompletionSample& s, const DrawnScene& d,
                      const Tensor& colour_way, torch::Generator& random) {
  const CompleterConfig& c = net.config;
  const TargetRows& rows = d.rows;
  FineLosses l;
  if (d.candidates.empty() || rows.all.empty()) return l;
  const FineMask m = drawFineMask(d.candidates, s, c, random);
  const std::vector<Coord>& around = m.frontier.empty() ? m.others : m.frontier;
  if (around.empty()) return l;

  const Coord centre_token =
      around[size_t(torch::randint(int64_t(around.size()), {1}, random).item<int64_t>())];
  const Eigen::Vector3d centre(centre_token.x(), centre_token.y(), centre_token.z());
  std::vector<Coord> targets =
      nearestOf(m.frontier, centre, int64_t(c.frontier_share * float(c.chunk_tokens)));
  for (const Coord& t : nearestOf(m.others, centre, c.chunk_tokens - int64_t(targets.size())))
    targets.push_back(t);

  // Context: nearest of condition, visible and wrong tokens together, as inference takes them.
  auto anyRow = [&] {
    return rows.all[size_t(torch::randint(int64_t(rows.all.size()), {1}, random).item<int64_t>())];
  };
  std::vector<Coord> context = s.condition.ijk;
  context.insert(context.end(), m.visible.begin(), m.visible.end());
  context.insert(context.end(), m.false_visible.begin(), m.false_visible.end());
  FineChunk chunk = fineChunk(d.scene, d.gate(), context, s.condition.size(), targets, centre,
                              c.context_tokens, c.empty_tokens);
  TokenSets& in = chunk.tokens;
  // A wrong token carries some true token's latent: plausible content in a wrong place.
  std::vector<int64_t> visible_rows;
  for (const Coord& token : in[kVisible].coords) {
    const int64_t own_row = rows.find(token);
    visible_rows.push_back(own_row >= 0 ? own_row : anyRow());
  }
  in[kCondition].features =
      d.condition_z.index_select(0, torch::tensor(chunk.rows[kCondition], torch::kInt64));
  in[kVisible].features = d.target_z.index_select(0, torch::tensor(visible_rows, torch::kInt64));
  in[kVisible].features =
      in[kVisible].features +
      drawUniform(0, c.context_noise, random) * torch::randn(in[kVisible].features.sizes(), random);
  const CompleterNet::Fine f = net.fine(in, d.frame);
  l.fine = occupancyLoss(f.logits, labelsOf(targets, s.target_nodes, c.unobserved_weight), c);

  const SnrWeight weight = c.paper_snr_weight ? SnrWeight::kSnr : SnrWeight::kInverse;
  auto latentLoss = [&](DiffusionHead& head, const Tensor& tokens,
                        const std::vector<Coord>& coords) {
    std::vector<int64_t> token_rows, target_rows;
    for (size_t i = 0; i < coords.size(); ++i) {
      const int64_t row = rows.find(coords[i]);
      if (row >= 0) token_rows.push_back(int64_t(i)), target_rows.push_back(row);
    }
    if (token_rows.empty()) return DiffusionHead::Loss{torch::zeros({}), torch::zeros({})};
    return head.loss(tokens.index_select(0, torch::tensor(token_rows)),
                     d.target_z.index_select(0, torch::tensor(target_rows)), colour_way,
                     c.diffusion_draws, weight, random);
  };
  const auto latent = latentLoss(*net.diffusion, f.targets, targets);
  l.linear = latent.linear, l.diffusion = latent.diffusion;
  // A fraction of the condition tokens is enough for a head that no other part learns from.
  const std::vector<Coord> some(
      in[kCondition].coords.begin(),
      in[kCondition].coords.begin() +
          std::ptrdiff_t(std::min<size_t>(64, in[kCondition].coords.size())));
  const auto refined =
      latentLoss(*net.refinement, f.conditions.slice(0, 0, int64_t(some.size())).detach(), some);
  l.refinement = refined.linear + c.diffusion_weight * refined.diffusion;
  return l;
}

// Target latents of some samples.
Tensor someLatents(const SampleSource& samples, int64_t count) {
  std::vector<Tensor> all;
  for (int64_t i = 0; i < std::min<int64_t>(count, 32); ++i) {
    const CompletionSample s = samples(uint64_t(i));
    all.push_back(torch::tensor(s.target.z).view({s.target.size(), -1}));
  }
  return torch::cat(all);
}

// The colour way [K, D] as a function of standardised latents, each row's results of unit
// deviation: where walls are white and floors brown, a tint is a small error of few channels and a
// large one of these.
Tensor colourWayOf(const std::vector<float>& rows, const Tensor& latents, const CompleterNet& net) {
  const Tensor way = torch::tensor(rows).view({-1, latents.size(1)});
  const Tensor deviation = torch::matmul(latents, way.t()).std(0).clamp_min(1e-3);
  return way * net.latent_deviation / deviation.unsqueeze(1);
}

// Roll-outs on validation samples: precision, recall, F1 on the nodes that were unobserved.
std::map<std::string, double> validate(const std::string& weights,
                                       const std::vector<CompletionSample>& samples) {
  const Completer completer(weights);
  // Fixed, so that logs compare whatever the program's defaults are.
  CompleteSettings settings;
  settings.tau = .5f, settings.coarse_tau = .1f, settings.hole_tau = 1;
  Progress silent;
  double precision = 0, recall = 0, f1 = 0, error = 0;
  for (const CompletionSample& s : samples) {
    const Place whole = completer.complete(s.condition, settings, silent);
    double hit = 0, filled = 0, truth = 0, known = 0, squared = 0, matched = 0;
    for (const Coord& node : filledNodes(s.target_nodes))
      truth += s.seen_nodes.box.isInside(node) && s.seen_nodes.at(node) == NodeState::kUnobserved;
    const TargetRows rows(s);
    for (int64_t k = s.condition.size(); k < whole.size(); ++k) {
      const NodeState state = s.target_nodes.at(whole.ijk[size_t(k)]);
      filled += 1, known += state != NodeState::kUnobserved, hit += state == NodeState::kFilled;
      const int64_t row = rows.find(whole.ijk[size_t(k)]);
      if (row < 0) continue;
      for (int d = 0; d < whole.dim; ++d)
        squared += std::pow(
            whole.z[size_t(k * whole.dim + d)] - s.target.z[size_t(row * whole.dim + d)], 2);
      matched += whole.dim;
    }
    const double p = filled > 0 ? hit / filled : 0, r = truth > 0 ? hit / truth : 0;
    precision += p, recall += r, f1 += p + r > 0 ? 2 * p * r / (p + r) : 0;
    error += matched > 0 ? squared / matched : 0;
  }
  const double n = double(std::max<size_t>(1, samples.size()));
  return {{"val_precision", precision / n},
          {"val_recall", recall / n},
          {"val_f1", f1 / n},
          {"val_latent_mse", error / n}};
}

// What the condition views saw, at node resolution, for roll-outs without the views.
std::shared_ptr<const SeenSpace> nodeSpace(const CompletionSample& s) {
  const auto space = std::make_shared<SeenSpace>();
  space->box = s.condition.frame.bounds;
  for (const Coord& node : filledNodes(s.seen_nodes))
    space->filled.sparseFill(voxelsIn(node, 1), true, true);
  for (const Coord& node : emptyNodes(s.seen_nodes))
    space->empty.sparseFill(voxelsIn(node, 1), true, true);
  return space;
}

void train(const CompleterConfig& config, const std::vector<float>& colour_way,
           const SampleSource& samples, int64_t sample_count, const SampleSource& validation,
           int validation_count, const TrainSettings& settings, const TrainListener& listener,
           Progress& progress) {
  torch::manual_seed(settings.seed);
  auto net = std::make_shared<CompleterNet>(config),
       average = std::make_shared<CompleterNet>(config);
  const Tensor latents = someLatents(samples, sample_count);
  if (!settings.from.empty()) {
    const TensorFile start = readTensors(settings.from);
    for (CompleterNet* n : {net.get(), average.get()}) loadModule(*n, "", start, settings.from);
  } else if (!settings.resume) {
    torch::NoGradGuard no_grad;
    for (CompleterNet* n : {net.get(), average.get()})
      n->latent_mean.copy_(latents.mean(0)),
          n->latent_deviation.copy_(latents.std(0).clamp_min(1e-3));
  }
  Trainer trainer(net, average, "completer", config.toJson(), settings, listener);
  const Tensor colours = colourWayOf(colour_way, latents, *net);
  std::vector<CompletionSample> held_out;
  for (int i = 0; i < validation_count; ++i) {
    held_out.push_back(validation(uint64_t(i)));
    held_out.back().condition.seen = nodeSpace(held_out.back());
  }
  // A fresh order of all samples every epoch, known from the sample's number alone.
  auto load = [&](int64_t first) {
    std::vector<CompletionSample> all;
    for (int64_t at = first; at < first + trainer.samples(); ++at) {
      torch::Generator epoch =
          at::detail::createCPUGenerator(settings.seed + 17 + uint64_t(at / sample_count));
      all.push_back(samples(
          uint64_t(torch::randperm(sample_count, epoch)[at % sample_count].item<int64_t>())));
    }
    return all;
  };
  progress.start("train completer");
  while (!trainer.done()) {
    const int64_t first = trainer.firstSample();
    const std::vector<CompletionSample> current = load(first);
    // Before the coarse stage is any good, there is nothing behind it to learn from.
    const double own_gate = 2 * trainer.step() < settings.steps ? 0 : double(config.own_gate_share);
    for (size_t k = 0; k < current.size(); ++k) {
      torch::Generator random =
          at::detail::createCPUGenerator(settings.seed * 1000003 + uint64_t(first) + k);
      const MixedPrecision mixed(settings.mixed_precision);
      const DrawnScene scene = drawScene(*net, current[k], own_gate, random);
      const double coarse = scene.coarse_loss.item<double>();
      trainer.addLoss(scene.coarse_loss, {{"loss", coarse}, {"coarse", coarse}});
      // One after the other: a sample's graph is gone before the next one is made.
      for (int64_t draw = 0; draw < settings.fine_draws; ++draw) {
        const FineLosses l = fineLosses(*net, current[k], scene, colours, random);
        const Tensor total = l.total(config) / double(settings.fine_draws);
        const auto logged = [&](const Tensor& loss) {
          return loss.item<double>() / double(settings.fine_draws);
        };
        trainer.addLoss(total, {{"loss", total.item<double>()},
                                {"fine", logged(l.fine)},
                                {"linear", logged(l.linear)},
                                {"diffusion", logged(l.diffusion)},
                                {"refinement", logged(l.refinement)}});
      }
    }
    trainer.update();
    if (trainer.validationDue()) {
      trainer.saveWeights();
      trainer.log(validate(settings.weights_path, held_out));
    }
    trainer.saveIfDue();
    trainer.stopIfInterrupted(progress);
  }
  progress.end();
}

}  // namespace

void trainCompleter(const CompleterConfig& config, const std::vector<float>& colour_way,
                    const SampleSource& samples, int64_t sample_count,
                    const SampleSource& validation, int validation_count,
                    const TrainSettings& settings, const TrainListener& listener,
                    Progress& progress) {
  withThreads(1, [&] {
    train(config, colour_way, samples, sample_count, validation, validation_count, settings,
          listener, progress);
  });
}

CompleterStep completerStep(const CompleterConfig& config, const CompletionSample& sample,
                            uint64_t seed) {
  torch::manual_seed(seed);
  auto net = std::make_shared<CompleterNet>(config);
  torch::optim::AdamW optimiser(net->parameters(), torch::optim::AdamWOptions(1e-3));
  const Tensor colours = torch::eye(config.latent_dim).slice(0, 0, 1);
  CompleterStep result;
  auto gradientSum = [](torch::nn::Module& module) {
    double sum = 0;
    for (const auto& p : module.parameters())
      if (p.grad().defined()) sum += p.grad().abs().sum().item<double>();
    return sum;
  };
  for (double* loss : {&result.before, &result.after}) {
    optimiser.zero_grad();
    torch::Generator random = at::detail::createCPUGenerator(seed);
    const DrawnScene scene = drawScene(*net, sample, double(config.own_gate_share), random);
    const FineLosses l = fineLosses(*net, sample, scene, colours, random);
    const Tensor total = scene.coarse_loss + l.total(config);
    *loss = total.item<double>();
    if (loss == &result.before && l.refinement.requires_grad()) {
      l.refinement.backward({}, true);
      result.trunk_gradient_of_refinement = gradientSum(*net->trunk);
      optimiser.zero_grad();
    }
    total.backward();
    if (loss == &result.before) result.gradient_sum = gradientSum(*net);
    optimiser.step();
  }
  return result;
}

namespace {

constexpr int kMaxSampleSide = 8192;  // nodes

// What was seen as tensors NAME.box [7] (level, corners), NAME.filled and NAME.empty [n, 3].
void addSeen(const SeenSpace& s, const std::string& name, TensorFile* file) {
  const Coord &lo = s.box.min(), &hi = s.box.max();
  file->tensors[name + ".box"] =
      torch::tensor({s.level, lo.x(), lo.y(), lo.z(), hi.x(), hi.y(), hi.z()}, torch::kInt32);
  file->tensors[name + ".filled"] = coordTensor(filledNodes(s));
  file->tensors[name + ".empty"] = coordTensor(emptyNodes(s));
}

SeenSpace readSeen(const TensorFile& file, const std::string& name, const std::string& path) {
  const auto get = [&](const char* part) {
    const auto found = file.tensors.find(name + part);
    require(found != file.tensors.end() && found->second.scalar_type() == torch::kInt32,
            "readSample: ", path, ": expected a tensor ", name, part);
    return found->second;
  };
  SeenSpace s;
  const Tensor box = get(".box");
  require(box.numel() == 7, "readSample: ", path, ": ", name, ": bad box");
  const int32_t* b = box.data_ptr<int32_t>();
  s.level = b[0];
  s.box = CoordBBox(Coord(b[1], b[2], b[3]), Coord(b[4], b[5], b[6]));
  for (int i = 0; i < 3; ++i)
    require(b[4 + i] >= b[1 + i] && int64_t(b[4 + i]) - b[1 + i] < kMaxSampleSide,
            "readSample: ", path, ": expected a box of at most ", kMaxSampleSide, " nodes a side");
  for (auto [part, mask] :
       {std::pair<const char*, TokenMask*>{".filled", &s.filled}, {".empty", &s.empty}}) {
    const Tensor coords = get(part);
    require(coords.dim() == 2 && coords.size(1) == 3, "readSample: ", path, ": ", name, part,
            ": expected coordinates");
    const int32_t* p = coords.data_ptr<int32_t>();
    for (int64_t i = 0; i < coords.size(0); ++i, p += 3) {
      const Coord c(p[0], p[1], p[2]);
      require(s.box.isInside(c), "readSample: ", path, ": ", name, part, ": ", c,
              " lies outside the box");
      mask->setValueOn(c);
    }
  }
  openvdb::tools::prune(s.empty);
  return s;
}

}  // namespace

void writeSample(const CompletionSample& s, const std::string& path) {
  TensorFile file;
  for (const auto& [name, grid] :
       {std::pair<const char*, const Place*>{"condition", &s.condition}, {"target", &s.target}}) {
    file.tensors[joinText(name, ".ijk")] = coordTensor(grid->ijk);
    file.tensors[joinText(name, ".z")] = torch::tensor(grid->z).view({grid->size(), grid->dim});
  }
  addSeen(s.seen_nodes, "seen_nodes", &file);
  addSeen(s.seen_coarse, "seen_coarse", &file);
  addSeen(s.target_nodes, "target_nodes", &file);
  addSeen(s.target_coarse, "target_coarse", &file);
  const CoordBBox& b = s.condition.frame.bounds;
  file.tensors["bounds"] =
      torch::tensor({b.min().x(), b.min().y(), b.min().z(), b.max().x(), b.max().y(), b.max().z()},
                    torch::kInt32);
  file.tensors["voxel_m"] = torch::tensor({s.condition.frame.voxel_m});
  writeTensors(file, path);
}

CompletionSample readSample(const std::string& path) {
  const TensorFile file = readTensors(path);
  auto get = [&](const std::string& name, torch::ScalarType type) {
    const auto found = file.tensors.find(name);
    require(found != file.tensors.end() && found->second.scalar_type() == type,
            "readSample: ", path, ": expected a tensor ", name);
    return found->second;
  };
  CompletionSample s{{},
                     {},
                     readSeen(file, "seen_nodes", path),
                     readSeen(file, "seen_coarse", path),
                     readSeen(file, "target_nodes", path),
                     readSeen(file, "target_coarse", path)};
  const Tensor bounds = get("bounds", torch::kInt32), voxel = get("voxel_m", torch::kFloat32);
  require(bounds.numel() == 6 && voxel.numel() == 1, "readSample: ", path, ": bad frame");
  for (const auto& [name, grid] :
       {std::pair<const char*, Place*>{"condition", &s.condition}, {"target", &s.target}}) {
    const Tensor ijk = get(joinText(name, ".ijk"), torch::kInt32),
                 z = get(joinText(name, ".z"), torch::kFloat32);
    require(ijk.dim() == 2 && ijk.size(1) == 3 && z.dim() == 2 && z.size(0) == ijk.size(0),
            "readSample: ", path, ": ", name, ": coordinates and latents disagree");
    const int32_t* p = ijk.data_ptr<int32_t>();
    for (int64_t i = 0; i < ijk.size(0); ++i)
      grid->ijk.emplace_back(p[3 * i], p[3 * i + 1], p[3 * i + 2]);
    grid->dim = int(z.size(1));
    grid->z.assign(z.data_ptr<float>(), z.data_ptr<float>() + z.numel());
    grid->generated.assign(grid->ijk.size(), 0);
    grid->probability.assign(grid->ijk.size(), 1.f);
    grid->bfs_level.assign(grid->ijk.size(), 0);
    const int32_t* b = bounds.data_ptr<int32_t>();
    grid->frame.bounds = CoordBBox(Coord(b[0], b[1], b[2]), Coord(b[3], b[4], b[5]));
    grid->frame.voxel_m = voxel.item<float>();
  }
  return s;
}

}  // namespace vdbc
