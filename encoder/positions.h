#pragma once
// How networks are told where a token is.
namespace vdbc {

/// Saved with the weights of both networks.
struct PositionConfig {
  float extent_m =
      12.8f;  // the position code is made for places so wide; larger ones go beyond +-.5
  float rotary_highest = 1.5f, rotary_lowest = .094f;  // radians a token, of 3-D rotary positions

  template <typename Config, typename Visit>
  static void fields(Config& c, Visit&& visit) {
    visit("extent_m", c.extent_m);
    visit("rotary_highest", c.rotary_highest), visit("rotary_lowest", c.rotary_lowest);
  }
};

}  // namespace vdbc
