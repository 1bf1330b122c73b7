#include "examples/lab/packed_room.h"

#include <lzma.h>
#include <openvdb/tools/Prune.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>

#include "vdb/file_io.h"
#include "vdb/token_map.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Eigen::Vector3d;

constexpr int32_t kMagic = 0x33444256;  // "VBD3"
constexpr size_t kTokenBytes = 3 * sizeof(int16_t) + kPackedDim;
constexpr uint64_t kMaxFileBytes = 1 << 24, kMaxRoomBytes = 1 << 27;
constexpr uint64_t kMaxDecoderBytes = 1 << 27;  // twice what the strongest preset asks for
constexpr int kMaxRoomSide = 1024;              // nodes
constexpr const char* kEncoderFile = "encoder_hash";

// --- compressed files

size_t writeXz(const char* operation, const std::string& path, const std::vector<uint8_t>& bytes) {
  std::vector<uint8_t> packed(lzma_stream_buffer_bound(bytes.size()));
  size_t size = 0;
  require(lzma_easy_buffer_encode(9 | LZMA_PRESET_EXTREME, LZMA_CHECK_CRC64, nullptr, bytes.data(),
                                  bytes.size(), packed.data(), &size, packed.size()) == LZMA_OK,
          operation, ": ", path, ": cannot compress ", bytes.size(), " bytes");
  writeFile(operation, path, packed.data(), size);
  return size;
}

struct Decoder {
  lzma_stream stream = LZMA_STREAM_INIT;
  ~Decoder() { lzma_end(&stream); }
};

// Memory follows what comes out, not what the file says of itself.
std::vector<uint8_t> readXz(const char* operation, const std::string& path) {
  const std::vector<uint8_t> packed = readFile(operation, path, kMaxFileBytes);
  Decoder decoder;
  lzma_stream& s = decoder.stream;
  lzma_ret state = lzma_stream_decoder(&s, kMaxDecoderBytes, 0);
  s.next_in = packed.data(), s.avail_in = packed.size();
  std::vector<uint8_t> bytes;
  while (state == LZMA_OK) {
    require(bytes.size() < kMaxRoomBytes, operation, ": ", path, ": expected at most ",
            kMaxRoomBytes, " bytes when unpacked");
    const size_t begin = bytes.size();
    bytes.resize(begin + (1 << 20));
    s.next_out = bytes.data() + begin, s.avail_out = bytes.size() - begin;
    state = lzma_code(&s, LZMA_FINISH);
    bytes.resize(bytes.size() - s.avail_out);
  }
  require(state == LZMA_STREAM_END && s.avail_in == 0, operation, ": ", path,
          ": expected a whole .xz file, found ",
          state == LZMA_BUF_ERROR ? "one that ends early" : "other bytes");
  return bytes;
}

// --- bytes

class Writer {
 public:
  template <typename T>
  void put(const T& value) {
    const auto* p = reinterpret_cast<const uint8_t*>(&value);
    bytes.insert(bytes.end(), p, p + sizeof(T));
  }
  void putBox(const CoordBBox& box) {
    for (const Coord& corner : {box.min(), box.max()})
      for (int axis = 0; axis < 3; ++axis) put(int32_t(corner[axis]));
  }
  void putStates(const PackedStates& s) {
    putBox(s.box);
    put(int32_t(s.states.size()));
    bytes.insert(bytes.end(), s.states.begin(), s.states.end());
  }

  std::vector<uint8_t> bytes;
};

class Reader {
 public:
  Reader(const std::vector<uint8_t>& bytes, const char* operation, std::string path)
      : at_(bytes.data()), left_(bytes.size()), operation_(operation), path_(std::move(path)) {}

  template <typename... Parts>
  void expect(bool ok, const Parts&... parts) const {
    require(ok, operation_, ": ", path_, ": expected ", parts...);
  }
  size_t left() const { return left_; }
  template <typename T>
  T get() {
    T value;
    take(&value, sizeof(T));
    return value;
  }
  void take(void* to, size_t size) {
    expect(size <= left_, size, " more bytes, found ", left_);
    if (size > 0) std::memcpy(to, at_, size);
    at_ += size, left_ -= size;
  }
  // A number of things of `size` bytes each, all of which are there.
  size_t count(size_t size, const char* things) {
    const int32_t n = get<int32_t>();
    expect(n >= 0 && uint64_t(n) * size <= left_, "a number of ", things, " that ", left_,
           " bytes can hold, found ", n);
    return size_t(n);
  }
  CoordBBox box() {
    int32_t b[6];
    take(b, sizeof(b));
    for (int axis = 0; axis < 3; ++axis)
      expect(std::abs(int64_t(b[axis])) < std::numeric_limits<int16_t>::max() &&
                 b[3 + axis] >= b[axis] && int64_t(b[3 + axis]) - b[axis] < 4 * kMaxRoomSide,
             "a box of some voxels, found ", b[axis], " to ", b[3 + axis]);
    return {Coord(b[0], b[1], b[2]), Coord(b[3], b[4], b[5])};
  }
  // Of the box's nodes.
  PackedStates states(const CoordBBox& bounds, int level) {
    PackedStates s;
    s.box = box();
    expect(s.box == nodesIn(bounds, level), "the box of all nodes of level ", level, ", found ",
           s.box);
    const size_t n = count(1, "states");
    expect(n == s.box.volume(), s.box.volume(), " states, found ", n);
    s.states.resize(n);
    take(s.states.data(), n);
    expect(std::all_of(s.states.begin(), s.states.end(), [](uint8_t state) { return state <= 2; }),
           "states 0, 1 and 2");
    return s;
  }

