#include "houdini_style_tools/checkpoint.h"

#include <nlohmann/json.hpp>
#include <type_traits>

#include "houdini_style_tools/options.h"
#include "vdb/file_io.h"
#include "vdb/latent_vdb.h"

namespace vdbc {

using nlohmann::json;

namespace {
constexpr const char* kNextLevel = "next_level";

template <typename T>
void appendBytes(const std::vector<T>& values, std::string* bytes) {
  static_assert(std::is_standard_layout_v<T>, "expected plain numbers");
  bytes->append(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
}

std::string hashOf(const Place& place) {
  std::string bytes;
  appendBytes(std::vector<Coord>{place.frame.bounds.min(), place.frame.bounds.max()}, &bytes);
  // Grids start at their volume: where in the world that is, no coordinate of a token tells.
  const Eigen::Matrix4d& world_from_grid = place.frame.world_from_grid.matrix();
  appendBytes(std::vector<double>(world_from_grid.data(), world_from_grid.data() + 16), &bytes);
  forEachColumn([&](const auto& c) { appendBytes(c.values, &bytes); }, place);
  return hexOf(fnv1a(bytes.data(), bytes.size()));
}

std::string hashOf(const TokenMask& mask) {
  std::string bytes;
  appendBytes(activeCoords(mask), &bytes);
  return hexOf(fnv1a(bytes.data(), bytes.size()));
}
}  // namespace

std::string completionIdentity(const Completer& completer, const Place& start,
                               const CompleteSettings& s) {
  CompleteSettings same = s;
  json identity{{"completer", completer.hash()},
                {"config", completer.config().toJson()},
                {"start", hashOf(start)},
                {"region", s.region ? hashOf(*s.region) : ""}};
  for (const Option& o : identityOptions(&same)) identity[o.name()] = o.text();
  return identity.dump();
}

void writeCheckpoint(const Place& so_far, int32_t next_level, const std::string& identity,
                     const std::string& path) {
  json growth = json::parse(identity);
  growth[kNextLevel] = next_level;
  Place place = so_far;
  place.growth = growth.dump();
  writeLatentVdb(place, path);
}

void readCheckpoint(const std::string& path, const std::string& identity, Place* start,
                    CompleteSettings* settings) {
  Place place = readLatentVdb(path);
  json growth = json::parse(place.growth, nullptr, false);
  require(
      growth.is_object() && growth.contains(kNextLevel) && growth[kNextLevel].is_number_integer(),
      path, ": expected a completion that was cut short, found another latent file");
  const int32_t next_level = growth[kNextLevel];
  growth.erase(kNextLevel);
  require(growth.dump() == identity && place.encoder_hash == start->encoder_hash, path,
          ": is of another place, settings or weights (expected ", identity, ", found ",
          growth.dump(), ")");
  place.growth.clear();
  place.detail = start->detail, place.cameras = start->cameras;  // not of the file
  settings->first_level = next_level, settings->begun_with = start->size();
  *start = std::move(place);
}

}  // namespace vdbc
