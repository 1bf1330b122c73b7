// Rooms from a seed: a shell, and furniture by the rules of the room's kind.
#include <algorithm>
#include <cmath>

#include "examples/rooms/furnish.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Vector2f;
using Eigen::Vector3f;
using Pattern = Material::Pattern;
using Roles = std::vector<std::string>;

constexpr float kAnywhere = 3.15f;  // radians: any yaw

// --- pieces of our own
// -----------------------------------------------------------------------------

/// A colour between two tones, not far from grey.
Vector3f muted(Dice& dice, float darkest, float lightest) {
  const float tone = dice.real(darkest, lightest), tint = dice.real(.02f, .2f);
  const Vector3f c{tone + dice.real(-tint, tint), tone + dice.real(-tint, tint),
                   tone + dice.real(-tint, tint)};
  return paint(dice, c);
}

Item framedPicture(Furnisher& f, float width, float height) {
  Dice& dice = f.dice();
  const bool mirror = dice.chance(.15f);
  const float edge = dice.real(.015f, .045f),
              mat = mirror || dice.chance(.5f) ? 0 : dice.real(.03f, .08f);
  static const Vector3f kFrames[] = {
      {.15f, .14f, .14f}, {.88f, .87f, .85f}, {.48f, .33f, .22f}, {.68f, .58f, .36f}};
  const Vector3f frame = paint(dice, dice.pick(kFrames));
  const Vector3f sky = muted(dice, .35f, .9f);
  const Vector3f land = muted(dice, .12f, .6f);
  const float horizon = dice.real(.25f, .6f), period = dice.real(.1f, .35f) * width;
  return f.make("wall_thing", [&](Shaper& shape) {
    const float w = width / 2, h = height;
    const Finish wood = shape.plain(frame, .04f, .3f);
    shape.box({}, {-w, 0, 0}, {-w + edge, .025f, h}, wood);
    shape.box({}, {w - edge, 0, 0}, {w, .025f, h}, wood);
    shape.box({}, {-w + edge, 0, 0}, {w - edge, .025f, edge}, wood);
    shape.box({}, {-w + edge, 0, h - edge}, {w - edge, .025f, h}, wood);
    const float e = edge + mat;
    if (mirror) {
      const Finish glass = shape.plain(Vector3f::Constant(.08f), .85f, .03f);
      shape.box({}, {-w + e, 0, e}, {w - e, .014f, h - e}, glass);
      return;
    }
    if (mat > 0)
      shape.box({}, {-w + edge, 0, edge}, {w - edge, .01f, h - edge},
                shape.plain(Vector3f::Constant(.78f)));
    const float split = e + (h - 2 * e) * horizon;
    shape.box({}, {-w + e, 0, e}, {w - e, .013f, split},
              shape.pattern(Pattern::kNoise, land, land * .45f, period));
    shape.box({}, {-w + e, 0, split}, {w - e, .013f, h - e},
              shape.pattern(Pattern::kNoise, sky, .5f * sky + .5f * land, period * 1.7f));
  });
}

Item mirror(Furnisher& f, float width, float height) {
  return f.make("wall_thing", [&](Shaper& shape) {
    const Finish edge = shape.plain(Vector3f::Constant(.5f), .2f, .3f);
    const Finish glass = shape.plain(Vector3f::Constant(.08f), .85f, .02f);
    shape.box({}, {-width / 2, 0, 0}, {width / 2, .018f, height}, edge);
    shape.box({}, {-width / 2 + .01f, .018f, .01f}, {width / 2 - .01f, .022f, height - .01f},
              glass);
  });
}

Item flatScreen(Furnisher& f, float width) {
  return f.make("tv", [&](Shaper& shape) {
    const Finish dark = shape.plain(Vector3f::Constant(.02f), .04f, .4f);
    const Finish screen = shape.plain(Vector3f::Constant(.012f), .06f, .08f);
    const float height = width * .58f;
    shape.box({}, {-width * .2f, -.1f, 0}, {width * .2f, .1f, .012f}, dark);
    shape.box({}, {-.03f, -.02f, .012f}, {.03f, .01f, .06f}, dark);
    shape.box({}, {-width / 2, -.02f, .06f}, {width / 2, .015f, .06f + height}, dark);
    shape.box({}, {-width / 2 + .01f, .015f, .07f}, {width / 2 - .01f, .017f, .05f + height},
              screen);
  });
}

Item plate(Furnisher& f, const Vector3f& colour) {
  return f.make("table_thing", [&](Shaper& shape) {
    const Finish china = shape.plain(colour, .05f, .2f);
    shape.turned({}, {{.07f, 0}, {.125f, .018f}, {.12f, .02f}, {.08f, .008f}}, china, 24);
  });
}

Item drinkingGlass(Furnisher& f) {
  return f.make("table_thing", [&](Shaper& shape) {
    const Finish glass = shape.plain({.75f, .8f, .8f}, .08f, .1f);
    shape.material(glass).opacity = .25f;
    shape.turned({}, {{.028f, 0}, {.036f, .11f}}, glass, 16);
  });
}

// --- groups
// ----------------------------------------------------------------------------------------

