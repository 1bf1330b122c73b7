#include "mar/completer.h"

#include <algorithm>
#include <map>
#include <nlohmann/json.hpp>
#include <set>

#include "encoder/weights.h"
#include "mar/network.h"

namespace vdbc {

using nlohmann::json;

CompleterConfig CompleterConfig::paper() {
  CompleterConfig c;
  c.preset = "paper";
  c.width = 512, c.heads = 16, c.layers = 5;
  c.coarse_width = 512, c.coarse_heads = 16, c.coarse_layers = 2;
  c.diffusion_width = 512, c.paper_snr_weight = true;
  c.context_tokens = 4096, c.empty_tokens = 512, c.chunk_tokens = 2048;
  c.coarse_chunk_tokens = 8192, c.diffusion_draws = 4;
  c.focal_gamma = 2, c.unobserved_weight = 0;
  return c;
}

namespace {
template <typename Config, typename Visit>
void visitFields(Config& c, Visit&& visit) {
  visit("preset", c.preset), visit("latent_dim", c.latent_dim);
  visit("latent_groups", c.latent_groups);
  visit("width", c.width), visit("heads", c.heads), visit("layers", c.layers);
  visit("coarse_width", c.coarse_width), visit("coarse_heads", c.coarse_heads);
  visit("coarse_layers", c.coarse_layers);
  visit("diffusion_width", c.diffusion_width), visit("diffusion_steps", c.diffusion_steps);
  visit("diffusion_draws", c.diffusion_draws), visit("paper_snr_weight", c.paper_snr_weight);
  visit("rotary_positions", c.rotary_positions), visit("position_code", c.position_code);
  visit("context_tokens", c.context_tokens), visit("empty_tokens", c.empty_tokens);
  visit("chunk_tokens", c.chunk_tokens), visit("coarse_empty_tokens", c.coarse_empty_tokens);
  visit("coarse_chunk_tokens", c.coarse_chunk_tokens);
  visit("focal_gamma", c.focal_gamma), visit("focal_alpha", c.focal_alpha);
  visit("unobserved_weight", c.unobserved_weight);
}
}  // namespace

std::string CompleterConfig::toJson() const {
  json j;
  visitFields(*this, [&](const char* name, const auto& value) { j[name] = value; });
  return j.dump();
}

CompleterConfig CompleterConfig::fromJson(const std::string& text, const std::string& where) {
  CompleterConfig c;
  try {
    const json j = json::parse(text);
    visitFields(c, [&](const char* name, auto& value) { j.at(name).get_to(value); });
  } catch (const json::exception& e) {
    throw Error(joinText("CompleterConfig: ", where, ": bad configuration: ", e.what()));
  }
  auto within = [&](const char* name, int value, int low, int high) {
    require(value >= low && value <= high, "CompleterConfig: ", where, ": expected ", name, " in [",
            low, ", ", high, "], found ", value);
  };
  within("latent_dim", c.latent_dim, 1, 1024), within("latent_groups", c.latent_groups, 0, c.latent_dim), within("width", c.width, 1, 4096);
  within("heads", c.heads, 1, 64), within("layers", c.layers, 1, 64);
  within("coarse_width", c.coarse_width, 1, 4096), within("coarse_heads", c.coarse_heads, 1, 64);
  within("coarse_layers", c.coarse_layers, 1, 64);
  within("diffusion_width", c.diffusion_width, 1, 4096);
  within("diffusion_steps", c.diffusion_steps, 2, 100000);
  within("context_tokens", c.context_tokens, 1, 1 << 20);
  within("empty_tokens", c.empty_tokens, 0, 1 << 20), within("chunk_tokens", c.chunk_tokens, 1, 1 << 20);
  within("coarse_empty_tokens", c.coarse_empty_tokens, 1, 1 << 20);
  within("coarse_chunk_tokens", c.coarse_chunk_tokens, 1, 1 << 20);
  require((c.latent_groups == 0 || c.latent_dim % c.latent_groups == 0) && c.width % (2 * c.heads) == 0 && c.coarse_width % (2 * c.coarse_heads) == 0,
          "CompleterConfig: ", where, ": widths are not multiples of twice their heads, or the latents of their groups");
  return c;
}

struct Completer::Impl {
  std::shared_ptr<CompleterNet> net;
  std::string hash, trained_on;

