#include "mar/completer_train.h"

#include <algorithm>
#include <cmath>
#include <future>
#include <set>
#include <unordered_map>

#include "encoder/trainer.h"
#include "mar/network.h"
#include "mar/training_masks.h"

namespace vdbc {
namespace {

constexpr float kFrontierShare = .6f;  // of a chunk's targets, at most
constexpr double kAlone = .75;         // of the samples: condition tokens are all that is visible
constexpr double kOwnGate =
    .75;  // of the second half's samples: the fine stage works behind the coarse one as it is
constexpr double kWindows = .5;  // of the samples: looked at through another window

double uniform(torch::Generator& random) { return torch::rand({1}, random).item<double>(); }
double uniform(double low, double high, torch::Generator& random) {
  return low + (high - low) * uniform(random);
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

CoarseMask drawCoarseMask(const std::vector<Coord>& unknown, const NodeStates& truth,
                          torch::Generator& random) {
  CoarseMask m;
  const std::vector<Coord> worked_on = selectRandom(unknown, uniform(.3, 1, random), random);
  // Inference is one shot from the condition tokens; half of the samples train just that.
  const double hidden = uniform(random) < .5 ? 1.0 : uniform(.5, 1, random);
  const Tensor draws = torch::rand({int64_t(worked_on.size())}, random);
  for (size_t i = 0; i < worked_on.size(); ++i) {
    const bool shown =
        truth.at(worked_on[i]) == NodeState::kFilled && draws.data_ptr<float>()[i] >= hidden;
    (shown ? m.visible : m.targets).push_back(worked_on[i]);
  }
  return m;
}

FineMask drawFineMask(const std::vector<Coord>& candidates, const CompletionSample& s,
                      double false_positives, torch::Generator& random) {
  FineMask m;
  const double kind = uniform(random);
  const bool alone = kind < kAlone, growth = kind < (1 + kAlone) / 2;
  const std::vector<int32_t> levels = breadthFirstLevels(candidates, s.condition.ijk);
  const int32_t deepest = levels.empty() ? 1 : *std::max_element(levels.begin(), levels.end());
  const int32_t depth = int32_t(torch::randint(alone ? deepest : 6, {1}, random).item<int64_t>());
  const Tensor draws = torch::rand({int64_t(candidates.size()), 2}, random);
  const double hidden = uniform(.5, 1, random);
  const double wrong = uniform(0, false_positives, random);
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

CoordBBox drawBounds(const CompletionSample& s, torch::Generator& random) {
  const VoxelFrame& frame = s.condition.frame;
  if (uniform(random) >= kWindows) return frame.bounds;
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
      std::any_of(s.condition.ijk.begin(), s.condition.ijk.end(), [&](const Coord& token) {
        return bounds.isInside(Coord(2 * token.x(), 2 * token.y(), 2 * token.z()));
      });
  return holds ? bounds : frame.bounds;
}

namespace {

// Truth and weight of positions: F 1, E 0, U 0 with the configured low weight (training.md, spec
// A1).
struct Labels {
  Tensor truth, weight;  // [N]
};
Labels labelsOf(const std::vector<Coord>& positions, const NodeStates& truth,
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

struct Losses {
  Tensor coarse, fine, linear, diffusion, refinement;
  Tensor total() const { return coarse + fine + linear + .5f * diffusion + .25f * refinement; }
};

// Target latents by position, where the dense views saw a surface: what else a file holds is no
// truth (spec A1).
struct TargetRows {
  std::unordered_map<uint64_t, int64_t> row;
  std::vector<int64_t> all;
  static uint64_t key(const Coord& c) {
    return uint64_t(uint32_t(c.x() + (1 << 20))) << 42 |
           uint64_t(uint32_t(c.y() + (1 << 20))) << 21 | uint64_t(uint32_t(c.z() + (1 << 20)));
  }
  explicit TargetRows(const CompletionSample& s) {
    for (size_t i = 0; i < s.target.ijk.size(); ++i) {
      if (s.target_nodes.at(s.target.ijk[i]) != NodeState::kFilled) continue;
      row[key(s.target.ijk[i])] = int64_t(i);
      all.push_back(int64_t(i));
    }
  }
  int64_t find(const Coord& c) const {
    const auto found = row.find(key(c));
    return found == row.end() ? -1 : found->second;
  }
};

// The coarse stage: loss on a random subset of the unknown positions (A2), and its probabilities
// there.
Tensor coarseLoss(CompleterNet& net, const SceneTokens& scene, const CompletionSample& s,
                  const VoxelFrame& frame, torch::Generator& random, std::map<Coord, float>* gate) {
  for (const Coord& c : scene.coarse_filled) (*gate)[c] = 1;
  CoarseMask mask = drawCoarseMask(scene.coarse_unknown, s.target_coarse, random);
  for (const Coord& c : mask.visible) (*gate)[c] = 1;
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
  for (size_t i = 0; i < targets.size(); ++i) (*gate)[targets[i]] = p.data_ptr<float>()[i];
  // Positions not worked on get the probability that a middling coarse stage would give them, so
  // that the fine stage sees whole neighbourhoods.
  const Tensor draws = torch::rand({int64_t(scene.coarse_unknown.size()), 2}, random);
  for (size_t i = 0; i < scene.coarse_unknown.size(); ++i) {
    const float* d = draws.data_ptr<float>() + 2 * i;
    if (s.target_coarse.at(scene.coarse_unknown[i]) == NodeState::kFilled) {
      gate->emplace(scene.coarse_unknown[i], .3f + .7f * d[0]);
    } else if (d[1] < .08f) {
      gate->emplace(scene.coarse_unknown[i], .05f + .45f * d[0]);
    }
  }
  return occupancyLoss(logits, labelsOf(targets, s.target_coarse, net.config.unobserved_weight),
                       net.config);
}

Losses sampleLosses(CompleterNet& net, const CompletionSample& s, const Tensor& colour_way,
                    double own_gate, torch::Generator& random) {
  const CompleterConfig& c = net.config;
  VoxelFrame frame = s.condition.frame;
  frame.bounds = drawBounds(s, random);
  const SceneTokens scene =
      sceneTokens(statesIn(s.seen_nodes, frame.bounds), statesIn(s.seen_coarse, frame.bounds));
  std::map<Coord, float> gate;
  Losses l;
  l.coarse = c.coarse_stage ? coarseLoss(net, scene, s, frame, random, &gate) : torch::zeros({});
  l.fine = l.linear = l.diffusion = l.refinement = torch::zeros({});

  // The fine stage works inside what the coarse stage keeps, as it is or as a better one would be:
  // all of the truth and what it takes for true.
  const bool own = !c.coarse_stage || uniform(random) < own_gate;
  const double tau = own ? CompleteSettings().coarse_tau : uniform(.05, .5, random);
  if (own) {
    torch::NoGradGuard no_grad;
    gate.clear();
    for (const Coord& node : scene.coarse_filled) gate[node] = 1;
    // What a larger window adds is all unseen: none of it is worth the fine stage's time.
    std::vector<Coord> near;
    for (const Coord& node : scene.coarse_unknown)
      if (s.seen_coarse.box.isInside(node)) near.push_back(node);
    net.coarseProbabilities(scene, near, frame, &gate);
  }
  std::vector<Coord> open;
  for (const auto& [node, probability] : gate)
    if (probability > tau || (!own && s.target_coarse.at(node) == NodeState::kFilled))
      open.push_back(node);
  const std::vector<Coord> candidates = unobservedChildren(open, scene.nodes);
  const TargetRows rows(s);
  if (candidates.empty() || rows.all.empty()) return l;
  const FineMask m = drawFineMask(candidates, s, c.context_false_positives, random);
  const std::vector<Coord>& around = m.frontier.empty() ? m.others : m.frontier;
  if (around.empty()) return l;

  const Coord centre_token =
      around[size_t(torch::randint(int64_t(around.size()), {1}, random).item<int64_t>())];
  const Eigen::Vector3d centre(centre_token.x(), centre_token.y(), centre_token.z());
  std::vector<Coord> targets =
      nearestOf(m.frontier, centre, int64_t(kFrontierShare * float(c.chunk_tokens)));
  for (const Coord& t : nearestOf(m.others, centre, c.chunk_tokens - int64_t(targets.size())))
    targets.push_back(t);

  // Context: nearest of condition, visible and wrong tokens together, as inference takes them.
  auto anyRow = [&] {
    return rows.all[size_t(torch::randint(int64_t(rows.all.size()), {1}, random).item<int64_t>())];
  };
  std::vector<Coord> context = s.condition.ijk;
  context.insert(context.end(), m.visible.begin(), m.visible.end());
  context.insert(context.end(), m.false_visible.begin(), m.false_visible.end());
  std::array<TokenSet, kTokenKinds> in;
  std::vector<int64_t> condition_rows, visible_rows;
  for (int64_t row : nearestRows(context, centre, c.context_tokens)) {
    const Coord token = context[size_t(row)];
    if (row < s.condition.size()) {
      in[kCondition].coords.push_back(token);
      condition_rows.push_back(row);
    } else {
      in[kVisible].coords.push_back(token);
      // A wrong token carries some true token's latent: plausible content in a wrong place.
      const int64_t own = rows.find(token);
      visible_rows.push_back(own >= 0 ? own : anyRow());
    }
  }
  const Tensor condition_z =
      net.standardise(torch::tensor(s.condition.z).view({s.condition.size(), -1}));
  const Tensor target_z = net.standardise(torch::tensor(s.target.z).view({s.target.size(), -1}));
  in[kCondition].features =
      condition_z.index_select(0, torch::tensor(condition_rows, torch::kInt64));
  in[kVisible].features = target_z.index_select(0, torch::tensor(visible_rows, torch::kInt64));
  in[kVisible].features =
      in[kVisible].features +
      uniform(0, c.context_noise, random) * torch::randn(in[kVisible].features.sizes(), random);
  in[kEmptyToken].coords = nearestOf(scene.empty_shell, centre, c.empty_tokens);
  std::vector<float> parent_probability;
  for (const Coord& t : targets) {
    const auto found = gate.find(tokenCoord(t, 1));
    parent_probability.push_back(found == gate.end() ? 0.f : found->second);
  }
  in[kTarget] = {torch::tensor(parent_probability).unsqueeze(1), targets};

  const CompleterNet::Fine f = net.fine(in, frame);
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
                     target_z.index_select(0, torch::tensor(target_rows)), colour_way,
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
  l.refinement = refined.linear + .5f * refined.diffusion;
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
    for (auto node = s.seen_nodes.box.begin(); node; ++node)
      truth += s.seen_nodes.at(*node) == NodeState::kUnobserved &&
               s.target_nodes.at(*node) == NodeState::kFilled;
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
  for (auto node = s.seen_nodes.box.begin(); node; ++node) {
    const NodeState state = s.seen_nodes.at(*node);
    if (state == NodeState::kUnobserved) continue;
    TokenMask& mask = state == NodeState::kFilled ? space->filled : space->empty;
    for (int slot = 0; slot < 8; ++slot) mask.setValueOn(childCoord(*node, slot));
  }
  return space;
}

}  // namespace

void trainCompleter(const CompleterConfig& config, const std::vector<float>& colour_way,
                    const SampleSource& samples, int64_t sample_count,
                    const SampleSource& validation, int validation_count,
                    const TrainSettings& settings, const TrainListener& listener,
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
  std::future<std::vector<CompletionSample>> next;
  progress.start("train completer");
  while (!trainer.done()) {
    const int64_t first = trainer.firstSample();
    const std::vector<CompletionSample> current = next.valid() ? next.get() : load(first);
    next = std::async(std::launch::async, load, first + settings.batch);
    // Before the coarse stage is any good, there is nothing behind it to learn from.
    const double own_gate = 2 * trainer.step() < settings.steps ? 0 : kOwnGate;
    for (size_t k = 0; k < current.size(); ++k) {
      torch::Generator random =
          at::detail::createCPUGenerator(settings.seed * 1000003 + uint64_t(first) + k);
      const MixedPrecision mixed(settings.mixed_precision);
      const Losses l = sampleLosses(*net, current[k], colours, own_gate, random);
      const Tensor total = l.total();
      trainer.addSample(total, {{"loss", total.item<double>()},
                                {"coarse", l.coarse.item<double>()},
                                {"fine", l.fine.item<double>()},
                                {"linear", l.linear.item<double>()},
                                {"diffusion", l.diffusion.item<double>()},
                                {"refinement", l.refinement.item<double>()}});
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
    const Losses l = sampleLosses(*net, sample, colours, kOwnGate, random);
    *loss = l.total().item<double>();
    if (loss == &result.before && l.refinement.requires_grad()) {
      l.refinement.backward({}, true);
      result.trunk_gradient_of_refinement = gradientSum(*net->trunk);
      optimiser.zero_grad();
    }
    l.total().backward();
    if (loss == &result.before) result.gradient_sum = gradientSum(*net);
    optimiser.step();
  }
  return result;
}

namespace {

Tensor stateTensor(const NodeStates& s) {
  Tensor t = torch::empty({7 + int64_t(s.states.size() + 3) / 4}, torch::kInt32);
  int32_t* p = t.data_ptr<int32_t>();
  p[0] = s.level;
  for (int i = 0; i < 3; ++i) p[1 + i] = s.box.min()[i], p[4 + i] = s.box.max()[i];
  std::memcpy(p + 7, s.states.data(), s.states.size());
  return t;
}

NodeStates statesOf(const Tensor& t, const std::string& path) {
  require(t.scalar_type() == torch::kInt32 && t.numel() >= 7, "readSample: ", path, ": bad states");
  const int32_t* p = t.data_ptr<int32_t>();
  NodeStates s;
  s.level = p[0];
  s.box = CoordBBox(Coord(p[1], p[2], p[3]), Coord(p[4], p[5], p[6]));
  for (int i = 0; i < 3; ++i)
    require(p[4 + i] >= p[1 + i] && int64_t(p[4 + i]) - p[1 + i] < 8192, "readSample: ", path,
            ": expected a box of at most 8192 nodes a side");
  const int64_t n = int64_t(s.box.volume());
  require(t.numel() == 7 + (n + 3) / 4, "readSample: ", path, ": expected ", n,
          " states, found another count");
  s.states.resize(size_t(n));
  std::memcpy(s.states.data(), p + 7, size_t(n));
  for (NodeState state : s.states)
    require(uint8_t(state) <= 2, "readSample: ", path, ": a state is none of F, E, U");
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
  file.tensors["seen_nodes"] = stateTensor(s.seen_nodes);
  file.tensors["seen_coarse"] = stateTensor(s.seen_coarse);
  file.tensors["target_nodes"] = stateTensor(s.target_nodes);
  file.tensors["target_coarse"] = stateTensor(s.target_coarse);
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
  CompletionSample s;
  s.seen_nodes = statesOf(get("seen_nodes", torch::kInt32), path);
  s.seen_coarse = statesOf(get("seen_coarse", torch::kInt32), path);
  s.target_nodes = statesOf(get("target_nodes", torch::kInt32), path);
  s.target_coarse = statesOf(get("target_coarse", torch::kInt32), path);
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