void lampOn(Furnisher& f, int lamp, float strength = 3.f) {
  if (lamp >= 0 && f.lampsOn()) f.light(lamp, strength * f.dice().real(.7f, 1.4f));
}

void floorLamp(Furnisher& f) {
  const std::optional<Item> lamp = f.choose({"floor_lamp"}, {.9f, .9f, 2.1f});
  if (lamp) lampOn(f, f.atWall(*lamp, {0, .7f, .06f, 40}), 5.f);
}

/// Things on a piece, and lamps among them lit.
void dress(Furnisher& f, int piece, const Roles& roles, int count, const Vector2f& largest,
           float tallest = .5f, float back = -1, float front = 1, float yaw = kAnywhere) {
  for (int thing : f.things(piece, {roles, count, largest, tallest, back, front, yaw}))
    if (f.itemOf(thing).role == "table_lamp" || f.itemOf(thing).role == "desk_lamp")
      lampOn(f, thing, 2.5f);
}

int storage(Furnisher& f, const Roles& roles, float front = .5f) {
  const std::optional<Item> item = f.choose(roles, {2.6f, .95f, 2.35f});
  if (!item) return -1;
  WallRules rules;
  rules.front = front;
  const int piece = f.atWall(*item, rules);
  if (piece < 0) return -1;
  if (item->role == "bookcase" || item->role == "shelf_unit") f.fillShelf(piece, .8f);
  if (item->size.z() < 1.4f)
    dress(f, piece, {"shelf_thing", "table_plant", "table_lamp", "shelf_thing"},
          f.dice().integer(1, 4), {.4f, .4f});
  return piece;
}

void plants(Furnisher& f, int most) {
  for (int i = f.dice().integer(0, most); i > 0; --i) {
    const std::optional<Item> plant = f.choose({"floor_plant"}, {.9f, .9f, 2.2f});
    if (plant) f.atWall(*plant, {0, .7f, .06f, 30});
  }
}

void floorThings(Furnisher& f, int most) {
  for (int i = f.dice().integer(0, most); i > 0; --i) {
    const std::optional<Item> thing = f.choose({"floor_thing"}, {.8f, .8f, 1.3f});
    if (!thing) return;
    if (f.has(thing->model)) continue;
    if (f.dice().chance(.7f))
      f.atWall(*thing, {0, .5f, .05f, 20});
    else
      f.inRoom(*thing);
  }
}

void onWalls(Furnisher& f) {
  Dice& dice = f.dice();
  for (int i = dice.integer(1, 4); i > 0; --i) {
    const float w = dice.real(.3f, 1.1f), h = std::clamp(w * dice.real(.6f, 1.4f), .3f, .9f);
    const float middle = dice.real(1.5f, 1.7f);
    f.onWall(framedPicture(f, w, h), middle - h / 2);
  }
  if (dice.chance(.4f)) {
    const std::optional<Item> thing = f.choose({"wall_thing"}, {1.2f, .2f, 1.2f});
    if (thing) f.onWall(*thing, 1.6f - thing->size.z() / 2);
  }
  if (dice.chance(.25f)) {
    const std::optional<Item> lamp = f.choose({"wall_lamp"}, {.5f, .4f, .7f});
    if (lamp) lampOn(f, f.onWall(*lamp, 1.75f - lamp->size.z() / 2), 2.f);
  }
}

void radiators(Furnisher& f) {
  if (f.dice().chance(.5f)) return;
  for (const Wall& wall : f.shell().walls)
    for (const Opening& o : wall.openings) {
      if (!o.is_window || o.bottom < .45f) continue;
      const std::optional<Item> item = f.choose({"radiator"}, {o.hi - o.lo, .3f, o.bottom - .12f});
      if (!item) continue;
      const float z = std::max(.08f, (o.bottom - .05f - item->size.z()) / 2);
      f.tryGroup({{*item, wall.place((o.lo + o.hi) / 2, item->size.y() / 2 + .025f), z}});
    }
}

/// A table's edges where chairs go: places on the edge that face the table's middle.
std::vector<Place> seatsAt(const Block& table, float chair_width, bool round) {
  std::vector<Place> seats;
  if (round) {
    const float r = table.half.minCoeff();
    const int count = std::clamp(int(2 * float(M_PI) * r / (chair_width + .25f)), 2, 6);
    for (int i = 0; i < count; ++i) {
      const Place turned = table.at.turned(2 * float(M_PI) * float(i) / float(count));
      seats.push_back(turned.at(0, r).back());
    }
    return seats;
  }
  for (int turn = 0; turn < 4; ++turn) {
    const float along = turn % 2 ? table.half.y() : table.half.x();
    const float across = turn % 2 ? table.half.x() : table.half.y();
    Place side = table.at;
    for (int i = 0; i < turn; ++i) side = {side.origin, -side.s, side.c};
    const int count = int(2 * along / (chair_width + .12f));
    if (turn % 2 && 2 * along < .7f) continue;
    for (int i = 0; i < count; ++i) {
      const float x = along * (2 * (float(i) + .5f) / float(count) - 1);
      seats.push_back(side.at(x, across).back());
    }
  }
  return seats;
}

