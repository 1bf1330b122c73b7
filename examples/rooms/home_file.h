#pragma once
// Private to homes: what a home's file says. Metres, world x and y, angles counter-clockwise.
#include <Eigen/Core>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "examples/rooms/assets.h"

namespace vdbc {

struct Home {
  using Outline = std::vector<Eigen::Vector2d>;

  struct Finish {
    Eigen::Vector3f colour = Eigen::Vector3f::Constant(.7f);
    int texture = -1;  // of AssetLibrary::textures()
    double angle = 0;  // of the texture
  };

  struct Baseboard {
    double thickness = 0, height = 0;
    Finish finish;
  };

  struct Side {
    Finish finish;
    Baseboard baseboard;
  };

  struct Wall {
    std::string id, at_start, at_end;  // neighbours' ids
    int level = 0;
    Eigen::Vector2d start, end;
    double thickness = 0, height = 0, height_at_end = 0;
    double arc = 0;  // counter-clockwise turn from start to end, radians
    Side left, right;
  };

  struct Space {
    std::string name;
    int level = 0;
    Outline outline;  // counter-clockwise
    bool floor_visible = true, ceiling_visible = true;
    Finish floor, ceiling;
  };

  /// A piece of furniture, a lamp, a door or a window.
  struct Item {
    std::string name;
    size_t model = 0;  // of AssetLibrary::models()
    int level = 0;
    Eigen::Vector2d place;
    double elevation = 0, angle = 0, pitch = 0, roll = 0;
    Eigen::Vector3d size;  // width, depth, height of the unturned model
    double height_in_plan = 0;
    bool mirrored = false;
    std::optional<Eigen::Vector3f> colour;
    std::map<std::string, Eigen::Vector3f> material_colours;
    double power = 0;  // of a lamp
    bool is_opening = false;
    std::string cut_shape;                         // SVG path in a unit square, y down
    double wall_distance = 0, wall_thickness = 1;  // shares of the depth, from the back
  };

  struct Level {
    std::string id;
    double elevation = 0, height = 0, floor_thickness = 0;
  };

  std::string name;
  std::vector<Level> levels;
  std::vector<Wall> walls;
  std::vector<Space> spaces;
  std::vector<Item> items;
};

/// The homes that come with Sweet Home 3D, by name. Throw Error.
std::vector<std::string> exampleHomes(const AssetLibrary& assets);
Home exampleHome(const AssetLibrary& assets, const std::string& name);
/// The home of a .sh3d file. Throws Error.
Home readHomeFile(const AssetLibrary& assets, const std::string& path);

}  // namespace vdbc