 private:
  const uint8_t* at_;
  size_t left_;
  const char* operation_;
  const std::string path_;
};

// --- tokens

// Adds `sign` times the target's latents where it has the token too: a condition's are near them,
// and differences near 0 take less room.
void addTarget(const PackedTokens& target, int sign, PackedTokens* tokens) {
  TokenMap<size_t> row;
  for (size_t i = 0; i < target.ijk.size(); ++i) row.insert(target.ijk[i], i);
  const size_t n = tokens->ijk.size(), target_n = target.ijk.size();
  for (size_t i = 0; i < n; ++i) {
    const size_t* found = row.find(tokens->ijk[i]);
    if (!found) continue;
    for (size_t d = 0; d < kPackedDim; ++d) {
      int8_t& latent = tokens->latents[d * n + i];
      latent = int8_t(uint8_t(latent + sign * target.latents[d * target_n + *found]));
    }
  }
}

void putTokens(const PackedTokens& tokens, Writer* out) {
  out->put(int32_t(tokens.ijk.size()));
  for (int axis = 0; axis < 3; ++axis)
    for (const Coord& c : tokens.ijk) out->put(int16_t(c[axis]));
  for (const int8_t latent : tokens.latents) out->put(latent);
}

PackedTokens takeTokens(const CoordBBox& bounds, Reader* in) {
  PackedTokens t;
  const size_t n = in->count(kTokenBytes, "tokens");
  t.ijk.resize(n);
  for (int axis = 0; axis < 3; ++axis)
    for (Coord& c : t.ijk) c[axis] = in->get<int16_t>();
  const CoordBBox nodes = nodesIn(bounds, 1);
  for (const Coord& c : t.ijk) in->expect(nodes.isInside(c), "tokens in ", nodes, ", found ", c);
  t.latents.resize(kPackedDim * n);
  in->take(t.latents.data(), t.latents.size());
  return t;
}

// --- places

void putPlace(const PackedPlace& place, const PackedTokens* target, Writer* out) {
  out->putBox(place.bounds);
  out->put(int32_t(place.cameras.size()));
  for (const PackedCamera& camera : place.cameras) out->put(camera);
  PackedTokens tokens = place.tokens;
  if (target) addTarget(*target, -1, &tokens);
  putTokens(tokens, out);
  out->putStates(place.nodes);
  out->putStates(place.coarse);
}

PackedPlace takePlace(const PackedTokens* target, Reader* in) {
  PackedPlace place;
  place.bounds = in->box();
  place.cameras.resize(in->count(sizeof(PackedCamera), "cameras"));
  for (PackedCamera& camera : place.cameras) camera = in->get<PackedCamera>();
  place.tokens = takeTokens(place.bounds, in);
  if (target) addTarget(*target, 1, &place.tokens);
  place.nodes = in->states(place.bounds, 1);
  place.coarse = in->states(place.bounds, 2);
  return place;
}

PackedStates packStates(const SeenSpace& space) {
  PackedStates s;
  s.box = space.box;
  const StateLookup state(space);
  for (auto node = space.box.begin(); node; ++node) s.states.push_back(uint8_t(state(*node)));
  return s;
}

SeenSpace spaceOf(const PackedStates& s, int level) {
  SeenSpace space;
  space.level = level, space.box = s.box;
  openvdb::tree::ValueAccessor<TokenMask> filled(space.filled), empty(space.empty);
  size_t i = 0;
  for (auto node = s.box.begin(); node; ++node, ++i)
    if (const auto state = NodeState(s.states[i]); state == NodeState::kFilled)
      filled.setValueOn(*node);
    else if (state == NodeState::kEmpty)
      empty.setValueOn(*node);
  openvdb::tools::prune(space.empty);
  return space;
}