int diningTable(Furnisher& f) {
  Dice& dice = f.dice();
  const bool round = dice.chance(.25f);
  const float longest = f.area() > 20 ? 2.4f : f.area() > 12 ? 1.8f : 1.3f;
  std::optional<Item> table =
      f.choose({round ? "round_table" : "dining_table"}, {longest, longest, .85f});
  if (!table) table = f.choose({"dining_table", "round_table"}, {longest, longest, .9f});
  const std::optional<Item> chair = f.choose({"chair"}, {.75f, .8f, 1.25f});
  if (!table || !chair) return -1;
  const bool at_wall = f.area() < 11 || dice.chance(.15f);
  const bool is_round = table->role == "round_table";
  int piece = -1;
  if (at_wall) {
    piece = f.atWall(*table, {.6f, .3f, .022f, 60});
  } else {
    // Room for the chairs around it: tried with a larger block first.
    const Item wide = table->resized(table->size + Vector3f(1.f, 1.f, 0));
    const std::vector<int> found = f.groupInRoom(
        [&](const Place& at) {
          const Place turned = dice.chance(.5f) ? at : Place{at.origin, -at.s, at.c};
          return f.fits(wide.block(turned, 0)) ? std::vector<Put>{{*table, turned}}
                                               : std::vector<Put>{{wide, {{-100, -100}}}};
        },
        150);
    piece = found.empty() ? f.inRoom(*table, 0) : found.front();
  }
  if (piece < 0) return -1;
  std::vector<Place> seats = seatsAt(f.blockOf(piece), chair->size.x(), is_round);
  const std::vector<int> chairs = f.chairsAt(piece, *chair, seats, .12f);
  const bool is_laid = dice.chance(.6f);
  const Vector3f white = paint(dice, {.88f, .88f, .86f}, .05f);
  if (is_laid)
    for (size_t i = 0; i < seats.size(); ++i) {
      if (chairs[i] < 0) continue;
      f.thingAt(piece, plate(f, white), seats[i].at(0, .19f));
      const Item glass = drinkingGlass(f);
      f.thingAt(piece, glass, seats[i].at(.15f, .3f));
    }
  dress(f, piece, {"table_thing", "table_thing", "table_plant"}, dice.integer(1, 4), {.4f, .4f},
        .45f, -.5f, .5f);
  if (!at_wall) {
    if (dice.chance(.45f))
      f.rug(f.placeOf(piece), 2 * f.blockOf(piece).half + Vector2f(1.1f, 1.1f));
    if (dice.chance(.7f)) f.ceilingLamp(f.placeOf(piece).origin);
  }
  return piece;
}

/// Desk at a wall, chair in front, computer and desk things on it.
void dressDesk(Furnisher& f, int desk, float chair_jitter) {
  Dice& dice = f.dice();
  std::optional<Item> chair = f.choose({"office_chair"}, {.85f, .85f, 1.35f});
  if (!chair || dice.chance(.15f)) chair = f.choose({"chair"}, {.7f, .75f, 1.2f});
  if (chair) {
    const Block& b = f.blockOf(desk);
    f.chairsAt(desk, *chair, {b.at.at(dice.real(-.1f, .1f), b.half.y()).back()}, chair_jitter);
  }
  if (dice.chance(.75f)) f.things(desk, {{"computer"}, 1, {.75f, .7f}, .8f, -.8f, .2f, .12f});
  if (dice.chance(.5f)) dress(f, desk, {"desk_lamp"}, 1, {.4f, .4f}, .7f, -1, 0, .6f);
  dress(f, desk, {"desk_thing"}, dice.integer(1, 4), {.35f, .35f}, .4f);
}

int desk(Furnisher& f) {
  const std::optional<Item> item = f.choose({"desk"}, {2.1f, 1.1f, 1.5f});
  if (!item) return -1;
  const int piece = f.atWall(*item, {.75f, .3f, .022f, 80});
  if (piece >= 0) dressDesk(f, piece, .4f);
  return piece;
}

// --- bedroom
// ---------------------------------------------------------------------------------------

