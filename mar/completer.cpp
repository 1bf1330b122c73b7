#include "mar/completer.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <nlohmann/json.hpp>
#include <random>
#include <set>

#include "encoder/weights.h"
#include "mar/closing.h"
#include "mar/network.h"

namespace vdbc {

using nlohmann::json;

CompleterConfig CompleterConfig::paper() {
  CompleterConfig c;
  c.preset = "paper";
  c.latent_dim = 32, c.latent_groups = 8;
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
  visit("coarse_stage", c.coarse_stage);
  visit("context_noise", c.context_noise),
      visit("context_false_positives", c.context_false_positives);
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
  within("latent_dim", c.latent_dim, 1, 1024),
      within("latent_groups", c.latent_groups, 0, c.latent_dim), within("width", c.width, 1, 4096);
  within("heads", c.heads, 1, 64), within("layers", c.layers, 1, 64);
  within("coarse_width", c.coarse_width, 1, 4096), within("coarse_heads", c.coarse_heads, 1, 64);
  within("coarse_layers", c.coarse_layers, 1, 64);
  within("diffusion_width", c.diffusion_width, 1, 4096);
  within("diffusion_steps", c.diffusion_steps, 2, 100000),
      within("diffusion_draws", c.diffusion_draws, 0, 1024);
  within("context_tokens", c.context_tokens, 1, 1 << 20);
  within("empty_tokens", c.empty_tokens, 0, 1 << 20),
      within("chunk_tokens", c.chunk_tokens, 1, 1 << 20);
  within("coarse_empty_tokens", c.coarse_empty_tokens, 0, 1 << 20);
  within("coarse_chunk_tokens", c.coarse_chunk_tokens, 1, 1 << 20);
  require((c.latent_groups == 0 || c.latent_dim % c.latent_groups == 0) &&
              c.width % (2 * c.heads) == 0 && c.coarse_width % (2 * c.coarse_heads) == 0,
          "CompleterConfig: ", where,
          ": widths are not multiples of twice their heads, or the latents of their groups");
  return c;
}

namespace {

Eigen::Vector3d centreOf(const std::vector<Coord>& coords) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Coord& c : coords) sum += Eigen::Vector3d(c.x(), c.y(), c.z());
  return sum / double(coords.size());
}

}  // namespace

struct Completer::Impl {
  std::shared_ptr<CompleterNet> net;
  std::string hash, trained_on;

  // Standardised predictions as a file will hold them: a run that goes on from one sees the same
  // numbers.
  Tensor asFiled(const Tensor& z, bool project) const {
    return net->restore(project ? net->project(z) : z)
        .to(torch::kHalf)
        .to(torch::kFloat32)
        .contiguous();
  }

  // The growing place, observed rows first; `z` [N, D] has its latents standardised.
  struct Growth {
    Place place;
    Tensor z;
    std::vector<Coord> observed;

    int64_t seeds() const { return int64_t(observed.size()); }

    void append(const Place& more, CompleterNet& net) {
      z = torch::cat({z, net.standardise(torch::tensor(more.z).view({more.size(), more.dim}))});
      appendRows(&place, more);
    }
  };

  // No tokens, of the same latents.
  Place noTokens() const {
    Place none;
    none.dim = net->config.latent_dim;
    return none;
  }

  Growth begin(const Place& start, const CompleteSettings& s, Place* dropped) const {
    const int d = net->config.latent_dim;
    require(start.level == 1 && start.dim == d, "Completer: the place: expected latents of ", d,
            " channels at level 1, found ", start.dim, " at level ", start.level);
    const auto seeds = std::count(start.generated.begin(), start.generated.end(), uint8_t(0));
    const std::vector<Coord> observed(start.ijk.begin(), start.ijk.begin() + seeds);
    require(seeds > 0, "Completer: the place is empty (expected observed tokens)");
    require(std::is_sorted(start.generated.begin(), start.generated.end()),
            "Completer: the place: expected observed tokens before generated ones");
    auto stays = [&](size_t i) {
      return !s.resumed || !start.generated[i] || start.probability[i] > s.tau;
    };
    *dropped = keepRows(start, [&](size_t i) { return !stays(i); });
    Growth g{keepRows(start, stays), {}, observed};
    g.z = net->standardise(torch::tensor(g.place.z).view({g.place.size(), d}));
    return g;
  }