// The tokens alone, without what was seen.
Place placeOf(const PackedPlace& packed, float voxel_m) {
  Place place;
  place.frame.voxel_m = voxel_m, place.frame.bounds = packed.bounds;
  place.dim = kPackedDim, place.ijk = packed.tokens.ijk;
  const size_t n = place.ijk.size();
  place.z.resize(n * kPackedDim);
  for (size_t i = 0; i < n; ++i)
    for (size_t d = 0; d < kPackedDim; ++d)
      place.z[i * kPackedDim + d] = kPackedStep * float(packed.tokens.latents[d * n + i]);
  place.generated.assign(n, 0), place.probability.assign(n, 1.f), place.bfs_level.assign(n, 0);
  return place;
}

PackedCamera packCamera(const Camera& c, const VoxelFrame& frame) {
  PackedCamera packed;
  auto at = packed.begin();
  for (double share : {c.fx / c.width, c.fy / c.height, c.cx / c.width, c.cy / c.height})
    *at++ = float(share);
  const Eigen::Isometry3d grid_from_camera = frame.world_from_grid.inverse() * c.world_from_camera;
  const Vector3d eye = grid_from_camera.translation() / double(frame.voxel_m);
  at = std::copy_n(eye.cast<float>().eval().data(), 3, at);
  const Eigen::Matrix3f axes = grid_from_camera.linear().cast<float>();
  std::copy_n(axes.data(), 9, at);  // by columns
  return packed;
}

// Half of a room's samples are of two far views, the hardest case that is promised; the other half
// are of all other kinds, as often each.
constexpr int kSamplesOfPackedRoom = 10;
size_t conditionOf(const PackedRoom& room, uint64_t slot) {
  std::vector<size_t> two, others;
  for (size_t i = 0; i < room.conditions.size(); ++i)
    (room.conditions[i].kind < kTwoFarViewsKinds ? two : others).push_back(i);
  const bool of_two = others.empty() || (!two.empty() && slot % 2 == 0);
  const std::vector<size_t>& from = of_two ? two : others;
  return from[(slot / 2 + uint64_t(room.seed)) % from.size()];
}

std::string noteOf(const std::string& folder) { return folder + "/" + kEncoderFile; }

void requireEncoder(const char* operation, const std::string& folder,
                    const std::string& encoder_hash) {
  if (!fs::exists(noteOf(folder))) return;
  const std::vector<uint8_t> note = readFile(operation, noteOf(folder), 64);
  const std::string found(note.begin(), note.end());
  require(found == encoder_hash, operation, ": ", folder, ": expected rooms of the encoder ",
          encoder_hash, ", found ", found);
}

}  // namespace

PackedPlace packPlace(const std::vector<View>& views, const Place& place) {
  require(place.dim == kPackedDim, "packPlace: expected latents of ", kPackedDim,
          " channels, found ", place.dim);
  PackedPlace packed;
  packed.bounds = place.frame.bounds;
  for (const View& v : views) packed.cameras.push_back(packCamera(v.camera, place.frame));
  packed.tokens.ijk = place.ijk;
  const size_t n = place.ijk.size();
  packed.tokens.latents.resize(kPackedDim * n);
  for (size_t i = 0; i < n; ++i)
    for (size_t d = 0; d < kPackedDim; ++d)
      packed.tokens.latents[d * n + i] =
          int8_t(std::clamp(std::lround(place.z[i * kPackedDim + d] / kPackedStep), -127l, 127l));
  packed.nodes = packStates(poolSeen(*place.seen, 1));
  packed.coarse = packStates(poolSeen(*place.seen, 2));
  return packed;
}

size_t writePackedRoom(const PackedRoom& room, const std::string& path) {
  Writer out;
  out.put(kMagic);
  out.put(room.seed);
  out.put(room.voxel_m);
  putPlace(room.target, nullptr, &out);
  out.put(int32_t(room.conditions.size()));
  for (const PackedCondition& condition : room.conditions) {
    out.put(int32_t(condition.kind));
    putPlace(condition.place, &room.target.tokens, &out);
  }
  return writeXz("writePackedRoom", path, out.bytes);
}

PackedRoom readPackedRoom(const std::string& path) {
  const std::vector<uint8_t> bytes = readXz("readPackedRoom", path);
  Reader in(bytes, "readPackedRoom", path);
  PackedRoom room;
  in.expect(in.get<int32_t>() == kMagic, "a packed room, found another file");
  room.seed = in.get<int32_t>();
  room.voxel_m = in.get<float>();
  in.expect(room.voxel_m > 0 && room.voxel_m < 100, "a voxel edge in metres, found ", room.voxel_m);
  room.target = takePlace(nullptr, &in);
  const size_t conditions = in.count(sizeof(int32_t), "conditions");
  in.expect(conditions > 0, "a condition, found none");
  for (size_t i = 0; i < conditions; ++i) {
    PackedCondition condition;
    condition.kind = in.get<int32_t>();
    in.expect(condition.kind >= 0 && condition.kind < kConditionKinds, "a kind below ",
              kConditionKinds, ", found ", condition.kind);
    condition.place = takePlace(&room.target.tokens, &in);
    room.conditions.push_back(std::move(condition));
  }
  in.expect(in.left() == 0, "the end, found ", in.left(), " more bytes");
  return room;
}