void bed(Furnisher& f) {
  Dice& dice = f.dice();
  const bool is_small = f.area() < 11 || dice.chance(.3f);
  std::optional<Item> item = f.choose({is_small ? "single_bed" : "bed"}, {2.3f, 2.5f, 2.2f});
  if (!item) item = f.choose({"bed", "single_bed"}, {2.3f, 2.5f, 2.2f});
  if (!item) return;
  const std::optional<Item> stand = f.choose({"nightstand", "side_table"}, {.65f, .6f, .75f});
  const float side = stand ? stand->size.x() / 2 + item->size.x() / 2 + .04f : 0;
  WallRules rules;
  rules.front = .45f, rules.corner_share = is_small ? .8f : .1f, rules.tries = 150;
  const float width = item->size.x() + (stand && !is_small ? 2 * stand->size.x() + .1f : 0);
  const auto layout = [&](const Place& at) {
    std::vector<Put> puts = {{*item, at.at(0, item->size.y() / 2)}};
    if (stand)
      for (float x : {-side, side})
        puts.push_back({*stand, at.at(x, stand->size.y() / 2), 0, true});
    return puts;
  };
  std::vector<int> pieces = f.groupAtWall(width, rules, layout);
  if (pieces.empty()) pieces = f.groupAtWall(item->size.x(), rules, layout);
  if (pieces.empty()) return;
  for (size_t i = 1; i < pieces.size(); ++i)
    if (pieces[i] >= 0) {
      dress(f, pieces[i], {"table_lamp"}, 1, {.4f, .4f}, .6f);
      if (dice.chance(.5f)) dress(f, pieces[i], {"desk_thing", "shelf_thing"}, 1, {.2f, .2f}, .25f);
    }
  const Block& b = f.blockOf(pieces[0]);
  if (dice.chance(.6f))
    f.rug(b.at.at(0, b.half.y() * .45f),
          {2 * b.half.x() + dice.real(.7f, 1.2f), b.half.y() * 1.5f});
  const float w = dice.real(.5f, 1.2f), h = dice.real(.35f, .6f);
  if (dice.chance(.6f)) f.onWallAbove(framedPicture(f, w, h), pieces[0], 1.3f);
}

void bedroom(Furnisher& f) {
  Dice& dice = f.dice();
  bed(f);
  if (f.area() > 11 && dice.chance(.15f)) {
    const std::optional<Item> crib = f.choose({"crib"});
    if (crib) f.atWall(*crib);
  }
  storage(f, {"wardrobe"}, .6f);
  if (f.area() > 20 && dice.chance(.5f)) storage(f, {"wardrobe"}, .6f);
  storage(f, {"dresser"});
  if (dice.chance(.4f)) desk(f);
  if (dice.chance(.35f)) storage(f, {"bookcase", "shelf_unit"});
  if (f.area() > 15 && dice.chance(.6f)) {
    const std::optional<Item> seat = f.choose({"armchair", "ottoman"}, {1.f, 1.f, 1.3f});
    if (seat) f.atWall(*seat, {.4f, .6f, .08f, 40});
  }
  if (dice.chance(.3f)) floorLamp(f);
}

// --- living
// ----------------------------------------------------------------------------------------

/// Sofa, coffee table, rug, armchairs; before the sofa, at `distance` from the wall, a television.
bool seating(Furnisher& f) {
  Dice& dice = f.dice();
  std::optional<Item> sofa =
      f.choose({dice.chance(.25f) ? "corner_sofa" : "sofa"}, {3.2f, 2.6f, 1.2f});
  if (!sofa) sofa = f.choose({"sofa"}, {3.f, 1.4f, 1.3f});
  if (!sofa) return false;
  const std::optional<Item> table = f.choose({"coffee_table"}, {1.4f, 1.1f, .6f});
  const std::optional<Item> armchair = f.choose({"armchair"}, {1.15f, 1.15f, 1.3f});
  std::optional<Item> stand = f.choose({"tv_stand", "dresser"}, {2.2f, .7f, .95f});
  std::optional<Item> screen = f.choose({"tv"}, {1.3f, .4f, .9f});
  if (!screen || dice.chance(.6f)) screen = flatScreen(f, dice.real(.85f, 1.3f));
  bool has_tv = stand && dice.chance(.8f);
  const bool shallow = sofa->role == "sofa";
  const float sofa_depth = sofa->size.y(), gap = dice.real(.3f, .45f);
  const float table_y = sofa_depth + gap + (table ? table->size.y() / 2 : 0);
  float tv_y = sofa_depth + dice.real(1.5f, 2.4f) + (table ? table->size.y() / 2 : 0);
  const float arm_yaw = dice.real(.5f, 1.2f);
  // In the sofa's frame: back at y = 0.
  const auto layout = [&](const Place& at) {
    std::vector<Put> puts = {{*sofa, at.at(0, sofa_depth / 2)}};
    if (has_tv) {
      puts.push_back({*stand, at.at(0, tv_y + stand->size.y() / 2).back()});
    }
    if (table) puts.push_back({*table, at.at(0, shallow ? table_y : table_y - .1f), 0, true});
    if (armchair)
      for (float side : {-1.f, 1.f}) {
        const float x = side * (sofa->size.x() / 2 + .1f + armchair->size.x() / 2);
        puts.push_back({*armchair, at.at(x, sofa_depth + .35f).turned(side * arm_yaw), 0, true});
      }
    return puts;
  };
  WallRules rules;
  rules.front = 0, rules.corner_share = .15f, rules.tries = 120, rules.gap = .04f;
  std::vector<int> pieces;
  if (has_tv) {
    // The television at a wall; the sofa at the opposite one if that is not too far.
    const float nearest = tv_y + stand->size.y();
    pieces = f.groupAtWall(std::max(stand->size.x(), 1.f), rules, [&](const Place& at) {
      float across = nearest;
      while (across < nearest + 1.2f && f.shell().contains(at.point(0, across + .02f)))
        across += .02f;
      if (f.shell().contains(at.point(0, across + .04f))) across = nearest;
      tv_y = across - stand->size.y() - .02f;
      return layout(at.at(0, across - .02f).back());
    });
  }
  if (!pieces.empty()) f.thingAt(pieces[1], *screen, f.placeOf(pieces[1]), .35f);
  has_tv = false;
  if (pieces.empty()) pieces = f.groupAtWall(sofa->size.x(), rules, layout);
  if (pieces.empty()) return false;
  const Place at = f.placeOf(pieces[0]);
  for (int piece : pieces) {
    if (piece < 0) continue;
    if (f.itemOf(piece).role == "coffee_table")
      dress(f, piece, {"table_thing", "table_plant", "desk_thing"}, dice.integer(1, 3),
            {.35f, .35f}, .35f);
  }
  if (dice.chance(.8f)) {
    const float deep = dice.real(1.5f, 2.1f);
    f.rug(at.at(0, sofa_depth / 2 + deep / 2 - .3f),
          {sofa->size.x() * dice.real(.8f, 1.15f), deep});
  }
  const float w = dice.real(.7f, 1.5f), h = dice.real(.45f, .8f);
  if (dice.chance(.6f)) f.onWallAbove(framedPicture(f, w, h), pieces[0], 1.25f);
  return true;
}

