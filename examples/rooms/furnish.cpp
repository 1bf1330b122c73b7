#include "examples/rooms/furnish.h"

#include <algorithm>
#include <cmath>
#include <unordered_set>

#include "vdb/error.h"

namespace vdbc {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;

namespace {

constexpr size_t kMostTriangles = 60000;          // of a model
constexpr float kWalker = .25f, kWalkCell = .1f;  // metres: radius of someone who walks, grid
constexpr float kHeadroom = 1.8f;                 // what hangs higher is in nobody's way

float luminance(const Vector3f& c) { return Vector3f(.2126f, .7152f, .0722f).dot(c); }

/// Cells of `cell_m` that a surface passes through: sampled a third of a cell apart.
class Occupied {
 public:
  Occupied(const SurfaceMesh& surface, const Eigen::Affine3f& to_room, float cell_m)
      : per_metre_(1 / cell_m) {
    for (const Eigen::Vector3i& t : surface.mesh.triangles) {
      const Vector3f a = to_room * surface.mesh.vertices[size_t(t[0])];
      const Vector3f u = to_room * surface.mesh.vertices[size_t(t[1])] - a;
      const Vector3f v = to_room * surface.mesh.vertices[size_t(t[2])] - a;
      const float longest = std::max({u.norm(), v.norm(), (u - v).norm()});
      const int n = std::max(1, int(std::ceil(longest * 3 * per_metre_)));
      for (int i = 0; i <= n; ++i)
        for (int j = 0; i + j <= n; ++j)
          cells_.insert(key(a + (u * float(i) + v * float(j)) / float(n)));
    }
  }
  /// Whether this, moved by `offset`, comes within a cell of the other.
  bool touches(const Occupied& other, const Vector3f& offset) const {
    const Eigen::Vector3i move = (offset * per_metre_).array().round().cast<int>();
    for (uint64_t k : cells_) {
      const Eigen::Vector3i c = unpack(k) + move;
      for (int x = -1; x <= 1; ++x)
        for (int y = -1; y <= 1; ++y)
          for (int z = -1; z <= 1; ++z)
            if (other.cells_.count(pack(c + Eigen::Vector3i(x, y, z)))) return true;
    }
    return false;
  }