void writeSurfaces(const std::vector<SurfaceNode>& surfaces, const std::string& path) {
  Writer out;
  for (const SurfaceNode& s : surfaces) {
    for (int axis = 0; axis < 3; ++axis) out.put(int16_t(s.node[axis]));
    out.put(int16_t(s.inside));
  }
  writeXz("writeSurfaces", path, out.bytes);
}

std::vector<SurfaceNode> readSurfaces(const std::string& path) {
  const std::vector<uint8_t> bytes = readXz("readSurfaces", path);
  constexpr size_t kBytes = 4 * sizeof(int16_t);
  Reader in(bytes, "readSurfaces", path);
  in.expect(bytes.size() % kBytes == 0, "whole nodes, found ", bytes.size(), " bytes");
  std::vector<SurfaceNode> surfaces(bytes.size() / kBytes);
  for (SurfaceNode& s : surfaces) {
    for (int axis = 0; axis < 3; ++axis) s.node[axis] = in.get<int16_t>();
    s.inside = in.get<int16_t>() != 0;
  }
  return surfaces;
}

void labelBySurfaces(const std::vector<SurfaceNode>& surfaces, PackedPlace* target) {
  TokenMask surface;
  openvdb::tree::ValueAccessor<TokenMask> mask(surface);
  for (const SurfaceNode& s : surfaces) mask.setValueOn(s.node);
  constexpr auto kUnobserved = uint8_t(NodeState::kUnobserved), kEmpty = uint8_t(NodeState::kEmpty);
  TokenMask unknown_parents;
  openvdb::tree::ValueAccessor<TokenMask> parents(unknown_parents);
  size_t i = 0;
  for (auto node = target->nodes.box.begin(); node; ++node, ++i) {
    uint8_t& state = target->nodes.states[i];
    if (state != kUnobserved) continue;
    if (mask.isValueOn(*node))
      parents.setValueOn(tokenCoord(*node, 1));
    else
      state = kEmpty;
  }
  i = 0;
  for (auto node = target->coarse.box.begin(); node; ++node, ++i)
    if (uint8_t& state = target->coarse.states[i];
        state == kUnobserved && !parents.isValueOn(*node))
      state = kEmpty;
}

CompletionSample sampleOf(const PackedRoom& room, size_t condition) {
  const PackedPlace& seen = room.conditions[condition].place;
  return {placeOf(seen, room.voxel_m),   placeOf(room.target, room.voxel_m),
          spaceOf(seen.nodes, 1),        spaceOf(seen.coarse, 2),
          spaceOf(room.target.nodes, 1), spaceOf(room.target.coarse, 2)};
}

PackedSamples packedSamples(const std::string& folder, const std::string& encoder_hash) {
  require(fs::is_directory(folder), "packedSamples: ", folder, ": expected a folder of rooms");
  requireEncoder("packedSamples", folder, encoder_hash);
  PackedSamples s;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder)) {
    const fs::path name = entry.path().filename();
    const std::string stem = name.stem().string();
    if (name.extension() == ".xz" && stem.size() < 10 &&
        std::all_of(stem.begin(), stem.end(), [](char c) { return c >= '0' && c <= '9'; }))
      s.seeds.push_back(std::stoull(stem));
  }
  require(!s.seeds.empty(), "packedSamples: ", folder, ": expected packed rooms, SEED.xz");
  std::sort(s.seeds.begin(), s.seeds.end());
  s.count = int64_t(s.seeds.size()) * kSamplesOfPackedRoom;
  s.source = [folder, seeds = s.seeds](uint64_t index) {
    const uint64_t seed = seeds[index % seeds.size()];
    PackedRoom room = readPackedRoom(packedPath(folder, seed));
    const std::string surfaces = surfacesPath(folder, seed);
    if (fs::exists(surfaces)) labelBySurfaces(readSurfaces(surfaces), &room.target);
    return sampleOf(room, conditionOf(room, index / seeds.size()));
  };
  return s;
}

void startPackedFolder(const std::string& folder, const std::string& encoder_hash) {
  std::error_code error;
  fs::create_directories(folder, error);
  require(!error, "pack: ", folder, ": cannot create the folder: ", error.message());
  requireEncoder("pack", folder, encoder_hash);
  writeFile("pack", noteOf(folder), encoder_hash.data(), encoder_hash.size());
}

std::string packedPath(const std::string& folder, uint64_t seed) {
  return joinText(folder, "/", seed, ".xz");
}
std::string surfacesPath(const std::string& folder, uint64_t seed) {
  return joinText(folder, "/", seed, ".surfaces.xz");
}

}  // namespace vdbc
