#include "mar/closing.h"

#include <algorithm>
#include <boost/graph/adjacency_list.hpp>
#include <boost/graph/boykov_kolmogorov_max_flow.hpp>
#include <cmath>
#include <numeric>

#include "vdb/frontier.h"
#include "vdb/token_map.h"

namespace vdbc {
namespace {

constexpr size_t kLargestHole = 100;  // tokens: four square metres

using Traits = boost::adjacency_list_traits<boost::vecS, boost::vecS, boost::directedS>;
using Edge = Traits::edge_descriptor;
struct Pipe {
  double capacity = 0, residual = 0;
  Edge reverse;
};
struct Vertex {
  boost::default_color_type colour = boost::white_color;
  double distance = 0;
  Edge predecessor;
};
using Graph = boost::adjacency_list<boost::vecS, boost::vecS, boost::directedS, Vertex, Pipe>;

void connect(Graph& graph, size_t from, size_t to, double capacity) {
  const Edge there = boost::add_edge(from, to, graph).first,
             here = boost::add_edge(to, from, graph).first;
  graph[there].capacity = capacity, graph[there].reverse = here;
  graph[here].reverse = there;
}

// What a node is to the cut. Pipes are dropped tokens: their way in is a vertex, the way out is the
// next. Open nodes are those beside all others; they are vertices by region.
enum Kind : int32_t { kSource = 0, kSink = 1, kSolid = -1, kOpen = -2 };

template <typename Visit>
void forFaces(const CoordBBox& box, const Coord& c, const Visit& visit) {
  for (int axis = 0; axis < 3; ++axis)
    for (int side : {-1, 1}) {
      Coord next = c;
      next[axis] += side;
      if (box.isInside(next)) visit(next);
    }
}

bool isBorder(const CoordBBox& box, const Coord& c) {
  for (int axis = 0; axis < 3; ++axis)
    if (c[axis] == box.min()[axis] || c[axis] == box.max()[axis]) return true;
  return false;
}

// The open nodes around the others, and to which connected region of all open nodes each belongs.
// A region of open space is bounded by shells, each connected through faces: the outer one, and one
// around each thing that stands in it. The outer shell has no open node beyond its largest x;
// from any other a walk along x meets another shell of the region, or leaves the volume.
class OpenRegions {
 public:
  OpenRegions(const CoordBBox& box, const TokenMap<int32_t>& kinds) : box_(box) {
    for (const Coord& c : neighbourRing(kinds.tokens()))
      if (box.isInside(c)) shell_.insert(c, int32_t(shell_.size()));
    parent_.resize(shell_.size() + 1);  // the last one: the border
    std::iota(parent_.begin(), parent_.end(), 0);
    const std::vector<Coord>& nodes = shell_.tokens();
    for (size_t i = 0; i < nodes.size(); ++i) {
      if (isBorder(box, nodes[i])) join(i, shell_.size());
      forFaces(box, nodes[i], [&](const Coord& next) {
        if (const int32_t* other = shell_.find(next)) join(i, size_t(*other));
      });
    }
    // One walk for each shell, from a node of its largest x.
    std::vector<size_t> start(parent_.size(), shell_.size());
    for (size_t i = 0; i < nodes.size(); ++i) {
      size_t& best = start[root(i)];
      if (best == shell_.size() || nodes[i].x() > nodes[best].x()) best = i;
    }
    for (size_t i : start) {
      if (i == shell_.size()) continue;
      Coord c = nodes[i].offsetBy(1, 0, 0);
      while (box.isInside(c) && !shell_.find(c) && !kinds.find(c)) ++c.x();
      if (!box.isInside(c))
        join(i, shell_.size());
      else if (const int32_t* other = shell_.find(c))
        join(i, size_t(*other));
    }
  }

  const std::vector<Coord>& nodes() const { return shell_.tokens(); }
  /// The vertex of the region of an open node beside another: kSink, or `first` and up.
  int32_t vertexOf(const Coord& node, int32_t first) const {
    const size_t region = root(size_t(*shell_.find(node)));
    return region == root(shell_.size()) ? int32_t(kSink) : first + int32_t(region);
  }
  int32_t count() const { return int32_t(parent_.size()); }

 private:
  size_t root(size_t i) const {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }
  void join(size_t a, size_t b) { parent_[root(a)] = root(b); }

  CoordBBox box_;
  TokenMap<int32_t> shell_;
  mutable std::vector<size_t> parent_;
};

// Whoever took a view had room to stand in.
constexpr double kStandingRoom_m = .5;

// Whether the middle of a node lies within kStandingRoom_m of a camera.
class StandingRoom {
 public:
  explicit StandingRoom(const Place& place) : radius_(kStandingRoom_m / place.frame.voxel_m) {
    for (const Camera& camera : place.cameras)
      lenses_.push_back(place.frame.toIndex(camera.world_from_camera.translation()));
  }
  bool holds(const Coord& node) const {
    const Coord first = firstVoxel(node, 1);  // of 2^3
    const Eigen::Vector3d middle(first.x() + 1, first.y() + 1, first.z() + 1);
    return std::any_of(lenses_.begin(), lenses_.end(), [&](const Eigen::Vector3d& lens) {
      return (middle - lens).norm() <= radius_;
    });
  }