  // A part of the volume that the networks look at as one: what it decides, and the frame with its
  // surroundings, from whose middle positions are measured.
  struct Window {
    CoordBBox core;  // voxels
    VoxelFrame frame;
  };

  static std::vector<Window> windowsOf(const VoxelFrame& whole) {
    constexpr double kWindowM = 12.8, kOverlapM = 1.6;  // what the position code was trained for
    const int overlap = int(std::lround(kOverlapM / whole.voxel_m / 4)) * 4;
    std::array<std::vector<int>, 3> cuts;  // first voxel of each part and the end
    for (int axis = 0; axis < 3; ++axis) {
      const int begin = whole.bounds.min()[axis], side = whole.bounds.dim()[axis];
      const double side_m = side * double(whole.voxel_m);
      const int parts =
          side_m <= kWindowM ? 1 : int(std::ceil(side_m / (kWindowM - 2 * kOverlapM)));
      for (int part = 0; part < parts; ++part)
        cuts[size_t(axis)].push_back(part ? (begin + int(int64_t(side) * part / parts)) & ~3
                                          : begin);
      cuts[size_t(axis)].push_back(begin + side);
    }
    std::vector<Window> windows;
    for (size_t x = 0; x + 1 < cuts[0].size(); ++x)
      for (size_t y = 0; y + 1 < cuts[1].size(); ++y)
        for (size_t z = 0; z + 1 < cuts[2].size(); ++z) {
          Window w{CoordBBox(Coord(cuts[0][x], cuts[1][y], cuts[2][z]),
                             Coord(cuts[0][x + 1] - 1, cuts[1][y + 1] - 1, cuts[2][z + 1] - 1)),
                   whole};
          w.frame.bounds = w.core;
          w.frame.bounds.expand(overlap);
          w.frame.bounds.intersect(whole.bounds);
          windows.push_back(w);
        }
    return windows;
  }

  // What is known, and the coarse stage's probability of every coarse node with unseen content (1
  // where filled).
  struct Scene {
    SceneTokens tokens;
    std::vector<Window> windows;
    std::map<Coord, float> gate;

    size_t windowOf(const Coord& node) const {
      for (size_t w = 0; w < windows.size(); ++w)
        if (windows[w].core.isInside(Coord(2 * node.x(), 2 * node.y(), 2 * node.z()))) return w;
      return 0;
    }
  };

  static std::vector<std::vector<Coord>> byWindow(const Scene& scene,
                                                  const std::vector<Coord>& tokens) {
    std::vector<std::vector<Coord>> parts(scene.windows.size());
    for (const Coord& c : tokens) parts[scene.windowOf(c)].push_back(c);
    return parts;
  }

  static Scene sceneOf(const Place& start) {
    return {sceneTokens(poolStates(start.frame, *start.seen, 1),
                        poolStates(start.frame, *start.seen, 2)),
            windowsOf(start.frame),
            {}};
  }

  void openGate(Scene* scene) const {
    for (const Coord& c : scene->tokens.coarse_filled) scene->gate[c] = 1;
    for (const Window& w : scene->windows) {
      const SceneTokens part = sceneTokens(statesIn(scene->tokens.nodes, w.frame.bounds),
                                           statesIn(scene->tokens.coarse, w.frame.bounds));
      if (part.coarse_filled.empty()) continue;  // nothing to grow from
      std::vector<Coord> unknown;
      for (const Coord& c : part.coarse_unknown)
        if (w.core.isInside(Coord(c.x() * 4, c.y() * 4, c.z() * 4))) unknown.push_back(c);
      net->coarseProbabilities(part, unknown, w.frame, &scene->gate);
    }
  }

