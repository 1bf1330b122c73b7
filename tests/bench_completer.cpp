// What keeping H1's output between growth levels would save (docs/notes/performance.md). Generated
// tokens are no context, so what H1 says of a chunk's context could be kept, if the chunks of all
// levels had the same contexts: those of tree nodes. completer/h1 and completer/h2/TARGETS time one
// chunk of the shipped weights; completer/chunks/SIDE counts, for the bundled views, H1 and H2
// calls with contexts by chunk (SIDE 0: as it is) and by tree node of SIDE tokens.
#include <benchmark/benchmark.h>

#include <algorithm>
#include <map>
#include <set>

#include "encoder/inference.h"
#include "encoder/views/read_views.h"
#include "encoder/weights.h"
#include "houdini_style_tools/complete.h"
#include "mar/growth.h"
#include "vdb/threads.h"

namespace vdbc {
namespace {

const std::string kWeights = VDBC_SOURCE_DIR "/weights/indoor";

CompleterNet& network() {
  static const std::shared_ptr<CompleterNet> net = [] {
    const std::string path = kWeights + "/completer.safetensors";
    const TensorFile file = readTensors(path);
    auto loaded = std::make_shared<CompleterNet>(
        CompleterConfig::fromJson(file.metadata.at("completer"), path));
    loadModule(*loaded, "", file, path);
    return loaded;
  }();
  return *net;
}

void timeBlocks(benchmark::State& state, const std::vector<std::shared_ptr<SelfBlock>>& blocks,
                int64_t tokens) {
  const Inference inference;
  const CompleterConfig& c = network().config;
  const Tensor x = torch::randn({tokens, c.width});
  const Rotary positions = rotary(torch::randint(30, {tokens, 3}), c.width / c.heads, c.positions);
  withThreads(1, [&] {
    for (auto _ : state) {
      Tensor y = x;
      for (const auto& block : blocks) y = block->forward(y, &positions);
      benchmark::DoNotOptimize(y.data_ptr());
    }
  });
}

int64_t contextTokens() { return network().config.context_tokens + network().config.empty_tokens; }

void h1(benchmark::State& state) { timeBlocks(state, network().trunk->h1, contextTokens()); }
void h2(benchmark::State& state) {
  timeBlocks(state, network().trunk->h2, contextTokens() + state.range(0));
}

// Candidates of the bundled views and their growth levels.
struct Candidates {
  std::vector<Coord> candidates;
  std::vector<int32_t> levels;
};
const Candidates& bundledCandidates() {
  static const Candidates all = [] {
    const Inference inference;
    Progress silent;
    const Encoder encoder(kWeights + "/encoder.safetensors");
    const Place place =
        encodeScene(readViews(VDBC_SOURCE_DIR "/examples/two_views"), encoder, {}, silent);
    const float coarse_tau = CompleteSettings().coarse_tau;
    GrowthScene scene = growthScene(place, network().config);
    const std::vector<Coord> open = openGate(network(), coarse_tau, &scene, silent);
    Candidates c;
    c.candidates = unobservedChildren(open, scene.tokens.nodes);
    c.levels = breadthFirstLevels(c.candidates, place.ijk);
    return c;
  }();
  return all;
}

void chunks(benchmark::State& state) {
  const Candidates& g = bundledCandidates();
  const int side = int(state.range(0)), size = network().config.chunk_tokens;
  std::set<Coord> nodes;
  std::map<std::pair<int32_t, Coord>, int> targets;  // of a level in a node
  for (auto _ : state) {
    nodes.clear(), targets.clear();
    for (size_t i = 0; i < g.candidates.size(); ++i) {
      const Coord& c = g.candidates[i];
      const Coord node = side ? Coord(c.x() & -side, c.y() & -side, c.z() & -side) : Coord(0);
      nodes.insert(node), ++targets[{g.levels[i], node}];
    }
  }
  double calls = 0;
  for (const auto& entry : targets) calls += (entry.second + size - 1) / size;
  state.counters["candidates"] = double(g.candidates.size());
  state.counters["h1_calls"] = side ? double(nodes.size()) : calls;
  state.counters["h2_calls"] = calls;
  state.counters["targets_a_call"] = double(g.candidates.size()) / calls;
}

BENCHMARK(h1)->Name("completer/h1")->Unit(benchmark::kMillisecond);
BENCHMARK(h2)
    ->Name("completer/h2")
    ->Arg(20)
    ->Arg(40)
    ->Arg(80)
    ->Arg(160)
    ->Unit(benchmark::kMillisecond);
BENCHMARK(chunks)->Name("completer/chunks")->Arg(0)->Arg(8)->Arg(16)->Arg(32)->Iterations(1);

}  // namespace
}  // namespace vdbc
