#include "examples/rooms/home_walls.h"

#include <array>
#include <cmath>
#include <cstdlib>
#include <optional>
#include <string>

namespace vdbc {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using Baseboard = Home::Baseboard;

/// Upper and lower edge of an SVG path with the commands M, v, h, a and z, which is all that the
/// catalogues use, at `x`; the shapes have no overhangs.
std::optional<std::pair<double, double>> shapeSpan(const std::string& path, double x) {
  std::vector<Vector2d> points;
  std::vector<double> numbers;
  char command = 0;
  Vector2d at(0, 0);
  const auto apply = [&]() {
    if (command == 'M' && numbers.size() == 2) points.push_back(at = {numbers[0], numbers[1]});
    if (command == 'v' && numbers.size() == 1) points.push_back(at += Vector2d(0, numbers[0]));
    if (command == 'h' && numbers.size() == 1) points.push_back(at += Vector2d(numbers[0], 0));
    if (command == 'a' && numbers.size() == 7) {
      // Half an ellipse whose horizontal axis is the chord: all arcs of the catalogues are.
      const double width = numbers[5], height = numbers[1];
      const double side = (numbers[4] > 0) == (width > 0) ? -1 : 1;
      const Vector2d middle = at + Vector2d(width / 2, numbers[6] / 2);
      for (int i = 1; i <= 24; ++i) {
        const double a = M_PI * i / 24;
        points.push_back(middle + Vector2d(-width / 2 * std::cos(a), side * height * std::sin(a)));
      }
      at += Vector2d(numbers[5], numbers[6]);
    }
    numbers.clear();
  };
  for (const char* c = path.c_str(); *c != 0;) {
    if (std::isalpha(static_cast<unsigned char>(*c))) {
      apply();
      command = *c++;
      continue;
    }
    char* end = nullptr;
    const double value = std::strtod(c, &end);
    if (end == c)
      ++c;
    else
      numbers.push_back(value), c = end;
  }
  apply();
  double low = std::numeric_limits<double>::infinity(), high = -low;
  for (size_t i = 0; i < points.size(); ++i) {
    const Vector2d &a = points[i], &b = points[(i + 1) % points.size()];
    if (std::min(a.x(), b.x()) > x || std::max(a.x(), b.x()) < x) continue;
    const double t = std::abs(b.x() - a.x()) < 1e-9 ? 0 : (x - a.x()) / (b.x() - a.x());
    const double y = a.y() + t * (b.y() - a.y());
    low = std::min(low, y), high = std::max(high, y);
  }
  if (!(high > low)) return std::nullopt;
  return std::pair(std::clamp(low, 0., 1.), std::clamp(high, 0., 1.));
}

Hole holeOf(const Home::Item& item, double level_elevation) {
  Hole hole;
  hole.centre = item.place, hole.axis = {std::cos(item.angle), std::sin(item.angle)};
  const bool is_round = item.cut_shape.find('a') != std::string::npos;
  const double bottom = level_elevation + item.elevation, height = item.size.z();
  const int steps = is_round ? 24 : 1;
  for (int i = 0; i <= steps; ++i) {
    // Cosine spacing: fine where an arch is steep.
    const double x = is_round ? .5 - .5 * std::cos(M_PI * i / steps) : i;
    const auto span =
        is_round ? shapeSpan(item.cut_shape, std::clamp(x, 1e-7, 1 - 1e-7)) : std::nullopt;
    hole.cuts.push_back({(x - .5) * item.size.x(), bottom + height * (span ? 1 - span->second : 0),
                         bottom + height * (span ? 1 - span->first : 1)});
  }
  return hole;
}

/// Centre line and side lines of a wall before joining. Round walls are cut into short chords.
struct WallLines {
  std::vector<Vector2d> left, right;
};

WallLines unjoined(const Home::Wall& wall) {
  WallLines lines;
  const Vector2d chord = wall.end - wall.start, d = chord.normalized();
  const double half = wall.thickness / 2;
  if (std::abs(wall.arc) < 1e-4) {
    lines.left = {wall.start + half * leftOf(d), wall.end + half * leftOf(d)};
    lines.right = {wall.start - half * leftOf(d), wall.end - half * leftOf(d)};
    return lines;
  }
  const Vector2d centre =
      (wall.start + wall.end) / 2 + leftOf(d) * (chord.norm() / 2 / std::tan(wall.arc / 2));
  const int steps = std::clamp(int(std::ceil(std::abs(wall.arc) / (M_PI / 48))), 2, 96);
  for (int i = 0; i <= steps; ++i) {
    const Vector2d from_centre =
        Eigen::Rotation2Dd(wall.arc * i / steps) * Vector2d(wall.start - centre);
    const Vector2d to_left = from_centre.normalized() * (wall.arc > 0 ? -1 : 1);
    lines.left.push_back(centre + from_centre + half * to_left);
    lines.right.push_back(centre + from_centre - half * to_left);
  }
  return lines;
}

/// Where the line through p along d meets the one through q along e; p where they are parallel, or
/// meet far off.
Vector2d corner(const Vector2d& p, const Vector2d& d, const Vector2d& q, const Vector2d& e,
                double reach) {
  const double turn = cross(d, e);
  if (std::abs(turn) < 1e-3) return p;
  const Vector2d meet = p + d * (cross(q - p, e) / turn);
  return (meet - p).norm() <= reach ? meet : p;
}

/// Mitres one end of `wall` with the neighbour that names it: the outer lines meet, the inner too.
void joinEnd(const std::vector<Home::Wall>& walls, const std::vector<WallLines>& lines,
             size_t index, bool at_end, WallLines* joined) {
  const Home::Wall& wall = walls[index];
  const std::string& other_id = at_end ? wall.at_end : wall.at_start;
  if (other_id.empty()) return;
  const auto other = std::find_if(walls.begin(), walls.end(),
                                  [&](const Home::Wall& w) { return w.id == other_id; });
  if (other == walls.end() || other->level != wall.level || &*other == &wall) return;
  const Vector2d mine = at_end ? wall.end : wall.start;
  const bool by_start = other->at_start == wall.id, by_end = other->at_end == wall.id;
  if (!by_start && !by_end) return;
  const bool other_end =
      by_start && by_end ? (other->end - mine).norm() < (other->start - mine).norm() : by_end;
  const WallLines &a = lines[index], &b = lines[size_t(other - walls.begin())];
  const auto along = [](const std::vector<Vector2d>& line, bool end) -> Vector2d {
    return end ? (line.back() - line[line.size() - 2]).normalized()
               : (line[1] - line[0]).normalized();
  };
  const auto tip = [](const std::vector<Vector2d>& line, bool end) {
    return end ? line.back() : line.front();
  };
  // Walls that run on into each other keep their sides; head to head, left meets right.
  const bool swaps = at_end == other_end;
  const double reach = 2 * std::max(wall.thickness, other->thickness);
  for (const bool left : {true, false}) {
    const auto& line = left ? a.left : a.right;
    const auto& other_line = left != swaps ? b.left : b.right;
    auto& out = left ? joined->left : joined->right;
    (at_end ? out.back() : out.front()) =
        corner(tip(line, at_end), along(line, at_end), tip(other_line, other_end),
               along(other_line, other_end), reach);
  }
}

/// What the holes of a stretch leave out between two places of its side, from below: heights of the
/// lower edge at both places, then of the upper. No hole begins or ends between them.
std::vector<std::array<double, 4>> gapsBetween(const Stretch& s, const Vector2d (&p)[2]) {
  std::vector<std::array<double, 4>> gaps;
  for (const Hole& hole : s.holes) {
    const double x[2] = {hole.x(p[0]), hole.x(p[1])}, mid = (x[0] + x[1]) / 2;
    for (size_t c = 0; c + 1 < hole.cuts.size(); ++c) {
      const Hole::Cut &l = hole.cuts[c], &h = hole.cuts[c + 1];
      if (mid <= l.x || mid >= h.x) continue;
      std::array<double, 4> gap;
      for (size_t end = 0; end < 2; ++end) {
        const double t = (x[end] - l.x) / (h.x - l.x), top = s.topAt(p[end]);
        gap[end] = std::clamp(l.low + t * (h.low - l.low), s.base, top);
        gap[end + 2] = std::clamp(l.high + t * (h.high - l.high), s.base, top);
      }
      gaps.push_back(gap);
    }
  }
  std::sort(gaps.begin(), gaps.end());
  return gaps;
}

/// One side of a stretch, less its holes: upright strips between the edges of the holes.
void addSide(const Stretch& s, bool left, FaceBuilder* faces) {
  const Vector2d a = left ? s.left[0] : s.right[0], b = left ? s.left[1] : s.right[1];
  const Vector2d outward = leftOf(s.direction()) * (left ? 1 : -1);
  const Home::Finish& finish = (left ? s.wall->left : s.wall->right).finish;
  std::vector<double> cuts{0, 1};
  for (const Hole& hole : s.holes)
    for (const Hole::Cut& cut : hole.cuts) {
      const double t = (cut.x - hole.x(a)) / (hole.x(b) - hole.x(a));
      if (t > 0 && t < 1) cuts.push_back(t);
    }
  std::sort(cuts.begin(), cuts.end());
  for (size_t k = 0; k + 1 < cuts.size(); ++k) {
    if (cuts[k + 1] - cuts[k] < 1e-9) continue;
    const Vector2d p[2] = {a + cuts[k] * (b - a), a + cuts[k + 1] * (b - a)};
    const double top[2] = {s.topAt(p[0]), s.topAt(p[1])};
    double z[2] = {s.base, s.base};
    const auto emit = [&](double high0, double high1) {
      if (high0 > z[0] || high1 > z[1])
        faces->add({lifted(p[0], z[0]), lifted(p[1], z[1]), lifted(p[1], std::max(high1, z[1])),
                    lifted(p[0], std::max(high0, z[0]))},
                   lifted(outward, 0), finish);
    };
    for (const auto& gap : gapsBetween(s, p)) {
      emit(gap[0], gap[1]);
      z[0] = std::max(z[0], gap[2]), z[1] = std::max(z[1], gap[3]);
    }
    emit(top[0], top[1]);
  }
}

/// The faces inside a hole, from one side of the wall to the other.
void addReveal(const Stretch& s, const Hole& hole, const Home::Finish& finish, FaceBuilder* faces) {
  const auto at = [&](bool left, double x) {  // share of the side's length, and the place
    const Vector2d a = left ? s.left[0] : s.right[0], b = left ? s.left[1] : s.right[1];
    const double t = std::clamp((x - hole.x(a)) / (hole.x(b) - hole.x(a)), 0., 1.);
    return std::pair<double, Vector2d>(t, a + t * (b - a));
  };
  const auto raised = [&](const Vector2d& p, double z) {
    return lifted(p, std::clamp(z, s.base, s.topAt(p)));
  };
  for (size_t k = 0; k + 1 < hole.cuts.size(); ++k) {
    const Hole::Cut* ends[2] = {&hole.cuts[k], &hole.cuts[k + 1]};
    for (const bool is_top : {false, true}) {
      std::vector<Vector3d> quad;
      for (const auto& [left, end] : {std::pair(true, 0), {true, 1}, {false, 1}, {false, 0}}) {
        const Vector2d p = at(left, ends[end]->x).second;
        quad.push_back(raised(p, is_top ? ends[end]->high : ends[end]->low));
      }
      faces->add(quad, Vector3d::UnitZ() * (is_top ? -1 : 1), finish);
    }
  }
  for (const bool is_last : {false, true}) {
    const Hole::Cut& cut = is_last ? hole.cuts.back() : hole.cuts.front();
    const auto [tl, l] = at(true, cut.x);
    const auto [tr, r] = at(false, cut.x);
    if (tl <= 0 || tl >= 1 || tr <= 0 || tr >= 1) continue;  // the hole goes on in the next stretch
    faces->add({raised(l, cut.low), raised(r, cut.low), raised(r, cut.high), raised(l, cut.high)},
               lifted(hole.axis, 0) * (is_last ? -1 : 1), finish);
  }
}

/// Skirting along one side, less the openings that reach down to it.
void addBaseboard(const Stretch& s, bool left, FaceBuilder* faces) {
  const Baseboard& board = (left ? s.wall->left : s.wall->right).baseboard;
  if (board.height <= 0 || board.thickness <= 0) return;
  const Vector2d a = left ? s.left[0] : s.right[0], b = left ? s.left[1] : s.right[1];
  const Vector2d outward = leftOf(s.direction()) * (left ? 1 : -1);
  std::vector<std::pair<double, double>> gaps;
  for (const Hole& hole : s.holes) {
    const double low = std::min_element(hole.cuts.begin(), hole.cuts.end(), [](auto& x, auto& y) {
                         return x.low < y.low;
                       })->low;
    if (low >= s.floor + board.height) continue;
    const double t0 = (hole.cuts.front().x - hole.x(a)) / (hole.x(b) - hole.x(a));
    const double t1 = (hole.cuts.back().x - hole.x(a)) / (hole.x(b) - hole.x(a));
    gaps.emplace_back(std::min(t0, t1), std::max(t0, t1));
  }
  gaps.emplace_back(1, 2);
  std::sort(gaps.begin(), gaps.end());
  double from = 0;
  for (const auto& [gap_start, gap_end] : gaps) {
    const double to = std::min(gap_start, 1.);
    if (to > from + 1e-6) {
      const Vector2d p = a + from * (b - a), q = a + to * (b - a), o = board.thickness * outward;
      const double z = s.floor + board.height;
      const Vector3d along = lifted(q - p, 0);
      faces->add(
          {lifted(p + o, s.floor), lifted(q + o, s.floor), lifted(q + o, z), lifted(p + o, z)},
          lifted(outward, 0), board.finish);
      faces->add({lifted(p, z), lifted(q, z), lifted(q + o, z), lifted(p + o, z)},
                 Vector3d::UnitZ(), board.finish);
      faces->add({lifted(p, s.floor), lifted(p + o, s.floor), lifted(p + o, z), lifted(p, z)},
                 -along, board.finish);
      faces->add({lifted(q, s.floor), lifted(q + o, s.floor), lifted(q + o, z), lifted(q, z)},
                 along, board.finish);
    }
    from = std::max(from, gap_end);
  }
}

}  // namespace