  // One chunk: targets that lie close together, with what is nearest to them as context.
  Place predict(const Growth& g, const Scene& scene, const std::vector<Coord>& targets,
                int32_t level, const CompleteSettings& s, torch::Generator& random) const {
    const Eigen::Vector3d centre = centreOf(targets);
    std::array<TokenSet, kTokenKinds> in;
    std::vector<int64_t> rows[2];
    const std::vector<Coord>& context = s.generated_context ? g.place.ijk : g.observed;
    for (int64_t row : nearestRows(
             context, centre, s.context_tokens ? s.context_tokens : net->config.context_tokens)) {
      const int kind = row >= g.seeds();
      rows[kind].push_back(row);
      in[size_t(kind)].coords.push_back(context[size_t(row)]);
    }
    for (size_t kind = 0; kind < 2; ++kind)
      in[kind].features = g.z.index_select(0, torch::tensor(rows[kind], torch::kInt64));
    in[kEmptyToken].coords = nearestOf(scene.tokens.empty_shell, centre, net->config.empty_tokens);
    in[kTarget].coords = targets;
    std::vector<float> parent_probability;
    for (const Coord& c : targets) {
      const auto found = scene.gate.find(tokenCoord(c, 1));
      parent_probability.push_back(found == scene.gate.end() ? 0.f : found->second);
    }
    in[kTarget].features = torch::tensor(parent_probability).unsqueeze(1);
    const CompleterNet::Fine f =
        net->fine(in, scene.windows[scene.windowOf(in[kTarget].coords[0])].frame);
    const Tensor p = f.logits.sigmoid().contiguous();
    const Tensor z =
        asFiled(net->diffusion->sample(f.targets, s.sampling_steps, s.temperature, random),
                s.generated_context);
    Place made = noTokens();
    made.ijk = targets;
    made.z.assign(z.data_ptr<float>(), z.data_ptr<float>() + z.numel());
    made.probability.assign(p.data_ptr<float>(), p.data_ptr<float>() + p.numel());
    made.bfs_level.assign(targets.size(), level);
    made.generated.assign(targets.size(), 1);
    return made;
  }

  // Visits candidates level by level; keeps those that `keep` accepts given their probability, the
  // others are added to `dropped`. Levels are distances from what was observed, whatever of them is
  // done already or may not be generated.
  template <typename Keep>
  void grow(Growth* g, Place* dropped, const Scene& scene, const std::vector<Coord>& candidates,
            const CompleteSettings& s, Keep keep, Progress& progress,
            const LevelListener& listener) const {
    const std::set<Coord> done(g->place.ijk.begin() + g->seeds(), g->place.ijk.end());
    std::vector<int32_t> levels = breadthFirstLevels(candidates, g->observed, s.neighbours);
    if (s.random_order) std::shuffle(levels.begin(), levels.end(), std::mt19937_64(s.seed));
    const int32_t last = levels.empty() ? 0 : *std::max_element(levels.begin(), levels.end());
    for (int32_t level = std::max(1, s.first_level); level <= last; ++level) {
      report(progress, int(100 * (level - 1) / last));
      // A generator a level: a run that goes on from a level draws what the whole one would have
      // drawn.
      torch::Generator random = at::detail::createCPUGenerator(s.seed * 1000003 + uint64_t(level));
      std::vector<Coord> frontier;
      for (size_t i = 0; i < candidates.size(); ++i)
        if (levels[i] == level && !done.count(candidates[i]) &&
            (!s.region || s.region->isValueOn(candidates[i])))
          frontier.push_back(candidates[i]);
      Place kept = noTokens();
      for (const std::vector<Coord>& part : byWindow(scene, frontier))
        for (const std::vector<Coord>& targets :
             chunksOf(part, s.chunk_tokens ? s.chunk_tokens : net->config.chunk_tokens)) {
          report(progress, -1);
          const Place made = predict(*g, scene, targets, level, s, random);
          const auto isKept = [&](size_t i) { return keep(made.probability[i]); };
          appendRows(dropped, keepRows(made, [&](size_t i) { return !isKept(i); }));
          appendRows(&kept, keepRows(made, isKept));
        }
      if (frontier.empty()) continue;
      // Only now: every chunk of a level saw the same context.
      g->append(kept, *net);
      if (!listener) continue;
      if (s.hole_tau < s.tau) {  // closing holes asks for what was dropped
        Growth all = *g;
        all.append(*dropped, *net);
        listener(all.place, level + 1);
      } else {
        listener(g->place, level + 1);
      }
    }
  }

