#include "mar/growth.h"

#include <algorithm>
#include <random>

#include "mar/thinning.h"

namespace vdbc {
namespace {

// Random numbers of a chunk: known from its place in the work alone.
torch::Generator chunkGenerator(uint64_t seed, uint64_t level, uint64_t chunk) {
  std::seed_seq mixed{uint32_t(seed), uint32_t(seed >> 32), uint32_t(level), uint32_t(chunk)};
  std::array<uint32_t, 2> words;
  mixed.generate(words.begin(), words.end());
  return at::detail::createCPUGenerator(uint64_t(words[0]) << 32 | words[1]);
}

Tensor rowsOf(const Tensor& z, const std::vector<int64_t>& rows) {
  return z.index_select(0, torch::tensor(rows, torch::kInt64));
}

Tensor latentsOf(const Place& place) {
  return torch::tensor(place.z).view({place.size(), place.dim});
}

// Standardised predictions as a file will hold them: a run that goes on from one sees the same
// numbers.
std::vector<float> asFiled(CompleterNet& net, const Tensor& z) {
  const Tensor filed = net.restore(z).to(torch::kHalf).to(torch::kFloat32).contiguous();
  return {filed.data_ptr<float>(), filed.data_ptr<float>() + filed.numel()};
}

// Tokens of one window that are asked together.
struct Chunk {
  size_t window;
  std::vector<Coord> tokens;
};

std::vector<Chunk> chunksByWindow(const Windows& windows, const std::vector<Coord>& tokens,
                                  int64_t size) {
  std::vector<Chunk> chunks;
  for (const auto& [window, part] : windows.split(tokens))
    for (std::vector<Coord>& chunk : chunksOf(part, size))
      chunks.push_back({window, std::move(chunk)});
  return chunks;
}

Place predict(CompleterNet& net, const GrowthScene& scene, const Growth& g, const Chunk& chunk,
              int32_t level, const CompleteSettings& s, torch::Generator random) {
  const std::vector<Coord>& context = s.generated_context ? g.place.ijk : g.observed;
  FineChunk in = fineChunk(
      scene.tokens, scene.gate, context, g.seeds(), chunk.tokens, centreOf(chunk.tokens),
      s.context_tokens ? s.context_tokens : net.config.context_tokens, net.config.empty_tokens);
  for (size_t kind : {size_t(kCondition), size_t(kVisible)})
    in.tokens[kind].features = rowsOf(g.z, in.rows[kind]);
  const CompleterNet::Fine f = net.fine(in.tokens, scene.windows.window(chunk.window).frame);
  const Tensor logits = f.logits.contiguous();
  const Tensor z = net.diffusion->sample(f.targets, s.sampling_steps, s.temperature, random);
  Place made;
  made.dim = net.config.latent_dim;
  made.ijk = chunk.tokens;
  made.z = asFiled(net, s.generated_context ? net.project(z) : z);
  for (int64_t i = 0; i < logits.numel(); ++i)
    made.probability.push_back(calibrated(net.config.calibration, logits.data_ptr<float>()[i]));
  made.bfs_level.assign(chunk.tokens.size(), level);
  made.generated.assign(chunk.tokens.size(), 1);
  return made;
}

}  // namespace

void Growth::append(const Place& more, CompleterNet& net) {
  z = torch::cat({z, net.standardise(latentsOf(more))});
  appendRows(&place, more);
}

Growth beginGrowth(CompleterNet& net, const Place& start, const CompleteSettings& s,
                   Place* dropped) {
  const int d = net.config.latent_dim;
  require(start.level == 1 && start.dim == d, "Completer: the place: expected latents of ", d,
          " channels at level 1, found ", start.dim, " at level ", start.level);
  requireRows(start, "Completer: the place");
  const auto seeds = std::count(start.generated.begin(), start.generated.end(), uint8_t(0));
  require(seeds > 0, "Completer: the place is empty (expected observed tokens)");
  require(std::is_sorted(start.generated.begin(), start.generated.end()),
          "Completer: the place: expected observed tokens before generated ones");
  const int64_t given = s.begun_with < 0 ? start.size() : s.begun_with;
  require(given >= seeds && given <= start.size(), "Completer: the place: expected ", given,
          " rows that the completion began with, found ", start.size());
  const auto stays = [&](size_t i) { return int64_t(i) < given || start.probability[i] > s.tau; };
  *dropped = keepRows(start, [&](size_t i) { return !stays(i); });
  Growth g{keepRows(start, stays), {}, {start.ijk.begin(), start.ijk.begin() + seeds}, given};
  g.z = net.standardise(latentsOf(g.place));
  return g;
}

GrowthScene growthScene(const Place& start, const CompleterConfig& config) {
  SceneTokens tokens = sceneTokens(poolSeen(*start.seen, 1), poolSeen(*start.seen, 2));
  CoordBBox content;
  for (const Coord& c : tokens.coarse_filled) content.expand(voxelsIn(c, kTokenLevels - 1));
  return {std::move(tokens), Windows(start.frame, content, config), {}};
}

std::vector<Coord> openGate(CompleterNet& net, float coarse_tau, GrowthScene* scene,
                            Progress& progress) {
  constexpr int kCoarse = kTokenLevels - 1;
  struct Part {
    SceneTokens tokens;
    VoxelFrame frame;
  };
  std::vector<Part> parts;
  std::vector<Chunk> pending;  // of the numbers of parts
  for (size_t number : scene->windows.around(scene->tokens.coarse_filled, kCoarse)) {
    const Window w = scene->windows.window(number);
    Part part{sceneIn(scene->tokens, w.frame.bounds), w.frame};
    if (part.tokens.coarse_filled.empty()) continue;  // nothing to grow from
    std::vector<Coord> unknown;
    for (const Coord& c : unobservedNodes(part.tokens.coarse, nodesIn(w.core, kCoarse)))
      if (w.core.isInside(firstVoxel(c, kCoarse))) unknown.push_back(c);
    for (std::vector<Coord>& chunk : chunksOf(unknown, net.config.coarse_chunk_tokens))
      pending.push_back({parts.size(), std::move(chunk)});
    parts.push_back(std::move(part));
  }

  TokenMask open, beside;                                  // nodes, and their neighbours
  std::vector<Coord> found = scene->tokens.coarse_filled;  // neighbours not yet looked at
  for (const Coord& c : found) {
    scene->gate.set(c, 1);
    if (1 > coarse_tau) open.setValueOn(c);
  }
  const auto openNode = [&](const Coord& c) {
    const float* p = scene->gate.find(c);
    if (!p || !(*p > coarse_tau) || open.isValueOn(c)) return;
    open.setValueOn(c), found.push_back(c);
  };
  while (!found.empty()) {
    // What was asked with another node's chunk opens when growth gets to it.
    while (!found.empty()) {
      const std::vector<Coord> ring = neighbourRing(found);
      found.clear();
      for (const Coord& c : ring) beside.setValueOn(c), openNode(c);
    }
    const openvdb::tree::ValueAccessor<const TokenMask> is_beside(beside);
    const auto reached =
        std::stable_partition(pending.begin(), pending.end(), [&](const Chunk& chunk) {
          return std::none_of(chunk.tokens.begin(), chunk.tokens.end(),
                              [&](const Coord& c) { return is_beside.isValueOn(c); });
        });
    const std::vector<Chunk> chunks(std::make_move_iterator(reached),
                                    std::make_move_iterator(pending.end()));
    pending.erase(reached, pending.end());
    std::vector<std::vector<float>> probability(chunks.size());
    inTasks(int64_t(chunks.size()), [&](int64_t i) {
      report(progress, -1);
      const Chunk& chunk = chunks[size_t(i)];
      const Part& part = parts[chunk.window];
      probability[size_t(i)] = coarseProbability(net, part.tokens, chunk.tokens, part.frame);
    });
    for (size_t i = 0; i < chunks.size(); ++i)
      for (size_t k = 0; k < chunks[i].tokens.size(); ++k) {
        const Coord& c = chunks[i].tokens[k];
        scene->gate.set(c, probability[i][k]);
        if (beside.isValueOn(c)) openNode(c);
      }
  }
  std::vector<Coord> nodes = activeCoords(open);
  std::sort(nodes.begin(), nodes.end());
  return nodes;
}

void growLevels(CompleterNet& net, const GrowthScene& scene, const std::vector<Coord>& candidates,
                const CompleteSettings& s, const std::function<bool(float)>& keep,
                Progress& progress, const LevelListener& listener, Growth* g, Place* dropped) {
  const TokenMask done = maskFromCoords({g->place.ijk.begin() + g->seeds(), g->place.ijk.end()});
  std::vector<int32_t> levels = breadthFirstLevels(candidates, g->observed, s.neighbours);
  if (s.random_order) std::shuffle(levels.begin(), levels.end(), std::mt19937_64(s.seed));
  const int32_t last = levels.empty() ? 0 : *std::max_element(levels.begin(), levels.end());
  for (int32_t level = std::max(1, s.first_level); level <= last; ++level) {
    report(progress, int(100 * (level - 1) / last));
    std::vector<Coord> frontier;
    for (size_t i = 0; i < candidates.size(); ++i)
      if (levels[i] == level && !done.isValueOn(candidates[i]) &&
          (!s.region || s.region->isValueOn(candidates[i])))
        frontier.push_back(candidates[i]);
    if (frontier.empty()) continue;
    const std::vector<Chunk> chunks = chunksByWindow(
        scene.windows, frontier, s.chunk_tokens ? s.chunk_tokens : net.config.chunk_tokens);
    std::vector<Place> made(chunks.size());
    inTasks(int64_t(chunks.size()), [&](int64_t i) {
      report(progress, -1);
      made[size_t(i)] = predict(net, scene, *g, chunks[size_t(i)], level, s,
                                chunkGenerator(s.seed, uint64_t(level), uint64_t(i)));
    });
    // Only now: every chunk of a level saw the same context.
    Place asked = std::move(made[0]);
    for (size_t i = 1; i < made.size(); ++i) appendRows(&asked, made[i]);
    const auto kept = [&](size_t i) { return keep(asked.probability[i]); };
    appendRows(dropped, keepRows(asked, [&](size_t i) { return !kept(i); }));
    g->append(keepRows(asked, kept), net);
    if (!listener) continue;
    Place all = g->place;
    appendRows(&all, *dropped);
    listener(all, level + 1);
  }
}

void thinSurfaces(Growth* g, Place* dropped) {
  const int64_t seeds = g->seeds();
  Place generated = keepRows(g->place, [&](size_t i) { return int64_t(i) >= seeds; });
  appendRows(&generated, *dropped);
  const std::vector<uint8_t> thick = thickTokens(generated);
  std::vector<int64_t> rows, thin;
  for (int64_t i = 0; i < g->place.size(); ++i)
    (i < g->given || !thick[size_t(i - seeds)] ? rows : thin).push_back(i);
  appendRows(dropped, selectRows(g->place, thin));
  g->place = selectRows(g->place, rows);
  g->z = rowsOf(g->z, rows);
}

void refineObserved(CompleterNet& net, const GrowthScene& scene, const CompleteSettings& s,
                    Growth* g) {
  const int64_t seeds = g->seeds();
  const std::vector<Coord> generated(g->place.ijk.begin() + seeds, g->place.ijk.end());
  TokenMap<int64_t> row_of;
  for (int64_t i = 0; i < seeds; ++i) row_of.set(g->observed[size_t(i)], i);
  const std::vector<Chunk> chunks =
      chunksByWindow(scene.windows, g->observed, net.config.chunk_tokens);
  std::vector<std::vector<int64_t>> rows(chunks.size());
  std::vector<Tensor> refined(chunks.size());
  inTasks(int64_t(chunks.size()), [&](int64_t i) {
    const Chunk& chunk = chunks[size_t(i)];
    for (const Coord& c : chunk.tokens) rows[size_t(i)].push_back(*row_of.find(c));
    // What is around a chunk of observed tokens is what was generated, and no target.
    FineChunk in = fineChunk(scene.tokens, scene.gate, generated, 0, {}, centreOf(chunk.tokens),
                             net.config.context_tokens, net.config.empty_tokens);
    for (int64_t& row : in.rows[kVisible]) row += seeds;
    in.tokens[kCondition] = {rowsOf(g->z, rows[size_t(i)]), chunk.tokens};
    in.tokens[kVisible].features = rowsOf(g->z, in.rows[kVisible]);
    const CompleterNet::Fine f = net.fine(in.tokens, scene.windows.window(chunk.window).frame);
    torch::Generator random = chunkGenerator(s.seed + 1, 0, uint64_t(i));
    refined[size_t(i)] =
        net.project(net.refinement->sample(f.conditions, s.sampling_steps, s.temperature, random));
  });
  Tensor z = g->z.slice(0, 0, seeds).clone();
  for (size_t i = 0; i < chunks.size(); ++i) z.index_copy_(0, torch::tensor(rows[i]), refined[i]);
  const std::vector<float> filed = asFiled(net, z);
  std::copy(filed.begin(), filed.end(), g->place.z.begin());
}

}  // namespace vdbc