void loneArmchair(Furnisher& f) {
  const std::optional<Item> item = f.choose({"armchair"}, {1.2f, 1.2f, 1.4f});
  if (!item) return;
  const float yaw = f.dice().real(.3f, .8f) * (f.dice().chance(.5f) ? 1 : -1);
  f.groupAtWall(item->size.x() * 1.4f, {0, .8f, .02f, 50}, [&](const Place& at) {
    const float off = item->size.head<2>().norm() / 2;
    return std::vector<Put>{{*item, at.at(0, off).turned(yaw)}};
  });
}

void living(Furnisher& f) {
  Dice& dice = f.dice();
  seating(f);
  if (dice.chance(.15f)) {
    const std::optional<Item> fire = f.choose({"fireplace"}, {2.f, .9f, 1.6f});
    if (fire) f.atWall(*fire, {.8f, 0, .0f, 60});
  }
  if (f.area() > 22 && dice.chance(.6f)) diningTable(f);
  storage(f, {"bookcase", "shelf_unit"});
  if (dice.chance(.6f)) storage(f, {"dresser", "bookcase"});
  if (dice.chance(.6f)) loneArmchair(f);
  if (f.area() > 18 && dice.chance(.25f)) {
    const std::optional<Item> piano = f.choose({"piano"}, {1.8f, 1.8f, 1.5f});
    if (piano) f.atWall(*piano, {.6f, .3f, .03f, 60});
  }
  if (dice.chance(.12f)) {
    const std::optional<Item> tank = f.choose({"aquarium"}, {1.5f, .8f, 1.5f});
    if (tank) f.atWall(*tank);
  }
  if (f.area() > 26) storage(f, {"bookcase", "shelf_unit", "dresser"});
  if (dice.chance(.7f)) floorLamp(f);
  if (f.area() > 30 && dice.chance(.5f)) desk(f);
}

void dining(Furnisher& f) {
  Dice& dice = f.dice();
  diningTable(f);
  storage(f, {"dresser"});
  if (dice.chance(.6f)) storage(f, {"bookcase", "shelf_unit", "dresser"});
  if (f.area() > 22) seating(f);
  if (f.area() > 16 && dice.chance(.5f)) loneArmchair(f);
  if (dice.chance(.4f)) floorLamp(f);
}

void study(Furnisher& f) {
  Dice& dice = f.dice();
  desk(f);
  for (int i = 1 + int(f.area() / 8); i > 0; --i) storage(f, {"bookcase", "shelf_unit"}, .5f);
  if (dice.chance(.7f)) loneArmchair(f);
  if (f.area() > 20 && dice.chance(.6f)) seating(f);
  if (f.area() > 16 && dice.chance(.4f)) {
    const std::optional<Item> piano = f.choose({"piano"}, {1.8f, 1.8f, 1.5f});
    if (piano) f.atWall(*piano, {.6f, .3f, .03f, 60});
  }
  if (dice.chance(.4f)) storage(f, {"dresser", "office_cabinet"});
  if (dice.chance(.6f)) floorLamp(f);
  if (dice.chance(.5f)) {
    const Vector2f size{dice.real(1.4f, 2.4f), dice.real(1.f, 1.7f)};
    const Wall& wall = f.shell().walls.front();
    f.rug(wall.place(wall.length / 2, size.y() / 2 + dice.real(.6f, 1.5f)), size);
  }
}

// --- kitchen
// ---------------------------------------------------------------------------------------

