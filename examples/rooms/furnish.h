#pragma once
// Private to the room generator: chooses models and puts them where they fit.
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "examples/rooms/shell.h"

namespace vdbc {

/// Something to put into a room: a catalogue model, scaled, mirrored and tinted, or a shape of our
/// own in the same frame (footprint's middle at the origin, lowest point at z = 0).
struct Item {
  std::string model;  // catalogue id; "" of our own
  std::string role;
  std::shared_ptr<const SurfaceMesh> mesh;
  Eigen::Vector3f scale = Eigen::Vector3f::Ones();  // x < 0: mirrored
  Eigen::Vector3f size = Eigen::Vector3f::Zero();   // as it stands
  Eigen::Vector3f tint = Eigen::Vector3f::Ones();
  float top_m = 0, elevation_m = 0;  // as ModelInfo, scaled
  std::vector<ModelLight> lights;    // model frame, unscaled

  /// Stretches it to `size`.
  Item resized(const Eigen::Vector3f& size) const;
  Block block(const Place& at, float z) const { return {at, size.head<2>() / 2, z, z + size.z()}; }
};

struct Put {
  Item item;
  Place at;
  float z = 0;
  bool is_optional = false;  // of a group: left out where it does not fit
};

/// How a piece stands among others.
struct WallRules {
  float front = .5f;          // metres kept free before it
  float corner_share = .35f;  // how often it is pushed into a corner
  float gap = .022f;          // to the wall: room for the skirting
  int tries = 150;
};

/// Smaller things that stand on a piece.
struct ThingRules {
  std::vector<std::string> roles;
  int count = 1;
  Eigen::Vector2f largest{.4f, .4f};
  float tallest = .5f;
  float back_share = -1, front_share = 1;  // range of the piece's depth, -1 back, 1 front
  float yaw_jitter = 3.15f;                // radians about the piece's own front
};

class Furnisher {
 public:
  /// Models are the held-out ones, or the others. `room` has its shell; room frame.
  Furnisher(const AssetLibrary& assets, Dice& dice, bool held_out, Shell shell, Room* room);

  const Shell& shell() const { return shell_; }
  Dice& dice() { return dice_; }
  float area() const { return area_; }
  bool lampsOn() { return shell_.is_evening || dice_.chance(lamp_share_); }

  /// A model of one of the roles that is not larger than `most`; nothing if there is none.
  std::optional<Item> choose(const std::vector<std::string>& roles,
                             const Eigen::Vector3f& most = Eigen::Vector3f::Constant(INFINITY));
  /// An item of our own, drawn by `draw` about the origin.
  Item make(const std::string& role, const std::function<void(Shaper&)>& draw);

  /// Whether a block would stand free, in the room, not in a door's way and not before a window;
  /// `support` (a piece's index) may touch it, and it may stand in the space kept before others.
  bool fits(const Block& block, int support = -1) const;
  /// Puts a piece unasked; its index in the room's pieces.
  int put(const Put& put);
  /// Puts all, or nothing where one that is not optional does not fit or the way is blocked. Items
  /// of one group are not checked against each other unless optional. The pieces' indices by put,
  /// -1 of those left out; empty if nothing was put.
  std::vector<int> tryGroup(const std::vector<Put>& puts, float front = 0);

  /// `layout` gives a group for a place at a wall (x along it, y into the room); tries places that
  /// are `width` wide.
  std::vector<int> groupAtWall(float width, const WallRules& rules,
                               const std::function<std::vector<Put>(const Place&)>& layout);
  std::vector<int> groupInRoom(const std::function<std::vector<Put>(const Place&)>& layout,
                               int tries = 40);
  /// The piece's index, or -1.
  int atWall(const Item& item, const WallRules& rules = {});
  int inRoom(const Item& item, float yaw_jitter = 3.15f);
  /// On a wall, its foot at a height; -1 if there is no place.
  int onWall(const Item& item, float foot);
  /// On the wall at which a piece stands.
  int onWallAbove(const Item& item, int piece, float foot);

  /// A chair at each of `places` (facing the table's middle), pushed in as far as nothing touches.
  std::vector<int> chairsAt(int table, const Item& chair, const std::vector<Place>& places,
                            float jitter);
  /// Puts things on a piece, where rays find its top level under the whole of them.
  std::vector<int> things(int piece, const ThingRules& rules);
  /// Puts `item` on the top of a piece at exactly this place; -1 where the middle `foot` share of
  /// its footprint is not on level ground.
  int thingAt(int piece, const Item& item, const Place& at, float foot = 1);
  /// Rows of books and a few things on the boards of an open shelf.
  void fillShelf(int piece, float share);
  /// A rug under what stands there.
  void rug(const Place& at, const Eigen::Vector2f& size);
  /// Lights a lamp that was put.
  void light(int piece, float strength);
  /// A lamp under the flat part of the ceiling; false where there is no place for it.
  bool ceilingLamp(const Eigen::Vector2f& at, bool must_shine = false);

  bool has(const std::string& model) const;
  Place placeOf(int piece) const { return standing_[size_t(piece)].block.at; }
  const Block& blockOf(int piece) const { return standing_[size_t(piece)].block; }
  const Item& itemOf(int piece) const { return standing_[size_t(piece)].item; }
  /// Share of the floor that someone of .25 m radius who comes from the door can walk over, if
  /// `more` were there too.
  float walkableShare(const std::vector<Block>& more = {}) const;

 private:
  struct Standing {
    Item item;
    Block block;
    bool is_flat;           // rugs: nothing bumps into them
    size_t first_triangle;  // of the room's surface
  };
  bool inside(const Block& block) const;
  TriangleMesh meshOf(int piece) const;

  const AssetLibrary& assets_;
  Dice& dice_;
  bool held_out_;
  Shell shell_;
  Room& room_;
  float area_ = 0, lamp_share_ = .6f, least_walkable_ = .4f;
  std::vector<Standing> standing_;  // parallel to the room's pieces
  std::vector<Block> windows_, zones_;
  std::vector<Finish> book_colours_;
};

}  // namespace vdbc
