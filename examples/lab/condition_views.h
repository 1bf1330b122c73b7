#pragma once
// What a completer's training shows of a room: far views, neighbouring ones of a camera in a hand,
// parts of views, with and without a depth sensor's faults.
#include <random>
#include <vector>

#include "examples/rooms/rooms.h"
#include "splat/view.h"

namespace vdbc {

constexpr int kHandViews = 3;

/// kHandViews neighbouring pictures as a person takes them who turns with a camera in the hand:
/// places within .4 m, yaw within 35 degrees, pitch from 30 degrees down to 6 up; fewer where the
/// room has no place for them. `samples` a pixel.
std::vector<View> handHeldViews(const Room& room, const RoomRenderer& renderer, int side,
                                int samples, uint64_t seed, std::mt19937_64& random);

/// The view through a lens `zoom` times as long, pointed anywhere in the old picture; as many
/// pixels.
View cropped(const View& view, double zoom, std::mt19937_64& random);

/// What a depth camera does to a view: depth ends between 2.5 and 7 m and begins between .3 and
/// .6 m, has up to 13 holes and noise along the axis (Nguyen et al. 2012, times .3 to 1.5); colour
/// has a gain, a tint and noise; the pose is off by about 5 mm and a quarter of a degree.
void addSensorFaults(View* view, std::mt19937_64& random);

/// The views of a condition: kinds 0 and 1 are two far views, 2 is one, cropped half of the time, 3
/// three to six, 4 the hand-held ones, 5 two of these and a crop, 6 one to three crops; 4 to 6 with
/// a sensor's faults.
std::vector<View> conditionViews(int kind, const std::vector<View>& far,
                                 const std::vector<View>& hand, std::mt19937_64& random);

/// The part of the frame's bounds that a completion of these views alone would take as its volume
/// (fitVolume): whole coarse nodes; empty where the views see too little.
CoordBBox boundsOf(const std::vector<View>& views, const VoxelFrame& frame);

}  // namespace vdbc