/// An oven with four glass-ceramic rings: few catalogue models are slim enough for a row of
/// cabinets.
Item cooker(Furnisher& f) {
  const Vector3f enamel =
      f.dice().chance(.5f) ? Vector3f(.8f, .8f, .79f) : Vector3f(.3f, .3f, .31f);
  return f.make("kitchen_stove", [&](Shaper& shape) {
    const Finish body = shape.plain(enamel, .06f, .25f),
                 dark = shape.plain(Vector3f::Constant(.02f), .08f, .1f);
    const Finish ring = shape.plain(Vector3f::Constant(.07f), .06f, .2f),
                 steel = shape.plain(Vector3f::Constant(.45f), .3f, .3f);
    shape.box({}, {-.3f, -.3f, .1f}, {.3f, .28f, .88f}, body);
    shape.box({}, {-.28f, -.28f, 0}, {.28f, .24f, .1f}, dark);
    shape.box({}, {-.29f, -.28f, .88f}, {.29f, .27f, .888f}, dark);
    shape.box({}, {-.24f, .28f, .25f}, {.24f, .284f, .64f}, dark);
    shape.box({}, {-.25f, .285f, .67f}, {.25f, .31f, .69f}, steel);
    for (float x : {-.14f, .14f})
      for (float y : {-.13f, .13f})
        shape.turned({{x, y}}, {{.09f, .888f}, {.085f, .8895f}}, ring, 24);
    for (int i = 0; i < 5; ++i)
      shape.box({}, {-.22f + .1f * float(i), .28f, .77f}, {-.18f + .1f * float(i), .3f, .81f},
                steel);
  });
}

/// Cabinets of one height and depth side by side, from a corner on along the walls.
class KitchenRun {
 public:
  explicit KitchenRun(Furnisher& f) : f_(f), dice_(f.dice()) {
    base_ = f.choose({"kitchen_base"}, {1.1f, .9f, 1.1f});
    upper_ = f.choose({"kitchen_upper"}, {1.1f, .6f, 1.f});
    hood_ = f.choose({"hood"}, {1.f, .7f, 1.2f});
    depth_ = dice_.real(.58f, .64f), height_ = dice_.real(.86f, .92f);
  }

  /// Number of cabinets placed.
  int build() {
    for (const char* role :
         {"kitchen_sink", "kitchen_stove", "fridge", "dishwasher", "kitchen_tall"})
      if (std::optional<Item> item = f_.choose({role}, {1.6f, 1.f, 2.3f})) once_.push_back(*item);
    if (std::none_of(once_.begin(), once_.end(),
                     [](const Item& i) { return i.role == "kitchen_stove"; }))
      once_.insert(once_.begin() + long(std::min<size_t>(1, once_.size())), cooker(f_));
    if (base_) once_.insert(once_.begin() + std::min<long>(1, long(once_.size())), *base_);
    const auto& walls = f_.shell().walls;
    std::vector<size_t> order;
    for (size_t i = 0; i < walls.size(); ++i) order.push_back(i);
    std::stable_sort(order.begin(), order.end(),
                     [&](size_t a, size_t b) { return usable(walls[a]) > usable(walls[b]); });
    const bool has_corner = dice_.chance(.5f);
    along(walls[order[0]], .02f);
    if (has_corner || count_ < 4) along(walls[(order[0] + 1) % walls.size()], depth_ + .03f);
    for (size_t i = 1; i < order.size() && count_ < 3; ++i) along(walls[order[i]], .02f);
    for (int piece : counters_)
      dress(f_, piece,
            {"counter_thing", "counter_thing", "table_thing", "microwave", "table_plant"},
            dice_.integer(0, 2), {.55f, .5f}, .5f, -.8f, .6f, .3f);
    return count_;
  }

 private:
  static float usable(const Wall& wall) {
    float length = wall.length;
    for (const Opening& o : wall.openings) length -= o.is_window ? .3f : 1.2f;
    return length;
  }
  Item fitted(const Item& item) const {
    const bool low = item.size.z() < 1.25f;
    Vector3f size = item.size;
    size.x() = std::clamp(size.x(), .4f, 1.1f);
    size.y() = std::clamp(size.y(), .85f * depth_, low ? depth_ : .75f);
    if (low) size.z() = height_;
    return item.resized(size);
  }
  bool tryAt(const Wall& wall, float s, const Item& item) {
    const Place at = wall.place(s + item.size.x() / 2, item.size.y() / 2 + .016f);
    const std::vector<int> piece = f_.tryGroup({{item, at}}, .7f);
    if (piece.empty()) return false;
    ++count_;
    if (item.size.z() > 1.25f) return true;
    if (item.role != "kitchen_stove") counters_.push_back(piece[0]);
    above(wall, s, item.size.x(), item.role);
    return true;
  }
  /// Side by side from `s` on: what there is once, cabinets between; gaps only before doors.
  void along(const Wall& wall, float s) {
    bool was_base = false;
    while (s < wall.length - .3f) {
      bool found = false;
      for (size_t i = 0; !found && i < once_.size() && !(base_ && !was_base && count_ % 2); ++i) {
        const Item item = fitted(once_[i]);
        if (!tryAt(wall, s, item)) continue;
        s += item.size.x() + .002f;
        once_.erase(once_.begin() + long(i));
        found = true, was_base = false;
      }
      if (!found && base_ && tryAt(wall, s, fitted(*base_))) {
        s += fitted(*base_).size.x() + .002f;
        found = was_base = true;
      }
      if (!found) s += .1f;
    }
  }
  void above(const Wall& wall, float s, float width, const std::string& role) {
    if (role == "kitchen_stove" && hood_) {
      const float foot = std::max(1.5f, hood_->elevation_m);
      f_.tryGroup({{*hood_, wall.place(s + width / 2, hood_->size.y() / 2 + .004f), foot}});
      return;
    }
    if (!upper_) return;
    const Item fitted =
        upper_->resized({width, std::min(upper_->size.y(), .38f), upper_->size.z()});
    f_.tryGroup({{fitted, wall.place(s + width / 2, fitted.size.y() / 2 + .004f), 1.42f}});
  }
  Furnisher& f_;
  Dice& dice_;
  std::optional<Item> base_, upper_, hood_;
  float depth_ = .6f, height_ = .9f;
  int count_ = 0;
  std::vector<Item> once_;
  std::vector<int> counters_;  // pieces on which things stand
};