  // The growing grid: latents standardised, provenance beside them.
  struct Growth {
    std::vector<Coord> ijk;
    Tensor z;  // [N, D] standardised
    int64_t seeds = 0;
    std::vector<float> probability;
    std::vector<int32_t> level;
  };

  Growth seed(const LatentGrid& seen) const {
    const int d = net->config.latent_dim;
    require(seen.level == 1 && seen.dim == d, "Completer: the latent grid: expected ", d,
            " channels at level 1, found ", seen.dim, " at level ", seen.level);
    require(seen.size() > 0, "Completer: the latent grid is empty (expected observed tokens)");
    Growth g;
    g.ijk = seen.ijk;
    g.z = net->standardise(torch::tensor(seen.z).view({seen.size(), d}));
    g.seeds = seen.size();
    g.probability = seen.probability;
    g.level = seen.bfs_level;
    return g;
  }

  // Coarse probabilities of every coarse node with unseen content (1 where filled).
  std::map<Coord, float> coarseGate(const SceneTokens& scene, const VoxelFrame& frame) const {
    std::map<Coord, float> gate;
    for (const Coord& c : scene.coarse_filled) gate[c] = 1;
    const std::vector<Coord>& unknown = scene.coarse_unknown;
    const Tensor order = zOrder(unknown);
    const int64_t n = int64_t(unknown.size()), size = net->config.coarse_chunk_tokens;
    const int64_t chunks = (n + size - 1) / size;
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      std::vector<Coord> targets;
      for (int64_t i = chunk * n / chunks; i < (chunk + 1) * n / chunks; ++i)
        targets.push_back(unknown[size_t(order.data_ptr<int64_t>()[i])]);
      const Tensor p = net->coarseLogits(coarseInputs(scene, {}, targets, net->config.coarse_empty_tokens), frame)
                           .sigmoid().contiguous();
      for (size_t i = 0; i < targets.size(); ++i) gate[targets[i]] = p.data_ptr<float>()[i];
    }
    return gate;
  }

  struct Prediction {
    Tensor probability;  // [n]
    Tensor z;            // [n, D] standardised
  };

  // One chunk: targets that lie close together, with what is nearest to them as context.
  Prediction predict(const Growth& g, const SceneTokens& scene, const std::map<Coord, float>& gate,
                     const std::vector<Coord>& targets, const VoxelFrame& frame,
                     const CompleteSettings& s, torch::Generator& random) const {
    Eigen::Vector3d centre = Eigen::Vector3d::Zero();
    for (const Coord& c : targets) centre += Eigen::Vector3d(c.x(), c.y(), c.z());
    centre /= double(targets.size());
    std::array<TokenSet, kTokenKinds> in;
    std::vector<int64_t> rows[2];
    for (int64_t row : nearestRows(g.ijk, centre, net->config.context_tokens)) {
      const int kind = row >= g.seeds;
      rows[kind].push_back(row);
      in[size_t(kind)].coords.push_back(g.ijk[size_t(row)]);
    }
    for (size_t kind = 0; kind < 2; ++kind)
      in[kind].features = g.z.index_select(0, torch::tensor(rows[kind], torch::kInt64));
    for (int64_t row : nearestRows(scene.empty_shell, centre, net->config.empty_tokens))
      in[kEmptyToken].coords.push_back(scene.empty_shell[size_t(row)]);
    in[kTarget].coords = targets;
    std::vector<float> parent_probability;
    for (const Coord& c : targets) {
      const auto found = gate.find(tokenCoord(c, 1));
      parent_probability.push_back(found == gate.end() ? 0.f : found->second);
    }
    in[kTarget].features = torch::tensor(parent_probability).unsqueeze(1);
    const CompleterNet::Fine f = net->fine(in, frame);
    return {f.logits.sigmoid(),
            net->project(net->diffusion->sample(f.targets, s.sampling_steps, s.temperature, random))};
  }