 private:
  double radius_;  // voxels
  std::vector<Eigen::Vector3d> lenses_;
};

// Those of `rows` that close small holes, in their order: parts of neighbours of at most
// kLargestHole tokens. A larger sheet is a guess at a whole wall, not the mending of one.
std::vector<int64_t> smallHoles(const Place& dropped, const std::vector<int64_t>& rows) {
  TokenMap<size_t> numbers;
  for (size_t i = 0; i < rows.size(); ++i) numbers.insert(dropped.ijk[size_t(rows[i])], i);
  std::vector<uint8_t> visited(rows.size(), 0), small(rows.size(), 0);
  for (size_t first = 0; first < rows.size(); ++first) {
    if (visited[first]) continue;
    std::vector<size_t> part{first};
    visited[first] = 1;
    for (size_t k = 0; k < part.size(); ++k)
      for (const Coord& next : neighbourRing({dropped.ijk[size_t(rows[part[k]])]}))
        if (const size_t* i = numbers.find(next); i && !visited[*i]) {
          visited[*i] = 1;
          part.push_back(*i);
        }
    for (size_t i : part) small[i] = part.size() <= kLargestHole;
  }
  std::vector<int64_t> result;
  for (size_t i = 0; i < rows.size(); ++i)
    if (small[i]) result.push_back(rows[i]);
  return result;
}

}  // namespace

std::vector<int64_t> closingTokens(const SeenSpace& nodes, const std::vector<Coord>& occupied,
                                   const Place& dropped, float least) {
  constexpr double kUncertain = 1e-6;  // no token costs more than -log of it
  const double never = -std::log(kUncertain) * double(dropped.size() + 1);
  const CoordBBox& box = nodes.box;
  TokenMap<int32_t> kinds;
  for (const Coord& c : filledNodes(nodes)) kinds.set(c, kSolid);
  for (const Coord& c : emptyNodes(nodes)) kinds.set(c, kSource);
  for (const Coord& c : occupied)
    if (box.isInside(c)) kinds.set(c, kSolid);
  std::vector<int64_t> pipes(size_t(dropped.size()));  // rows, by coordinates
  std::iota(pipes.begin(), pipes.end(), 0);
  std::sort(pipes.begin(), pipes.end(),
            [&](int64_t a, int64_t b) { return dropped.ijk[size_t(a)] < dropped.ijk[size_t(b)]; });
  int32_t vertices = 2;
  const StandingRoom room(dropped);
  pipes.erase(std::remove_if(pipes.begin(), pipes.end(),
                             [&](int64_t row) {
                               const Coord& c = dropped.ijk[size_t(row)];
                               if (!box.isInside(c) || room.holds(c)) return true;
                               if (!kinds.insert(c, vertices)) return true;
                               vertices += 2;
                               return false;
                             }),
              pipes.end());
  const int32_t first_region = vertices;
  const OpenRegions open(box, kinds);
  const auto vertexOf = [&](const Coord& c) {
    const int32_t* kind = kinds.find(c);
    return kind ? *kind : open.vertexOf(c, first_region);
  };

  Graph graph(static_cast<size_t>(first_region + open.count()));
  for (int64_t row : pipes) {
    const Coord& c = dropped.ijk[size_t(row)];
    const int32_t in = *kinds.find(c), out = in + 1;
    connect(graph, size_t(in), size_t(out),
            -std::log(std::clamp(double(dropped.probability[size_t(row)]), kUncertain, 1.)));
    if (isBorder(box, c)) connect(graph, size_t(out), kSink, never);
    forFaces(box, c, [&](const Coord& next) {
      const int32_t other = vertexOf(next);
      if (other == kSolid) return;
      const bool is_pipe = other > kSink && other < first_region;
      if (other != kSource) connect(graph, size_t(out), size_t(other), never);
      // Pipes see each other from both sides.
      if (!is_pipe && other != kSink) connect(graph, size_t(other), size_t(in), never);
    });
  }
  // Where seen empty space meets a region that is open for good, that region is open to it.
  for (const Coord& c : open.nodes()) {
    const int32_t own = open.vertexOf(c, first_region);
    bool meets = false;
    forFaces(box, c, [&](const Coord& next) {
      const int32_t* kind = kinds.find(next);
      meets = meets || (kind && *kind == kSource);
    });
    if (meets && own != kSink) connect(graph, kSource, size_t(own), never);
  }
  boost::boykov_kolmogorov_max_flow(
      graph, boost::get(&Pipe::capacity, graph), boost::get(&Pipe::residual, graph),
      boost::get(&Pipe::reverse, graph), boost::get(&Vertex::predecessor, graph),
      boost::get(&Vertex::colour, graph), boost::get(&Vertex::distance, graph),
      boost::get(boost::vertex_index, graph), size_t(kSource), size_t(kSink));
  std::vector<int64_t> closing;
  const auto source_colour = graph[kSource].colour;
  for (int64_t row : pipes) {
    const size_t in = size_t(*kinds.find(dropped.ijk[size_t(row)]));
    const bool cut = graph[in].colour == source_colour && graph[in + 1].colour != source_colour;
    if (cut && dropped.probability[size_t(row)] > least) closing.push_back(row);
  }
  return smallHoles(dropped, closing);
}

}  // namespace vdbc