 private:
  static constexpr int kHalf = 1 << 20;
  static uint64_t pack(const Eigen::Vector3i& c) {
    return uint64_t(c.x() + kHalf) << 42 | uint64_t(c.y() + kHalf) << 21 | uint64_t(c.z() + kHalf);
  }
  static Eigen::Vector3i unpack(uint64_t k) {
    constexpr int kMask = (1 << 21) - 1;
    return {int(k >> 42 & kMask) - kHalf, int(k >> 21 & kMask) - kHalf, int(k & kMask) - kHalf};
  }
  uint64_t key(const Vector3f& p) const {
    return pack((p * per_metre_).array().floor().cast<int>());
  }
  float per_metre_;
  std::unordered_set<uint64_t> cells_;
};

Eigen::AlignedBox3f boundsOf(const SurfaceMesh& surface, const Eigen::Affine3f& to) {
  Eigen::AlignedBox3f box;
  for (const Vector3f& v : surface.mesh.vertices) box.extend(to * v);
  return box;
}

Eigen::Affine3f transformOf(const Item& item, const Place& at, float z) {
  return at.affine(z) * Eigen::Scaling(item.scale);
}

}  // namespace

Item Item::resized(const Vector3f& to) const {
  Item other = *this;
  const Vector3f factor = to.cwiseQuotient(size);
  other.scale = scale.cwiseProduct(factor);
  other.size = to;
  other.top_m *= factor.z(), other.elevation_m *= factor.z();
  return other;
}

Furnisher::Furnisher(const AssetLibrary& assets, Dice& dice, bool held_out, Shell shell, Room* room)
    : assets_(assets), dice_(dice), held_out_(held_out), shell_(std::move(shell)), room_(*room) {
  for (size_t i = 0, j = shell_.outline.size() - 1; i < shell_.outline.size(); j = i++)
    area_ += .5f * (shell_.outline[j].x() * shell_.outline[i].y() -
                    shell_.outline[i].x() * shell_.outline[j].y());
  if (room_.kind == "bathroom" || room_.kind == "kitchen" || area_ < 12) least_walkable_ = .36f;
  for (const Wall& w : shell_.walls)
    for (const Opening& o : w.openings)
      if (o.is_window)
        windows_.push_back(
            {w.place((o.lo + o.hi) / 2, .12f), {(o.hi - o.lo) / 2, .14f}, o.bottom + .02f, o.top});
  for (const Block& b : shell_.fixtures) room_.solids.push_back(b.bounds());
  static const Vector3f kBooks[] = {{.60f, .20f, .18f}, {.18f, .28f, .45f}, {.85f, .80f, .70f},
                                    {.22f, .38f, .28f}, {.75f, .55f, .20f}, {.28f, .24f, .28f},
                                    {.70f, .70f, .72f}, {.50f, .32f, .20f}};
  Shaper shape(&room_.surface);
  for (const Vector3f& c : kBooks)
    book_colours_.push_back(shape.plain(paint(dice_, c, .12f), .03f));
}

// --- choice
// -----------------------------------------------------------------------------------------

std::optional<Item> Furnisher::choose(const std::vector<std::string>& roles, const Vector3f& most) {
  std::vector<size_t> models;
  for (const std::string& role : roles)
    for (size_t m : assets_.withRole(role, held_out_))
      if ((assets_.models()[m].size_m.array() * .95f <= most.array()).all()) models.push_back(m);
  while (!models.empty()) {
    const size_t pick = size_t(dice_.integer(0, int(models.size()) - 1));
    const ModelInfo& info = assets_.models()[models[pick]];
    Item item;
    item.mesh = assets_.mesh(models[pick]);
    if (item.mesh->mesh.triangles.size() > kMostTriangles) {
      models.erase(models.begin() + long(pick));
      continue;
    }
    item.model = info.id, item.role = info.role, item.lights = info.lights;
    item.size = info.size_m, item.top_m = info.top_m, item.elevation_m = info.elevation_m;
    const Vector3f stretch{dice_.real(.92f, 1.08f), dice_.real(.92f, 1.08f),
                           dice_.real(.95f, 1.05f)};
    item = item.resized(item.size.cwiseProduct(stretch).cwiseMin(most));
    const bool has_writing = item.role == "wall_thing" || item.role == "piano" ||
                             item.role == "computer" || item.role == "desk_thing";
    if (!has_writing && dice_.chance(.5f)) item.scale.x() *= -1;
    const float tone = dice_.real(.75f, 1.1f);
    item.tint = {tone * dice_.real(.9f, 1.1f), tone, tone * dice_.real(.88f, 1.1f)};
    return item;
  }
  return std::nullopt;
}

Item Furnisher::make(const std::string& role, const std::function<void(Shaper&)>& draw) {
  auto surface = std::make_shared<SurfaceMesh>();
  Shaper shape(surface.get());
  draw(shape);
  const Eigen::AlignedBox3f box = boundsOf(*surface, Eigen::Affine3f::Identity());
  Item item;
  item.role = role, item.size = box.sizes(), item.top_m = box.max().z();
  const Vector3f foot(box.center().x(), box.center().y(), box.min().z());
  for (Vector3f& v : surface->mesh.vertices) v -= foot;
  item.mesh = surface;
  return item;
}

// --- fitting
// ----------------------------------------------------------------------------------------

bool Furnisher::inside(const Block& block) const {
  for (const Vector2f& p : block.corners())
    if (!shell_.contains(p) || shell_.ceilingAt(p) < block.top + .001f) return false;
  // No corner of the room (the inner one of an L) in the block.
  return std::none_of(shell_.outline.begin(), shell_.outline.end(),
                      [&](const Vector2f& p) { return block.distance(p) == 0; });
}

bool Furnisher::fits(const Block& block, int support) const {
  constexpr float kSlack = .002f;
  if (!inside(block)) return false;
  const auto hits = [&](const std::vector<Block>& others) {
    return std::any_of(others.begin(), others.end(),
                       [&](const Block& o) { return overlap(block, o, kSlack); });
  };
  if (hits(shell_.fixtures) || hits(shell_.keep_clear) || hits(windows_)) return false;
  if (support < 0 && hits(zones_)) return false;
  for (size_t i = 0; i < standing_.size(); ++i)
    if (int(i) != support && !standing_[i].is_flat && overlap(block, standing_[i].block, kSlack))
      return false;
  return true;
}

bool Furnisher::has(const std::string& model) const {
  return std::any_of(standing_.begin(), standing_.end(),
                     [&](const Standing& s) { return s.item.model == model; });
}

float Furnisher::walkableShare(const std::vector<Block>& more) const {
  Eigen::AlignedBox2f box;
  for (const Vector2f& p : shell_.outline) box.extend(p);
  const int nx = int(box.sizes().x() / kWalkCell), ny = int(box.sizes().y() / kWalkCell);
  std::vector<uint8_t> state(size_t(nx * ny), 0);  // 1: free, 2: reached
  std::vector<Block> blocks = more;
  blocks.insert(blocks.end(), shell_.fixtures.begin(), shell_.fixtures.end());
  for (const Standing& s : standing_)
    if (!s.is_flat) blocks.push_back(s.block);
  // What hangs high, lies flat or is as thin as a picture on a wall is in nobody's way.
  blocks.erase(std::remove_if(blocks.begin(), blocks.end(),
                              [](const Block& b) {
                                return b.bottom > kHeadroom || b.top < .05f ||
                                       (b.bottom > .5f && b.half.minCoeff() < .04f);
                              }),
               blocks.end());
  int floor = 0;
  const auto centre = [&](int i, int j) {
    return Vector2f(box.min() + kWalkCell * Vector2f(float(i) + .5f, float(j) + .5f));
  };
  for (int j = 0; j < ny; ++j)
    for (int i = 0; i < nx; ++i) {
      const Vector2f p = centre(i, j);
      if (!shell_.contains(p)) continue;
      ++floor;
      bool free = shell_.ceilingAt(p) > kHeadroom;
      for (size_t k = 0; free && k < shell_.walls.size(); ++k) {
        const Wall& w = shell_.walls[k];
        const Vector2f q = w.place(0).local(p);
        const float beyond = q.x() - std::clamp(q.x(), 0.f, w.length);
        free = Vector2f(beyond, q.y()).norm() >= kWalker;
      }
      for (size_t k = 0; free && k < blocks.size(); ++k) free = blocks[k].distance(p) >= kWalker;
      state[size_t(j * nx + i)] = free;
    }
  std::vector<int> stack;
  const auto visit = [&](int i, int j) {
    if (i < 0 || j < 0 || i >= nx || j >= ny || state[size_t(j * nx + i)] != 1) return;
    state[size_t(j * nx + i)] = 2;
    stack.push_back(j * nx + i);
  };
  const Block& door = shell_.keep_clear.front();
  for (int j = 0; j < ny; ++j)
    for (int i = 0; i < nx; ++i)
      if (door.distance(centre(i, j)) == 0) visit(i, j);
  while (!stack.empty()) {
    const int c = stack.back();
    stack.pop_back();
    visit(c % nx - 1, c / nx), visit(c % nx + 1, c / nx);
    visit(c % nx, c / nx - 1), visit(c % nx, c / nx + 1);
  }
  // What the walker passes over, not only where the walker's middle can be.
  int walked = 0;
  const int r = int(kWalker / kWalkCell);
  for (int j = 0; j < ny; ++j)
    for (int i = 0; i < nx; ++i) {
      bool near = false;
      for (int dj = std::max(-r, -j); !near && dj <= std::min(r, ny - 1 - j); ++dj)
        for (int di = std::max(-r, -i); !near && di <= std::min(r, nx - 1 - i); ++di)
          near = di * di + dj * dj <= r * r && state[size_t((j + dj) * nx + i + di)] == 2;
      walked += near;
    }
  return float(walked) / float(std::max(floor, 1));
}

// --- putting
// ----------------------------------------------------------------------------------------

int Furnisher::put(const Put& put) {
  const Item& item = put.item;
  const Eigen::Affine3f to_room = transformOf(item, put.at, put.z);
  const size_t first = room_.surface.materials.size();
  const size_t first_triangle = room_.surface.mesh.triangles.size();
  room_.surface.append(*item.mesh, to_room);
  for (size_t i = first; i < room_.surface.materials.size(); ++i) {
    Material& m = room_.surface.materials[i];
    m.emission = 0;  // until it is lit
    m.colour_a = m.colour_a.cwiseProduct(item.tint).cwiseMin(m.texture ? 1.1f : .85f);
  }
  Piece piece;
  piece.model = item.model;
  piece.room_from_model = to_room;
  piece.box = boundsOf(*item.mesh, to_room);
  room_.pieces.push_back(piece);
  const bool is_flat = item.role == "rug";
  if (!is_flat) room_.solids.push_back(piece.box);
  standing_.push_back({item, item.block(put.at, put.z), is_flat, first_triangle});
  return int(standing_.size()) - 1;
}

std::vector<int> Furnisher::tryGroup(const std::vector<Put>& puts, float front) {
  std::vector<Block> blocks;
  std::vector<bool> taken(puts.size());
  for (size_t i = 0; i < puts.size(); ++i) {
    const Block block = puts[i].item.block(puts[i].at, puts[i].z);
    bool fit = fits(block);
    if (puts[i].is_optional)
      for (const Block& b : blocks) fit = fit && !overlap(block, b, .002f);
    if (!fit && !puts[i].is_optional) return {};
    taken[i] = fit;
    if (fit) blocks.push_back(block);
  }
  std::optional<Block> zone;
  if (front > 0) {
    const Block& b = blocks.front();
    zone =
        Block{b.at.at(0, b.half.y() + front / 2), {b.half.x() * .9f, front / 2 - .01f}, .05f, 1.6f};
    for (const Standing& s : standing_)
      if (!s.is_flat && overlap(*zone, s.block)) return {};
    if (!shell_.contains(zone->at.origin)) return {};
  }
  if (walkableShare(blocks) < least_walkable_) return {};
  std::vector<int> pieces;
  for (size_t i = 0; i < puts.size(); ++i) pieces.push_back(taken[i] ? put(puts[i]) : -1);
  if (zone) zones_.push_back(*zone);
  return pieces;
}

std::vector<int> Furnisher::groupAtWall(
    float width, const WallRules& rules,
    const std::function<std::vector<Put>(const Place&)>& layout) {
  for (int tries = 0; tries < rules.tries; ++tries) {
    const Wall& wall = shell_.walls[size_t(dice_.integer(0, int(shell_.walls.size()) - 1))];
    const float lo = width / 2 + .02f, hi = wall.length - lo;
    if (hi < lo) continue;
    float s = dice_.real(lo, hi);
    if (dice_.chance(rules.corner_share)) s = dice_.chance(.5f) ? lo : hi;
    const std::vector<int> pieces = tryGroup(layout(wall.place(s, rules.gap)), rules.front);
    if (!pieces.empty()) return pieces;
  }
  return {};
}

std::vector<int> Furnisher::groupInRoom(const std::function<std::vector<Put>(const Place&)>& layout,
                                        int tries) {
  Eigen::AlignedBox2f box;
  for (const Vector2f& p : shell_.outline) box.extend(p);
  for (int i = 0; i < tries; ++i) {
    const Vector2f at{dice_.real(box.min().x(), box.max().x()),
                      dice_.real(box.min().y(), box.max().y())};
    const Wall& wall = shell_.walls[size_t(dice_.integer(0, 3))];
    const std::vector<int> pieces = tryGroup(layout(Place::facing(at, wall.inward())));
    if (!pieces.empty()) return pieces;
  }
  return {};
}

int Furnisher::atWall(const Item& item, const WallRules& rules) {
  const std::vector<int> pieces = groupAtWall(item.size.x(), rules, [&](const Place& at) {
    return std::vector<Put>{{item, at.at(0, item.size.y() / 2), item.elevation_m}};
  });
  return pieces.empty() ? -1 : pieces.front();
}

int Furnisher::inRoom(const Item& item, float yaw_jitter) {
  const std::vector<int> pieces = groupInRoom([&](const Place& at) {
    return std::vector<Put>{{item, at.turned(dice_.real(-yaw_jitter, yaw_jitter))}};
  });
  return pieces.empty() ? -1 : pieces.front();
}

int Furnisher::onWall(const Item& item, float foot) {
  WallRules rules;
  rules.front = 0, rules.corner_share = 0, rules.gap = .003f, rules.tries = 30;
  Item hung = item;
  hung.elevation_m = foot;
  return atWall(hung, rules);
}

int Furnisher::onWallAbove(const Item& item, int piece, float foot) {
  const Block& b = blockOf(piece);
  for (const Wall& wall : shell_.walls) {
    const Vector2f p = wall.place(0).local(b.at.origin);
    if (wall.inward().dot(b.at.front()) < .99f || std::abs(p.y() - b.half.y()) > .12f) continue;
    if (p.x() < 0 || p.x() > wall.length) continue;
    const Put hung{item, wall.place(p.x(), item.size.y() / 2 + .003f),
                   std::max(foot, b.top + .05f)};
    const std::vector<int> pieces = tryGroup({hung});
    return pieces.empty() ? -1 : pieces.front();
  }
  return -1;  // it stands free
}

TriangleMesh Furnisher::meshOf(int piece) const {
  const Eigen::Affine3f& to_room = room_.pieces[size_t(piece)].room_from_model;
  TriangleMesh mesh = itemOf(piece).mesh->mesh;  // with what is of glass: it carries things too
  for (Vector3f& v : mesh.vertices) v = to_room * v;
  return mesh;
}

std::vector<int> Furnisher::chairsAt(int table, const Item& chair, const std::vector<Place>& places,
                                     float jitter) {
  constexpr float kCell = .025f;
  const Occupied top(*itemOf(table).mesh, room_.pieces[size_t(table)].room_from_model, kCell);
  std::vector<int> pieces;
  for (const Place& edge : places) {
    const float yaw = dice_.real(-jitter, jitter), side = dice_.real(-.03f, .03f);
    const float wished = dice_.real(.05f, .6f) * chair.size.y();
    const Place pushed = edge.at(side, wished - chair.size.y() / 2).turned(yaw);
    const Occupied seat(*chair.mesh, transformOf(chair, pushed, 0), kCell);
    int piece = -1;
    for (float back = 0; piece < 0 && back < wished + .16f; back += .05f) {
      const Vector2f move = -back * edge.front();
      const Place at = {pushed.origin + move, pushed.c, pushed.s};
      const Block block = chair.block(at, 0);
      if (!fits(block, table)) continue;
      if (overlap(block, blockOf(table)) && seat.touches(top, {move.x(), move.y(), 0})) continue;
      if (walkableShare({block}) < least_walkable_ - .01f) break;
      piece = put({chair, at});
    }
    pieces.push_back(piece);
  }
  return pieces;
}

namespace {

struct Ground {
  float lowest, highest;  // -infinity where there is nothing
  bool isLevel() const { return highest - lowest < .006f; }
};

/// What rays from above find under a block.
Ground groundUnder(const RayTarget& target, const Block& block) {
  constexpr float kStep = .01f;  // thin rails are found too
  const int nx = std::max(3, int(2 * block.half.x() / kStep) + 1);
  const int ny = std::max(3, int(2 * block.half.y() / kStep) + 1);
  std::vector<Vector3f> origins, directions;
  constexpr float kSky = 10;
  for (int i = 0; i < nx; ++i)
    for (int j = 0; j < ny; ++j) {
      const Vector2f p = block.at.point(block.half.x() * (2 * float(i) / float(nx - 1) - 1),
                                        block.half.y() * (2 * float(j) / float(ny - 1) - 1));
      origins.emplace_back(p.x(), p.y(), kSky);
      directions.emplace_back(0, 0, -1);
    }
  const std::vector<float> d = target.trace(origins, directions);
  const auto [nearest, farthest] = std::minmax_element(d.begin(), d.end());
  return {kSky - *farthest, kSky - *nearest};
}

}  // namespace

std::vector<int> Furnisher::things(int piece, const ThingRules& rules) {
  std::vector<int> pieces;
  if (piece < 0 || rules.count <= 0) return pieces;
  const RayTarget target = RayTarget::fromMesh(meshOf(piece));
  const Block support = blockOf(piece);
  for (int i = 0; i < rules.count; ++i) {
    const std::optional<Item> item =
        choose(rules.roles, {rules.largest.x() * 1.05f, rules.largest.y() * 1.05f, rules.tallest});
    if (!item) break;
    for (int tries = 0; tries < 12; ++tries) {
      const float x = dice_.real(-support.half.x(), support.half.x());
      const float y = dice_.real(rules.back_share, rules.front_share) * support.half.y();
      const Place at = support.at.at(x, y).turned(dice_.real(-rules.yaw_jitter, rules.yaw_jitter));
      Block block = item->block(at, 0);
      const Ground ground = groundUnder(target, block);
      if (!ground.isLevel() || ground.highest < .2f) continue;
      const float z = ground.highest + .001f;
      block = item->block(at, z);
      if (!fits(block, piece)) continue;
      pieces.push_back(put({*item, at, z}));
      break;
    }
  }
  return pieces;
}

int Furnisher::thingAt(int piece, const Item& item, const Place& at, float foot) {
  const RayTarget target = RayTarget::fromMesh(meshOf(piece));
  Block base = item.block(at, 0);
  const float highest = groundUnder(target, base).highest;
  base.half *= foot;
  const Ground ground = groundUnder(target, base);
  const float z = ground.highest + .001f;
  const bool is_top = z > blockOf(piece).top - .02f && highest < z;
  if (!ground.isLevel() || !is_top || !fits(item.block(at, z), piece)) return -1;
  return put({item, at, z});
}

// Boards are found by rays: straight down through the middle of the shelf's depth, hit after hit; a
// compartment is the air between two hits into which a ray from the front gets.
void Furnisher::fillShelf(int piece, float share) {
  if (piece < 0) return;
  constexpr float kStep = .02f, kLeast = .17f;
  const Block b = blockOf(piece);
  const RayTarget target = RayTarget::fromMesh(meshOf(piece));
  struct Gap {
    float bottom, top;
  };
  struct Run {
    float from, to, bottom, top;
  };
  std::vector<Run> open, done;
  for (float x = -b.half.x() + kStep; x < b.half.x(); x += kStep) {
    const Vector2f p = b.at.at(x, 0).origin, f = b.at.at(x, b.half.y() + .05f).origin;
    std::vector<Gap> gaps;
    float z = b.top + .05f, above = INFINITY;
    for (int hits = 0; hits < 40 && z > .02f; ++hits) {
      const float d = target.trace({{p.x(), p.y(), z}}, {-Vector3f::UnitZ()})[0];
      if (!std::isfinite(d)) break;
      const float floor = z - d;
      if (std::isfinite(above) && above - floor > kLeast) {
        const Vector3f inward(-b.at.front().x(), -b.at.front().y(), 0);
        const std::vector<float> in = target.trace(
            {{f.x(), f.y(), floor + .05f}, {f.x(), f.y(), (floor + above) / 2}}, {inward, inward});
        if (std::min(in[0], in[1]) > b.half.y() + .1f) gaps.push_back({floor, above});
      }
      z = floor - .002f, above = floor;
    }
    for (Run& r : open) {
      const auto same = std::find_if(gaps.begin(), gaps.end(), [&](const Gap& g) {
        return std::abs(g.bottom - r.bottom) < .01f && std::abs(g.top - r.top) < .02f;
      });
      if (same == gaps.end()) {
        done.push_back(r), r.to = -INFINITY;
        continue;
      }
      r.to = x, r.top = std::min(r.top, same->top), r.bottom = std::max(r.bottom, same->bottom);
      gaps.erase(same);
    }
    open.erase(
        std::remove_if(open.begin(), open.end(), [](const Run& r) { return std::isinf(r.to); }),
        open.end());
    for (const Gap& g : gaps) open.push_back({x, x, g.bottom, g.top});
  }
  done.insert(done.end(), open.begin(), open.end());
  Shaper shape(&room_.surface);
  for (const Run& r : done) {
    const float width = r.to - r.from;
    if (width < .12f || !dice_.chance(share)) continue;
    const float height = std::min(r.top - r.bottom - .03f, dice_.real(.2f, .32f));
    float edge = b.half.y();  // of the board: not always the front of the whole piece
    const auto isOnBoard = [&](float y) {
      for (float x : {r.from + .01f, (r.from + r.to) / 2, r.to - .01f}) {
        const Vector2f p = b.at.point(x, y);
        if (target.trace({{p.x(), p.y(), r.bottom + .05f}}, {-Vector3f::UnitZ()})[0] > .07f)
          return false;
      }
      return true;
    };
    while (edge > 0 && !isOnBoard(edge)) edge -= .02f;
    const float depth = std::min(2 * edge, .2f), y1 = edge - dice_.real(.0f, .03f);
    if (depth < .12f) continue;
    const float last = r.from + width * dice_.real(.4f, 1.f);
    // Leave it empty where something stands in it already (a filled bookcase).
    const auto clear = [&](float x) {
      const Vector2f f = b.at.at(x, b.half.y() + .05f).origin;
      const Vector3f inward(-b.at.front().x(), -b.at.front().y(), 0);
      return target.trace({{f.x(), f.y(), r.bottom + .04f}}, {inward})[0] > depth + .06f;
    };
    float x = r.from + .005f;
    while (x < last - .05f) {
      const float thick = dice_.real(.018f, .05f), tall = height * dice_.real(.75f, 1.f);
      const float deep = depth * dice_.real(.75f, .95f);
      const Finish& cover = dice_.pick(book_colours_);
      if (clear(x) && clear(x + thick))
        shape.box(b.at, {x, y1 - deep, r.bottom + .001f}, {x + thick, y1, r.bottom + tall}, cover);
      x += thick + (dice_.chance(.08f) ? dice_.real(.02f, .1f) : .002f);
    }
  }
}

void Furnisher::rug(const Place& at, const Vector2f& size) {
  std::optional<Item> item;
  if (dice_.chance(.35f)) item = choose({"rug"});
  if (item) {
    const float grow = std::min(size.x() / item->size.x(), size.y() / item->size.y());
    *item = item->resized({item->size.x() * grow, item->size.y() * grow, .012f});
  } else {
    const float tone = dice_.real(.25f, .75f), tint = dice_.real(.02f, .16f);
    const Vector3f a_rgb{tone + dice_.real(-tint, tint), tone + dice_.real(-tint, .5f * tint),
                         tone + dice_.real(-tint, tint)};
    const Vector3f b_rgb = .6f * a_rgb + .4f * Vector3f(.85f, .8f, .72f);
    const Vector3f a = paint(dice_, a_rgb), b = paint(dice_, b_rgb);
    static constexpr Pattern kWeaves[] = {Pattern::kNoise, Pattern::kNoise, Pattern::kStripes,
                                          Pattern::kChecks};
    const Pattern weave = dice_.pick(kWeaves);
    const float period = weave == Pattern::kNoise ? .02f : dice_.real(.08f, .3f);
    const float border = dice_.chance(.5f) ? dice_.real(.05f, .15f) : 0;
    item = make("rug", [&](Shaper& shape) {
      const Vector3f half(size.x() / 2, size.y() / 2, 0), up(0, 0, .008f);
      const Finish edge = shape.pattern(Pattern::kNoise, b * .7f, b * .6f, .02f);
      shape.box({}, -half, half + up, edge);
      const Vector3f inner = half - Vector3f(border, border, 0);
      const Finish cloth =
          shape.pattern(weave, a, weave == Pattern::kNoise ? Vector3f(a * .8f) : b, period);
      shape.box({}, -inner + up, inner + up + Vector3f(0, 0, .002f), cloth);
    });
  }
  const Block block = item->block(at, 0);
  if (!inside(block)) return;
  for (const Standing& s : standing_)
    if (s.is_flat && overlap(block, s.block)) return;
  put({*item, at});
}

// --- light
// ------------------------------------------------------------------------------------------

void Furnisher::light(int piece, float strength) {
  if (piece < 0) return;
  const Item& item = itemOf(piece);
  const Piece& put = room_.pieces[size_t(piece)];
  std::vector<ModelLight> lights = item.lights;
  if (lights.empty()) {
    ModelLight guess;  // shades are at the top of what stands, and in the middle of what hangs
    const bool stands = item.role != "ceiling_lamp" && item.role != "wall_lamp";
    guess.centre.z() = item.size.z() * (stands ? .82f : .4f) / item.scale.z();
    lights.push_back(guess);
  }
  const Vector3f warm = Vector3f(1.f, dice_.real(.74f, .84f), dice_.real(.48f, .66f));
  for (const ModelLight& l : lights) {
    RoomLight light;
    light.centre = put.room_from_model * l.centre;
    // The shade is what shines: a bare bulb next to a wall would burn a spot into it, and a spot
    // that lights the whole room is what path tracers find hardest.
    const float shade = std::min(.4f, item.size.head<2>().maxCoeff() / 2);
    light.radius_m = std::max(std::clamp(l.diameter_m / 2, .03f, .1f), .75f * shade);
    light.bound_m = std::max(shade - light.radius_m, 0.f) + .02f;
    const float facing = float(M_PI) * light.radius_m * light.radius_m;
    light.radiance = warm * strength / (facing * float(lights.size()));
    room_.lights.push_back(light);
  }
  // What is nearest to the bulb and light in colour glows: the shade.
  const Vector3f bulb = put.room_from_model * lights.front().centre;
  const size_t triangles = item.mesh->mesh.triangles.size();
  const size_t first_triangle = standing_[size_t(piece)].first_triangle;
  std::vector<float> near(room_.surface.materials.size(), INFINITY);
  for (size_t i = 0; i < triangles; ++i) {
    const Eigen::Vector3i& t = item.mesh->mesh.triangles[i];
    Vector3f middle = Vector3f::Zero();
    for (int k = 0; k < 3; ++k)
      middle += put.room_from_model * item.mesh->mesh.vertices[size_t(t[k])] / 3;
    float& n = near[size_t(room_.surface.material[first_triangle + i])];
    n = std::min(n, (middle - bulb).norm());
  }
  int shade = -1;
  for (size_t i = 0; i < near.size(); ++i) {
    const Material& m = room_.surface.materials[i];
    if (!std::isfinite(near[i]) || (!m.texture && luminance(m.colour_a) < .2f)) continue;
    if (shade < 0 || near[i] < near[size_t(shade)]) shade = int(i);
  }
  if (shade < 0) return;
  Material& m = room_.surface.materials[size_t(shade)];
  m.emission = 1.6f;
  m.colour_a = m.colour_a.cwiseMax(.4f).cwiseProduct(Vector3f(1.f, .86f, .66f));
}

bool Furnisher::ceilingLamp(const Vector2f& at, bool must_shine) {
  if (!shell_.contains(at)) return false;
  for (const Standing& s : standing_)
    if (s.item.role == "ceiling_lamp" && (s.block.at.origin - at).norm() < 1.8f) return false;
  const float roof = shell_.ceilingAt(at);
  std::optional<Item> item = choose({"ceiling_lamp"}, {1.1f, 1.1f, roof - 1.95f});
  if (!item || dice_.chance(.2f)) {
    const float radius = dice_.real(.14f, .24f), drop = std::min(dice_.real(.1f, .6f), roof - 2.1f);
    const Vector3f shade = paint(dice_, {.88f, .85f, .78f}), metal = paint(dice_, {.5f, .5f, .5f});
    item = make("ceiling_lamp", [&](Shaper& shape) {
      const Finish cloth = shape.plain(shade), rod = shape.plain(metal, .2f, .3f);
      shape.turned({}, {{radius, 0}, {radius * .8f, .16f}, {.02f, .17f}}, cloth, 28);
      shape.turned({}, {{.008f, .17f}, {.008f, .17f + std::max(drop, .02f)}}, rod, 8);
      const float top = .17f + std::max(drop, .02f);
      shape.turned({}, {{.05f, top}, {.05f, top + .02f}}, rod, 16);
    });
    ModelLight bulb;
    bulb.centre.z() = .06f;  // in the shade
    item->lights = {bulb};
  }
  const Put hung{*item, Place::facing(at, {0, 1}), roof - item->size.z() - .002f};
  if (std::abs(shell_.height - roof) > .01f || !fits(item->block(hung.at, hung.z))) return false;
  const int piece = put(hung);
  const bool shines = lampsOn() || must_shine;
  if (shines) light(piece, dice_.real(7.f, 13.f));
  return true;
}

}  // namespace vdbc
