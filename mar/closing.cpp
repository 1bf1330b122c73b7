#include "mar/closing.h"

#include <algorithm>
#include <boost/graph/adjacency_list.hpp>
#include <boost/graph/boykov_kolmogorov_max_flow.hpp>
#include <cmath>

namespace vdbc {
namespace {

using Traits = boost::adjacency_list_traits<boost::vecS, boost::vecS, boost::directedS>;
using Edge = Traits::edge_descriptor;
struct Pipe {
  double capacity = 0, residual = 0;
  Edge reverse;
};
struct Place {
  boost::default_color_type colour = boost::white_color;
  double distance = 0;
  Edge predecessor;
};
using Graph = boost::adjacency_list<boost::vecS, boost::vecS, boost::directedS, Place, Pipe>;

void connect(Graph& graph, size_t from, size_t to, double capacity) {
  const Edge there = boost::add_edge(from, to, graph).first,
             here = boost::add_edge(to, from, graph).first;
  graph[there].capacity = capacity, graph[there].reverse = here;
  graph[here].reverse = there;
}

}  // namespace

std::vector<Coord> closingTokens(const NodeStates& nodes, const std::vector<Coord>& occupied,
                                 const std::map<Coord, float>& dropped, float least) {
  constexpr double kUncertain = 1e-6;  // no token costs more than -log of it
  constexpr int32_t kSource = 0, kSink = 1, kSolid = -1, kUnlabelled = -2;
  const double never = -std::log(kUncertain) * double(dropped.size() + 1);
  const size_t n = nodes.states.size();
  std::vector<int32_t> vertex(
      n, kUnlabelled);  // in the graph; of a dropped token its way in, the way out is next
  for (size_t i = 0; i < n; ++i)
    if (nodes.states[i] != NodeState::kUnobserved)
      vertex[i] = nodes.states[i] == NodeState::kFilled ? kSolid : kSource;
  for (const Coord& c : occupied)
    if (nodes.box.isInside(c)) vertex[size_t(nodes.index(c))] = kSolid;
  int32_t vertices = 2;
  std::vector<std::pair<Coord, float>> pipes;
  for (const auto& token : dropped) {
    if (!nodes.box.isInside(token.first) || vertex[size_t(nodes.index(token.first))] != kUnlabelled)
      continue;
    vertex[size_t(nodes.index(token.first))] = vertices, vertices += 2;
    pipes.push_back(token);
  }
  const int32_t first_region = vertices;
  auto isBorder = [&](const Coord& c) {
    for (int axis = 0; axis < 3; ++axis)
      if (c[axis] == nodes.box.min()[axis] || c[axis] == nodes.box.max()[axis]) return true;
    return false;
  };
  auto forNeighbours = [&](const Coord& c, auto&& visit) {
    for (int axis = 0; axis < 3; ++axis)
      for (int side : {-1, 1}) {
        Coord next = c;
        next[axis] += side;
        if (nodes.box.isInside(next)) visit(next);
      }
  };
  // The rest is open for good: one vertex a connected region, the sink if it reaches the border.
  std::vector<Coord> region;
  for (auto node = nodes.box.begin(); node; ++node) {
    if (vertex[size_t(nodes.index(*node))] != kUnlabelled) continue;
    bool border = false;
    region.assign(1, *node);
    vertex[size_t(nodes.index(*node))] = vertices;
    for (size_t i = 0; i < region.size(); ++i) {
      border = border || isBorder(region[i]);
      forNeighbours(region[i], [&](const Coord& next) {
        int32_t& label = vertex[size_t(nodes.index(next))];
        if (label == kUnlabelled) label = vertices, region.push_back(next);
      });
    }
    if (border)
      for (const Coord& c : region) vertex[size_t(nodes.index(c))] = kSink;
    else
      ++vertices;
  }

  Graph graph(static_cast<size_t>(vertices));
  for (const auto& [c, probability] : pipes) {
    const int32_t in = vertex[size_t(nodes.index(c))], out = in + 1;
    connect(graph, size_t(in), size_t(out),
            -std::log(std::clamp(double(probability), kUncertain, 1.)));
    if (isBorder(c)) connect(graph, size_t(out), kSink, never);
    forNeighbours(c, [&](const Coord& next) {
      const int32_t other = vertex[size_t(nodes.index(next))];
      if (other == kSolid) return;
      const bool is_pipe = other > kSink && other < first_region;
      if (other != kSource) connect(graph, size_t(out), size_t(other), never);
      // Pipes see each other from both sides.
      if (!is_pipe && other != kSink) connect(graph, size_t(other), size_t(in), never);
    });
  }
  // Where seen empty space meets a region that is open for good, that region is open to it.
  for (auto node = nodes.box.begin(); node; ++node) {
    const int32_t own = vertex[size_t(nodes.index(*node))];
    if (own < first_region) continue;
    bool open = false;
    forNeighbours(*node, [&](const Coord& next) {
      open = open || vertex[size_t(nodes.index(next))] == kSource;
    });
    if (open) connect(graph, kSource, size_t(own), never);
  }
  boost::boykov_kolmogorov_max_flow(
      graph, boost::get(&Pipe::capacity, graph), boost::get(&Pipe::residual, graph),
      boost::get(&Pipe::reverse, graph), boost::get(&Place::predecessor, graph),
      boost::get(&Place::colour, graph), boost::get(&Place::distance, graph),
      boost::get(boost::vertex_index, graph), size_t(kSource), size_t(kSink));
  std::vector<Coord> closing;
  const auto source_colour = graph[kSource].colour;
  for (const auto& [c, probability] : pipes) {
    const size_t in = size_t(vertex[size_t(nodes.index(c))]);
    const bool cut = graph[in].colour == source_colour && graph[in + 1].colour != source_colour;
    if (cut && probability > least) closing.push_back(c);
  }
  return closing;
}

}  // namespace vdbc