  // Takes dropped tokens back where they close a hole.
  void closeHoles(Growth* g, const Scene& scene, const Place& dropped, float least) const {
    std::map<Coord, float> probability;
    std::map<Coord, int64_t> row;
    for (size_t i = 0; i < dropped.ijk.size(); ++i)
      probability[dropped.ijk[i]] = dropped.probability[i], row[dropped.ijk[i]] = int64_t(i);
    std::vector<int64_t> rows;
    for (const Coord& c : closingTokens(scene.tokens.nodes, g->place.ijk, probability, least))
      rows.push_back(row.at(c));
    g->append(selectRows(dropped, rows), *net);
  }

  // Condition latents rewritten from everything that was decoded (spec A8), chunk by chunk.
  void refine(Growth* g, const Scene& scene, const CompleteSettings& s) const {
    torch::Generator random = at::detail::createCPUGenerator(s.seed + 1);
    const int64_t seeds = g->seeds();
    const std::vector<Coord> generated(g->place.ijk.begin() + seeds, g->place.ijk.end());
    std::map<Coord, int64_t> row_of;
    for (int64_t i = 0; i < seeds; ++i) row_of[g->observed[size_t(i)]] = i;
    Tensor refined = g->z.slice(0, 0, seeds).clone();
    for (const std::vector<Coord>& part : byWindow(scene, g->observed))
      for (const std::vector<Coord>& tokens : chunksOf(part, net->config.chunk_tokens)) {
        const Eigen::Vector3d centre = centreOf(tokens);
        std::array<TokenSet, kTokenKinds> in;
        std::vector<int64_t> rows,
            near = nearestRows(generated, centre, net->config.context_tokens);
        for (const Coord& c : tokens) rows.push_back(row_of.at(c));
        for (int64_t& row : near) {
          in[kVisible].coords.push_back(generated[size_t(row)]);
          row += seeds;
        }
        in[kCondition] = {g->z.index_select(0, torch::tensor(rows)), tokens};
        in[kVisible].features = g->z.index_select(0, torch::tensor(near, torch::kInt64));
        in[kEmptyToken].coords =
            nearestOf(scene.tokens.empty_shell, centre, net->config.empty_tokens);
        in[kTarget].features = torch::zeros({0, 1});
        const CompleterNet::Fine f = net->fine(in, scene.windows[scene.windowOf(tokens[0])].frame);
        refined.index_copy_(0, torch::tensor(rows),
                            net->project(net->refinement->sample(f.conditions, s.sampling_steps,
                                                                 s.temperature, random)));
      }
    const Tensor z = net->restore(refined).to(torch::kHalf).to(torch::kFloat32).contiguous();
    std::copy_n(z.data_ptr<float>(), z.numel(), g->place.z.begin());
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

Place Completer::complete(const Place& start, const CompleteSettings& s, Progress& progress,
                          const LevelListener& listener) const {
  torch::NoGradGuard no_grad;
  progress.start("complete");
  Place dropped;
  Impl::Growth g = impl_->begin(start, s, &dropped);
  Impl::Scene scene = Impl::sceneOf(start);
  impl_->openGate(&scene);
  std::vector<Coord> open;
  for (const auto& [node, probability] : scene.gate)
    if (probability > s.coarse_tau) open.push_back(node);
  impl_->grow(
      &g, &dropped, scene, unobservedChildren(open, scene.tokens.nodes), s,
      [&](float probability) { return probability > s.tau; }, progress, listener);
  if (s.hole_tau < s.tau) impl_->closeHoles(&g, scene, dropped, s.hole_tau);
  if (s.refine_observed) impl_->refine(&g, scene, s);
  progress.end();
  return std::move(g.place);
}

Place Completer::completeAt(const Place& start, const std::vector<Coord>& occupied,
                            const CompleteSettings& s, Progress& progress) const {
  torch::NoGradGuard no_grad;
  progress.start("complete");
  Place dropped;
  Impl::Growth g = impl_->begin(start, s, &dropped);
  Impl::Scene scene = Impl::sceneOf(start);
  std::vector<Coord> candidates;
  for (const Coord& c : std::set<Coord>(occupied.begin(), occupied.end())) {
    if (scene.tokens.nodes.at(c) != NodeState::kUnobserved) continue;
    candidates.push_back(c);
    scene.gate[tokenCoord(c, 1)] = 1;
  }
  impl_->grow(
      &g, &dropped, scene, candidates, s, [](float) { return true; }, progress, nullptr);
  progress.end();
  return std::move(g.place);
}

}  // namespace vdbc