std::vector<Stretch> stretchesOf(const Home& home) {
  std::vector<WallLines> lines;
  for (const Home::Wall& wall : home.walls) lines.push_back(unjoined(wall));
  std::vector<Stretch> stretches;
  for (size_t i = 0; i < home.walls.size(); ++i) {
    const Home::Wall& wall = home.walls[i];
    WallLines joined = lines[i];
    joinEnd(home.walls, lines, i, false, &joined);
    joinEnd(home.walls, lines, i, true, &joined);
    const size_t count = joined.left.size() - 1;
    for (size_t k = 0; k < count; ++k) {
      Stretch s;
      s.wall = &wall;
      s.floor = home.levels[size_t(wall.level)].elevation;
      s.base = s.floor - home.levels[size_t(wall.level)].floor_thickness;
      for (int end = 0; end < 2; ++end) {
        const size_t at = k + size_t(end);
        s.left[end] = joined.left[at], s.right[end] = joined.right[at];
        s.top[end] =
            s.floor + wall.height + (wall.height_at_end - wall.height) * double(at) / double(count);
        s.has_cap[end] = at == 0 || at == count;
      }
      if ((s.middle(1) - s.middle(0)).norm() > 1e-6) stretches.push_back(s);
    }
  }
  return stretches;
}

std::vector<WallOpening> cutOpenings(const Home& home, std::vector<Stretch>* stretches) {
  std::vector<WallOpening> openings;
  for (const Home::Item& item : home.items) {
    if (!item.is_opening) continue;
    WallOpening opening{&item, holeOf(item, home.levels[size_t(item.level)].elevation)};
    const Hole& hole = opening.hole;
    const Vector2d across = leftOf(hole.axis);  // the model's back looks this way
    const double band_end = (.5 - item.wall_distance) * item.size.y();
    const double band_start = band_end - item.wall_thickness * item.size.y();
    for (Stretch& s : *stretches) {
      if (s.wall->level != item.level || std::abs(cross(s.direction(), hole.axis)) > .2) continue;
      const double a = across.dot(s.middle(0) - hole.centre),
                   b = across.dot(s.middle(1) - hole.centre);
      const double xa = hole.x(s.middle(0)), xb = hole.x(s.middle(1)), half = s.wall->thickness / 2;
      const double from = std::max(std::min(xa, xb), hole.cuts.front().x),
                   to = std::min(std::max(xa, xb), hole.cuts.back().x);
      if (to - from < 1e-3) continue;
      const double middle = a + (b - a) * ((from + to) / 2 - xa) / (xb - xa);
      const double overlap =
          std::min(middle + half, band_end) - std::max(middle - half, band_start);
      if (overlap < .25 * std::min(2 * half, band_end - band_start)) continue;
      s.holes.push_back(hole);
      opening.back = opening.is_in_wall ? std::max(opening.back, middle + half) : middle + half;
      opening.front = opening.is_in_wall ? std::min(opening.front, middle - half) : middle - half;
      opening.is_in_wall = true;
    }
    openings.push_back(opening);
  }
  return openings;
}