  // Visits candidates level by level; keeps those that `keep` accepts given their probability.
  template <typename Keep>
  void grow(Growth* g, const SceneTokens& scene, const std::map<Coord, float>& gate,
            const std::vector<Coord>& candidates, const VoxelFrame& frame, const CompleteSettings& s,
            Keep keep, Progress& progress) const {
    torch::Generator random = at::detail::createCPUGenerator(s.seed);
    const std::vector<int32_t> levels = breadthFirstLevels(candidates, g->ijk, s.neighbours);
    const int32_t last = levels.empty() ? 0 : *std::max_element(levels.begin(), levels.end());
    for (int32_t level = 1; level <= last; ++level) {
      report(progress, int(100 * (level - 1) / last));
      std::vector<Coord> frontier;
      for (size_t i = 0; i < candidates.size(); ++i)
        if (levels[i] == level) frontier.push_back(candidates[i]);
      if (frontier.empty()) continue;
      const Tensor order = zOrder(frontier);
      const int64_t n = int64_t(frontier.size());
      const int64_t chunks = (n + net->config.chunk_tokens - 1) / net->config.chunk_tokens;
      std::vector<Coord> kept;
      std::vector<float> kept_probability;
      std::vector<Tensor> kept_z;
      for (int64_t c = 0; c < chunks; ++c) {
        report(progress, -1);
        std::vector<Coord> targets;
        for (int64_t i = c * n / chunks; i < (c + 1) * n / chunks; ++i)
          targets.push_back(frontier[size_t(order.data_ptr<int64_t>()[i])]);
        const Prediction p = predict(*g, scene, gate, targets, frame, s, random);
        const Tensor probability = p.probability.contiguous();
        std::vector<int64_t> rows;
        for (size_t i = 0; i < targets.size(); ++i) {
          const float chance = probability.data_ptr<float>()[i];
          if (!keep(chance)) continue;
          rows.push_back(int64_t(i));
          kept.push_back(targets[i]);
          kept_probability.push_back(chance);
        }
        kept_z.push_back(p.z.index_select(0, torch::tensor(rows, torch::kInt64)));
      }
      // Only now: every chunk of a level saw the same context.
      g->z = torch::cat({g->z, torch::cat(kept_z)});
      g->ijk.insert(g->ijk.end(), kept.begin(), kept.end());
      g->probability.insert(g->probability.end(), kept_probability.begin(), kept_probability.end());
      g->level.insert(g->level.end(), kept.size(), level);
    }
  }

  // Condition latents rewritten from everything that was decoded (spec A8), chunk by chunk.
  void refine(Growth* g, const SceneTokens& scene, const VoxelFrame& frame, const CompleteSettings& s) const {
    torch::Generator random = at::detail::createCPUGenerator(s.seed + 1);
    const Tensor order = zOrder(std::vector<Coord>(g->ijk.begin(), g->ijk.begin() + g->seeds));
    const Tensor before = g->z.clone();
    const int64_t chunk = net->config.chunk_tokens;
    for (int64_t begin = 0; begin < g->seeds; begin += chunk) {
      const Tensor rows = order.slice(0, begin, std::min(g->seeds, begin + chunk));
      std::array<TokenSet, kTokenKinds> in;
      Eigen::Vector3d centre = Eigen::Vector3d::Zero();
      for (int64_t i = 0; i < rows.size(0); ++i) {
        const Coord c = g->ijk[size_t(rows[i].item<int64_t>())];
        in[kCondition].coords.push_back(c);
        centre += Eigen::Vector3d(c.x(), c.y(), c.z());
      }
      centre /= double(rows.size(0));
      in[kCondition].features = before.index_select(0, rows);
      const std::vector<Coord> generated(g->ijk.begin() + g->seeds, g->ijk.end());
      std::vector<int64_t> near = nearestRows(generated, centre, net->config.context_tokens);
      for (int64_t& row : near) {
        in[kVisible].coords.push_back(generated[size_t(row)]);
        row += g->seeds;
      }
      in[kVisible].features = before.index_select(0, torch::tensor(near, torch::kInt64));
      for (int64_t row : nearestRows(scene.empty_shell, centre, net->config.empty_tokens))
        in[kEmptyToken].coords.push_back(scene.empty_shell[size_t(row)]);
      in[kTarget].features = torch::zeros({0, 1});
      const CompleterNet::Fine f = net->fine(in, frame);
      g->z.index_copy_(0, rows, net->project(net->refinement->sample(f.conditions, s.sampling_steps, s.temperature, random)));
    }
  }