void kitchen(Furnisher& f) {
  Dice& dice = f.dice();
  KitchenRun(f).build();
  if (f.area() > 9.5f) diningTable(f);
  if (dice.chance(.3f)) storage(f, {"shelf_unit", "dresser"});
  if (dice.chance(.3f)) {
    const std::optional<Item> stool = f.choose({"stool", "bar_stool"});
    if (stool) f.atWall(*stool, {0, .3f, .1f, 30});
  }
}

// --- bathroom, office
// ------------------------------------------------------------------------------

void bathroom(Furnisher& f) {
  Dice& dice = f.dice();
  const bool tub = f.area() > 4.5f && dice.chance(.65f);
  std::optional<Item> wash = f.choose({tub ? "bathtub" : "shower"}, {2.f, 2.f, 2.3f});
  if (!wash) wash = f.choose({"bathtub", "shower"}, {2.f, 2.f, 2.3f});
  if (wash) {
    // Along a wall, whichever way the model lies.
    f.groupAtWall(wash->size.x(), {.45f, 1.f, .005f, 80}, [&](const Place& at) {
      return std::vector<Put>{{*wash, at.at(0, wash->size.y() / 2)}};
    });
  }
  const auto fixture = [&](const Roles& roles, const Vector3f& most, float front) {
    const std::optional<Item> item = f.choose(roles, most);
    return item ? f.atWall(*item, {front, .2f, .005f, 80}) : -1;
  };
  fixture({"toilet"}, {.8f, .9f, 1.3f}, .45f);
  const int basin = fixture({"washbasin", "vanity"}, {f.area() > 6 ? 1.6f : .9f, .8f, 1.3f}, .5f);
  if (basin >= 0) {
    const float w = std::min(2 * f.blockOf(basin).half.x(), dice.real(.5f, 1.1f));
    f.onWallAbove(mirror(f, w, dice.real(.6f, .9f)), basin, 1.2f);
    dress(f, basin, {"bathroom_thing"}, 2, {.2f, .2f}, .3f);
  }
  if (f.area() > 5.5f && dice.chance(.4f)) fixture({"bidet"}, {.6f, .8f, .9f}, .4f);
  if (dice.chance(.5f)) {
    const int machine = fixture({"washing_machine"}, {.8f, .8f, 1.1f}, .4f);
    dress(f, machine, {"bathroom_thing", "floor_thing"}, 1, {.45f, .45f}, .4f);
  }
  if (dice.chance(.6f)) fixture({"towel_rack"}, {1.f, .4f, 1.8f}, .1f);
  for (int i = dice.integer(0, 3); i > 0; --i) {
    const std::optional<Item> thing = f.choose({"bathroom_thing"}, {.5f, .5f, .8f});
    if (!thing) break;
    if (thing->elevation_m > .1f)
      f.onWall(*thing, thing->elevation_m);
    else if (thing->size.z() > .2f)
      f.atWall(*thing, {0, .5f, .03f, 30});
  }
  if (dice.chance(.4f)) fixture({"stool", "dresser"}, {.7f, .5f, 1.f}, .1f);
  if (basin >= 0 && dice.chance(.6f))
    f.rug(f.placeOf(basin).at(0, f.blockOf(basin).half.y() + .35f), {.8f, .5f});
}

void office(Furnisher& f) {
  Dice& dice = f.dice();
  const std::optional<Item> item = f.choose({"desk"}, {2.f, 1.1f, 1.4f});
  const int count = 1 + int(f.area() / 8);
  for (int i = 0; item && i < count; ++i) {
    std::vector<int> pieces;
    if (i % 2 == 1 && f.area() > 16) {
      // Two people face to face.
      pieces = f.groupInRoom([&](const Place& at) {
        const float y = item->size.y() / 2 + .01f;
        return std::vector<Put>{{*item, at.at(0, y)}, {*item, at.at(0, -y).back()}};
      });
    } else {
      const int piece = f.atWall(*item, {.7f, .3f, .022f, 60});
      if (piece >= 0) pieces = {piece};
    }
    for (int piece : pieces) dressDesk(f, piece, .4f);
  }
  for (int i = dice.integer(1, 3); i > 0; --i) {
    const int piece = storage(f, {"office_cabinet", "bookcase", "shelf_unit"});
    if (piece >= 0 && f.itemOf(piece).size.z() < 1.4f && dice.chance(.5f))
      f.things(piece, {{"printer"}, 1, {.6f, .6f}, .5f, -1, 1, .1f});
  }
  const std::optional<Item> board = f.choose({"whiteboard"}, {2.f, .7f, 2.1f});
  if (board && dice.chance(.7f)) {
    board->size.z() > 1.5f ? f.atWall(*board) : f.onWall(*board, 1.5f - board->size.z() / 2);
  }
  if (f.area() > 22 && dice.chance(.6f)) diningTable(f);
  if (f.area() > 26 && dice.chance(.4f)) seating(f);
}