void addStretch(const Stretch& s, FaceBuilder* faces) {
  const Vector3d along = lifted(s.direction(), 0);
  addSide(s, true, faces);
  addSide(s, false, faces);
  addBaseboard(s, true, faces);
  addBaseboard(s, false, faces);
  const Home::Finish& finish = s.wall->left.finish;
  const auto top = [&](const Vector2d& p) { return lifted(p, s.topAt(p)); };
  faces->add({top(s.left[0]), top(s.left[1]), top(s.right[1]), top(s.right[0])}, Vector3d::UnitZ(),
             finish);
  for (int end = 0; end < 2; ++end)
    if (s.has_cap[end])
      faces->add({lifted(s.left[end], s.base), lifted(s.right[end], s.base), top(s.right[end]),
                  top(s.left[end])},
                 along * (end ? 1 : -1), finish);
  for (const Hole& hole : s.holes) addReveal(s, hole, s.wall->right.finish, faces);
}

const Stretch* wallAt(const std::vector<Stretch>& stretches, int level, const Vector2d& p,
                      double near) {
  const Stretch* best = nullptr;
  for (const Stretch& s : stretches) {
    if (s.wall->level != level) continue;
    const Vector2d d = s.direction(), from = p - s.middle(0);
    const double along = d.dot(from), length = (s.middle(1) - s.middle(0)).norm();
    const double off = std::abs(cross(d, from)) - s.wall->thickness / 2;
    if (along < -near || along > length + near || off > near) continue;
    if (best == nullptr || std::max(s.top[0], s.top[1]) > std::max(best->top[0], best->top[1]))
      best = &s;
  }
  return best;
}

}  // namespace vdbc