  // Rows of `seen` first, exactly as they were unless refined.
  LatentGrid result(const Growth& g, const LatentGrid& seen, bool refined) const {
    LatentGrid out = seen;
    const Tensor z = net->restore(g.z).contiguous();
    const int64_t first = refined ? 0 : g.seeds;
    out.z.resize(size_t(first) * size_t(out.dim));
    out.z.insert(out.z.end(), z.data_ptr<float>() + first * out.dim, z.data_ptr<float>() + z.numel());
    out.ijk = g.ijk, out.probability = g.probability, out.bfs_level = g.level;
    out.observed.resize(g.ijk.size(), 0);
    return out;
  }
};

Completer::Completer(const std::string& path) : impl_(std::make_unique<Impl>()) {
  const TensorFile file = readTensors(path);
  const auto config = file.metadata.find("completer");
  require(config != file.metadata.end(), "Completer: ", path,
          ": expected completer weights, found a file of another kind");
  impl_->net = std::make_shared<CompleterNet>(CompleterConfig::fromJson(config->second, path));
  loadModule(*impl_->net, "", file, path);
  impl_->net->eval();
  impl_->hash = weightsHash(*impl_->net);
  const auto scenes = file.metadata.find("trained_on");
  if (scenes != file.metadata.end()) impl_->trained_on = scenes->second;
}
Completer::~Completer() = default;
Completer::Completer(Completer&&) noexcept = default;

const CompleterConfig& Completer::config() const { return impl_->net->config; }
std::string Completer::hash() const { return impl_->hash; }
std::string Completer::trainedOn() const { return impl_->trained_on; }

LatentGrid Completer::complete(const LatentGrid& seen, const ObservedSpace& space,
                               const CompleteSettings& s, Progress& progress) const {
  torch::NoGradGuard no_grad;
  progress.start("complete");
  Impl::Growth g = impl_->seed(seen);
  const SceneTokens scene = sceneTokens(poolStates(seen.frame, space, 1), poolStates(seen.frame, space, 2));
  const auto gate = impl_->coarseGate(scene, seen.frame);
  std::vector<Coord> open;
  for (const auto& [node, probability] : gate)
    if (probability > s.coarse_tau) open.push_back(node);
  impl_->grow(&g, scene, gate, unobservedChildren(open, scene.nodes), seen.frame, s,
              [&](float probability) { return probability > s.tau; }, progress);
  if (s.refine_observed) impl_->refine(&g, scene, seen.frame, s);
  progress.end();
  return impl_->result(g, seen, s.refine_observed);
}

LatentGrid Completer::completeAt(const LatentGrid& seen, const ObservedSpace& space,
                                 const std::vector<Coord>& occupied, const CompleteSettings& s,
                                 Progress& progress) const {
  torch::NoGradGuard no_grad;
  progress.start("complete");
  Impl::Growth g = impl_->seed(seen);
  const SceneTokens scene = sceneTokens(poolStates(seen.frame, space, 1), poolStates(seen.frame, space, 2));
  std::map<Coord, float> gate;
  std::vector<Coord> candidates;
  for (const Coord& c : std::set<Coord>(occupied.begin(), occupied.end())) {
    if (scene.nodes.at(c) != NodeState::kUnobserved) continue;
    candidates.push_back(c);
    gate[tokenCoord(c, 1)] = 1;
  }
  impl_->grow(&g, scene, gate, candidates, seen.frame, s, [](float) { return true; }, progress);
  progress.end();
  return impl_->result(g, seen, false);
}

}  // namespace vdbc
