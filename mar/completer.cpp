#include "mar/completer.h"

#include <algorithm>

#include "encoder/inference.h"
#include "encoder/weights.h"
#include "mar/closing.h"
#include "mar/growth.h"

namespace vdbc {

struct Completer::Impl {
  std::shared_ptr<CompleterNet> net;
  std::string hash, trained_on;
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

namespace {

// Takes dropped tokens back where they close a hole.
void closeHoles(CompleterNet& net, const SeenSpace& nodes, const Place& dropped, float least,
                Growth* g) {
  g->append(selectRows(dropped, closingTokens(nodes, g->place.ijk, dropped, least)), net);
}

}  // namespace

Place Completer::complete(const Place& start, const CompleteSettings& s, Progress& progress,
                          const LevelListener& listener) const {
  const Inference inference;
  progress.start("complete");
  CompleterNet& net = *impl_->net;
  Place dropped;
  Growth g = beginGrowth(net, start, s, &dropped);
  GrowthScene scene = growthScene(start, net.config);
  const std::vector<Coord> open = openGate(net, s.coarse_tau, &scene, progress);
  growLevels(
      net, scene, unobservedChildren(open, scene.tokens.nodes), s,
      [&](float probability) { return probability > s.tau; }, progress, listener, &g, &dropped);
  thinSurfaces(&g, &dropped);
  if (s.hole_tau < 1) closeHoles(net, scene.tokens.nodes, dropped, s.hole_tau, &g);
  if (s.refine_observed) refineObserved(net, scene, s, &g);
  progress.end();
  return std::move(g.place);
}

Place Completer::completeAt(const Place& start, const std::vector<Coord>& occupied,
                            const CompleteSettings& s, Progress& progress) const {
  const Inference inference;
  progress.start("complete");
  CompleterNet& net = *impl_->net;
  Place dropped;
  Growth g = beginGrowth(net, start, s, &dropped);
  GrowthScene scene = growthScene(start, net.config);
  std::vector<Coord> candidates = occupied;
  std::sort(candidates.begin(), candidates.end());
  candidates.erase(std::unique(candidates.begin(), candidates.end()), candidates.end());
  const auto known = [&](const Coord& c) {
    return scene.tokens.nodes.at(c) != NodeState::kUnobserved;
  };
  candidates.erase(std::remove_if(candidates.begin(), candidates.end(), known), candidates.end());
  for (const Coord& c : candidates) scene.gate.set(tokenCoord(c, 1), 1);
  growLevels(
      net, scene, candidates, s, [](float) { return true; }, progress, nullptr, &g, &dropped);
  progress.end();
  return std::move(g.place);
}

}  // namespace vdbc
