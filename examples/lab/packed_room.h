#pragma once
// Rooms packed for the completer's training: what many views of a room see and what some of them
// see of it, as tokens whose latents take a byte a channel. One compressed file a room.
//
// SEED.xz holds, little-endian: int32 magic "VBD3", int32 seed, float32 voxel edge (metres), box of
// the frame, cameras, tokens, states of levels 1 and 2 of the target, int32 number of conditions;
// and of each condition: int32 kind, box, cameras, tokens, states of levels 1 and 2. Of these
//   box      int32 lowest x y z, highest x y z, inclusive
//   cameras  int32 n, n PackedCamera
//   tokens   int32 n, int16 x of all, y of all, z of all, int8 latents, channel by channel; where
//            the target has the token too, a condition's differ from its by so much (modulo 256)
//   states   box in nodes of the level, int32 n, n bytes: NodeState, x slowest
// SEED.surfaces.xz beside it holds int16 x, y, z, flag of every SurfaceNode.
#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "mar/completer_train.h"
#include "splat/view.h"

namespace vdbc {

constexpr int kPackedDim = 64;        // latent channels
constexpr float kPackedStep = .25f;   // of a latent, which has deviation 1
constexpr int kConditionKinds = 7;    // conditionViews() says what they are
constexpr int kTwoFarViewsKinds = 2;  // the first of them

/// Focal lengths x and y and principal point as shares of the picture's width and height; place in
/// the frame, voxels; the axes x (right), y (down) and z (forward) there.
using PackedCamera = std::array<float, 16>;

struct PackedTokens {
  std::vector<Coord> ijk;       // [N] level 1
  std::vector<int8_t> latents;  // [kPackedDim, N] in steps of kPackedStep
};

struct PackedStates {
  CoordBBox box;                // nodes, inclusive
  std::vector<uint8_t> states;  // NodeState of every node, x slowest
};

/// What some views of a room see.
struct PackedPlace {
  CoordBBox bounds;  // voxels of the room's frame, inclusive
  std::vector<PackedCamera> cameras;
  PackedTokens tokens;
  PackedStates nodes, coarse;  // levels 1 and 2
};

struct PackedCondition {
  int kind = 0;  // below kConditionKinds
  PackedPlace place;
};

struct PackedRoom {
  int32_t seed = 0;
  float voxel_m = .1f;
  PackedPlace target;
  std::vector<PackedCondition> conditions;
};

/// The encoded place of these views; its frame has to be the room's but for the bounds.
PackedPlace packPlace(const std::vector<View>& views, const Place& place);

/// Temporary name, then rename; the same bytes for the same room. Returns the file's bytes. Throw
/// Error.
size_t writePackedRoom(const PackedRoom& room, const std::string& path);
PackedRoom readPackedRoom(const std::string& path);

/// A node of level 1 through which a surface of the room's mesh passes.
struct SurfaceNode {
  Coord node;
  bool inside = false;  // its centre is over the room's floor and below its ceilings
};
void writeSurfaces(const std::vector<SurfaceNode>& surfaces, const std::string& path);
std::vector<SurfaceNode> readSurfaces(const std::string& path);
/// What no view saw and no surface passes is empty: air, the inside of things, outside.
void labelBySurfaces(const std::vector<SurfaceNode>& surfaces, PackedPlace* target);

/// One of the room's conditions with its target, as training takes it.
CompletionSample sampleOf(const PackedRoom& room, size_t condition);

/// The packed rooms of a folder as samples of the completer's training, labelled by surfaces where
/// these are known.
struct PackedSamples {
  std::vector<uint64_t> seeds;  // sorted
  SampleSource source;          // reads the room's file each time
  int64_t count = 0;            // several a room, half of them of two far views
};
/// Throws Error where the folder has no rooms or says that they are another encoder's.
PackedSamples packedSamples(const std::string& folder, const std::string& encoder_hash);

/// Makes the folder and notes the encoder in it, whose latents its rooms will hold. Throws Error
/// where another one is noted.
void startPackedFolder(const std::string& folder, const std::string& encoder_hash);
std::string packedPath(const std::string& folder, uint64_t seed);
std::string surfacesPath(const std::string& folder, uint64_t seed);

}  // namespace vdbc