// --- the room
// --------------------------------------------------------------------------------------

struct Kind {
  const char* name;
  float weight, least_area, most_area;
  void (*furnish)(Furnisher&);
};
constexpr Kind kKinds[] = {
    {"bedroom", .25f, 10, 28, bedroom}, {"living", .25f, 14, 40, living},
    {"dining", .12f, 10, 32, dining},   {"study", .12f, 10, 30, study},
    {"kitchen", .1f, 8, 18, kitchen},   {"bathroom", .06f, 4.2f, 9, bathroom},
    {"office", .1f, 12, 40, office}};

const Kind& chooseKind(Dice& dice) {
  float at = dice.real(0, 1);
  for (const Kind& k : kKinds) {
    if (at < k.weight) return k;
    at -= k.weight;
  }
  return kKinds[0];
}

ShellPlan choosePlan(const Kind& kind, Dice& dice) {
  ShellPlan plan;
  plan.kind = kind.name;
  const float area = dice.real(kind.least_area, kind.most_area);
  const float aspect = dice.real(1.f, area < 6 ? 1.35f : 1.7f);
  const bool is_l = area > 14 && dice.chance(.33f);
  const float whole = is_l ? area * 1.18f : area;
  plan.width = std::sqrt(whole * aspect), plan.depth = whole / plan.width;
  plan.height = dice.real(2.35f, 3.1f);
  if (dice.chance(.5f)) std::swap(plan.width, plan.depth);
  if (is_l) plan.cut = {plan.width * dice.real(.33f, .45f), plan.depth * dice.real(.33f, .45f)};
  if (area > 9 && plan.kind != "kitchen" && dice.chance(.14f)) {
    plan.knee = dice.real(1.4f, 1.7f);
    const float reach = std::min(plan.width, plan.depth) * dice.real(.3f, .45f);
    plan.slope = (plan.height - plan.knee) / reach;
  }
  plan.is_evening = dice.chance(.15f);
  return plan;
}

/// In the middle, a second one in a long room or the other leg of an L; on where it is dark.
void ceilingLamps(Furnisher& f, const Room& room) {
  Dice& dice = f.dice();
  Eigen::AlignedBox2f box;
  for (const Vector2f& p : room.floor) box.extend(p);
  const bool is_dark = room.lights.empty() || f.shell().is_evening;
  const int wanted = f.area() > 22 || room.floor.size() > 4 ? 2 : 1;
  int lamps = f.ceilingLamp(box.center(), is_dark);
  for (int tries = 0; lamps < wanted && tries < 40; ++tries) {
    const Vector2f share{dice.real(.2f, .8f), dice.real(.2f, .8f)};
    lamps += f.ceilingLamp(box.min() + box.sizes().cwiseProduct(share), is_dark);
  }
}

void toWorld(Room& room, Dice& dice) {
  const float yaw = dice.real(0, 2 * float(M_PI));
  const Vector3f place{dice.real(-4.f, 4.f), dice.real(-4.f, 4.f), 0.f};
  room.world_from_room = Eigen::Translation3f(place) * Eigen::AngleAxisf(yaw, Vector3f::UnitZ());
  const Eigen::Matrix3f turn = room.world_from_room.linear();
  for (Vector3f& p : room.surface.mesh.vertices) p = room.world_from_room * p;
  for (auto& corners : room.surface.normal)
    for (Vector3f& n : corners) n = turn * n;
  for (RoomLight& light : room.lights) {
    light.centre = room.world_from_room * light.centre;
    light.half_u = turn * light.half_u, light.half_v = turn * light.half_v;
  }
  room.sun.towards = turn * room.sun.towards;
}

}  // namespace

Room makeRoom(const AssetLibrary& assets, uint64_t seed) {
  Dice dice(seed);
  const Kind& kind = chooseKind(dice);
  Room room;
  room.name = "rooms:" + std::to_string(seed);
  room.kind = kind.name;
  Shell shell = buildShell(assets, choosePlan(kind, dice), dice, &room);
  room.is_shell.assign(room.surface.mesh.triangles.size(), 1);
  Furnisher furnisher(assets, dice, seed < kFirstTrainingSeed, std::move(shell), &room);
  kind.furnish(furnisher);
  if (room.kind != "bathroom") {
    radiators(furnisher);
    plants(furnisher, furnisher.area() > 15 ? 3 : 2);
    floorThings(furnisher, furnisher.area() > 15 ? 4 : 2);
    onWalls(furnisher);
  }
  ceilingLamps(furnisher, room);
  room.is_shell.resize(room.surface.mesh.triangles.size(), 0);
  toWorld(room, dice);
  return room;
}

}  // namespace vdbc
