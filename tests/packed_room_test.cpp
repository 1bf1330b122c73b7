// Laws of packed rooms (docs/method.md, section 5.1).
#include "examples/lab/packed_room.h"

#include <gtest/gtest.h>
#include <lzma.h>

#include <cmath>
#include <cstring>
#include <map>
#include <memory>
#include <random>

#include "tests/files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

constexpr size_t kBoundsAt = 12, kCamerasAt = kBoundsAt + 24;  // of the target, in the bytes

/// Voxels of the bounds seen at random, and a latent for every token.
Place somePlace(const CoordBBox& bounds, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> latent;
  Place place;
  place.frame.bounds = bounds, place.dim = kPackedDim;
  const auto seen = std::make_shared<SeenSpace>();
  seen->box = bounds;
  for (auto voxel = bounds.begin(); voxel; ++voxel) {
    const Coord& c = *voxel;
    const bool empty_block = (c.x() >> 2) % 3 == 0;
    if (!empty_block && random() % 16 == 0)
      seen->filled.setValueOn(c);
    else if (empty_block || random() % 2 == 0)
      seen->empty.setValueOn(c);
  }
  place.seen = seen;
  place.ijk = filledNodes(poolSeen(*seen, 1));
  for (size_t i = 0; i < place.ijk.size() * kPackedDim; ++i) place.z.push_back(latent(random));
  return place;
}

View someView() {
  View view;
  view.camera.width = 40, view.camera.height = 20;
  view.camera.fx = 30, view.camera.fy = 25, view.camera.cx = 21, view.camera.cy = 9;
  view.camera.world_from_camera = lookAt({1, 2, 1.5}, {0, 0, 1}, Eigen::Vector3d::UnitZ());
  return view;
}

const CoordBBox kBounds(Coord(0), Coord(23, 15, 11)), kPart(Coord(4, 0, 0), Coord(15, 11, 7));

PackedRoom someRoom() {
  PackedRoom room;
  room.seed = 1000017;
  room.target = packPlace({someView(), someView()}, somePlace(kBounds, 1));
  for (int kind : {0, 1, 3, 4, 6})
    room.conditions.push_back({kind, packPlace({someView()}, somePlace(kind == 1 ? kBounds : kPart,
                                                                       2 + unsigned(kind)))});
  return room;
}

class PackedRoomFile : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_ / name; }

 private:
  TemporaryFolder folder_;
};

void expectEqual(const PackedPlace& a, const PackedPlace& b) {
  EXPECT_EQ(a.bounds, b.bounds);
  EXPECT_EQ(a.cameras, b.cameras);
  EXPECT_EQ(a.tokens.ijk, b.tokens.ijk);
  EXPECT_EQ(a.tokens.latents, b.tokens.latents);
  for (const auto& [x, y] : {std::pair(&a.nodes, &b.nodes), std::pair(&a.coarse, &b.coarse)}) {
    EXPECT_EQ(x->box, y->box);
    EXPECT_EQ(x->states, y->states);
  }
}

TEST_F(PackedRoomFile, HoldsWhatWasWritten) {
  const PackedRoom room = someRoom();
  const size_t bytes = writePackedRoom(room, path("room.xz"));
  EXPECT_EQ(bytes, std::filesystem::file_size(path("room.xz")));
  const PackedRoom read = readPackedRoom(path("room.xz"));
  EXPECT_EQ(read.seed, room.seed);
  EXPECT_EQ(read.voxel_m, room.voxel_m);
  expectEqual(read.target, room.target);
  ASSERT_EQ(read.conditions.size(), room.conditions.size());
  for (size_t i = 0; i < room.conditions.size(); ++i) {
    EXPECT_EQ(read.conditions[i].kind, room.conditions[i].kind);
    expectEqual(read.conditions[i].place, room.conditions[i].place);
  }
}

TEST_F(PackedRoomFile, SamplesArePlacesToHalfAStep) {
  const Place target = somePlace(kBounds, 1), condition = somePlace(kPart, 2);
  PackedRoom room;
  room.target = packPlace({someView()}, target);
  room.conditions.push_back({0, packPlace({someView()}, condition)});
  writePackedRoom(room, path("room.xz"));
  const CompletionSample s = sampleOf(readPackedRoom(path("room.xz")), 0);
  for (const auto& [found, expected] :
       {std::pair(&s.target, &target), std::pair(&s.condition, &condition)}) {
    EXPECT_EQ(found->frame.bounds, expected->frame.bounds);
    EXPECT_EQ(found->frame.voxel_m, expected->frame.voxel_m);
    EXPECT_EQ(found->ijk, expected->ijk);
    EXPECT_EQ(found->generated, std::vector<uint8_t>(found->ijk.size(), 0));
    ASSERT_EQ(found->z.size(), expected->z.size());
    for (size_t i = 0; i < found->z.size(); ++i)
      ASSERT_NEAR(found->z[i], expected->z[i], kPackedStep / 2 + 1e-6f);
  }
  for (const auto& [found, place, level] :
       {std::tuple(&s.target_nodes, &target, 1), std::tuple(&s.target_coarse, &target, 2),
        std::tuple(&s.seen_nodes, &condition, 1), std::tuple(&s.seen_coarse, &condition, 2)}) {
    const SeenSpace expected = poolSeen(*place->seen, level);
    EXPECT_EQ(found->level, level);
    EXPECT_EQ(found->box, expected.box);
    EXPECT_EQ(filledNodes(*found), filledNodes(expected));
    EXPECT_EQ(emptyNodes(*found), emptyNodes(expected));
  }
}

TEST_F(PackedRoomFile, CamerasAreInTheFrame) {
  Place place = somePlace(kBounds, 1);
  place.frame.world_from_grid =
      Eigen::Translation3d(3, -1, .5) * Eigen::AngleAxisd(.4, Eigen::Vector3d::UnitZ());
  const Camera camera = someView().camera;
  const PackedCamera c = packPlace({someView()}, place).cameras.at(0);
  const std::array<float, 4> shares = {30 / 40.f, 25 / 20.f, 21 / 40.f, 9 / 20.f};
  for (size_t i = 0; i < 4; ++i) EXPECT_EQ(c[i], shares[i]);
  // A point of the picture is where these numbers say.
  const Eigen::Vector3d eye(c[4], c[5], c[6]), x(c[7], c[8], c[9]), y(c[10], c[11], c[12]),
      z(c[13], c[14], c[15]);
  const Eigen::Vector3d at = (x * (5 - 21) / 30. + y * (7 - 9) / 25. + z) * 2.5;
  EXPECT_LT(
      (eye + at / double(place.frame.voxel_m) - place.frame.toIndex(camera.unproject(5, 7, 2.5)))
          .norm(),
      1e-4);
}

TEST_F(PackedRoomFile, TheSameRoomGivesTheSameBytes) {
  writePackedRoom(someRoom(), path("a.xz")), writePackedRoom(someRoom(), path("b.xz"));
  EXPECT_TRUE(bytesOf(path("a.xz")) == bytesOf(path("b.xz")));
}

TEST_F(PackedRoomFile, OtherChannelsAreRefused) {
  Place place = somePlace(kPart, 1);
  place.dim = kPackedDim / 2;
  EXPECT_THROW(packPlace({}, place), Error);
}

// --- bad files

std::string unpacked(const std::string& xz) {
  uint64_t memory = 1 << 28;
  std::string bytes(1 << 22, 0);
  size_t in = 0, out = 0;
  EXPECT_EQ(lzma_stream_buffer_decode(&memory, 0, nullptr,
                                      reinterpret_cast<const uint8_t*>(xz.data()), &in, xz.size(),
                                      reinterpret_cast<uint8_t*>(bytes.data()), &out, bytes.size()),
            LZMA_OK);
  return bytes.substr(0, out);
}

std::string packed(const std::string& bytes) {
  std::string xz(lzma_stream_buffer_bound(bytes.size()), 0);
  size_t size = 0;
  EXPECT_EQ(lzma_easy_buffer_encode(0, LZMA_CHECK_CRC64, nullptr,
                                    reinterpret_cast<const uint8_t*>(bytes.data()), bytes.size(),
                                    reinterpret_cast<uint8_t*>(xz.data()), &size, xz.size()),
            LZMA_OK);
  return xz.substr(0, size);
}

TEST_F(PackedRoomFile, EveryTruncationThrows) {
  writePackedRoom(someRoom(), path("room.xz"));
  const std::string xz = bytesOf(path("room.xz")), bytes = unpacked(xz);
  for (size_t n = 0; n < xz.size(); n += 101) {
    writeBytes(path("bad.xz"), xz.substr(0, n));
    EXPECT_THROW(readPackedRoom(path("bad.xz")), Error) << n;
  }
  for (size_t n = 0; n < bytes.size(); n += 1009) {
    writeBytes(path("bad.xz"), packed(bytes.substr(0, n)));
    EXPECT_THROW(readPackedRoom(path("bad.xz")), Error) << n;
  }
  writeBytes(path("bad.xz"), packed(bytes + "x"));
  EXPECT_THROW(readPackedRoom(path("bad.xz")), Error);
  writeBytes(path("bad.xz"), xz + "x");
  EXPECT_THROW(readPackedRoom(path("bad.xz")), Error);
  EXPECT_THROW(readPackedRoom(path("none.xz")), Error);
}

TEST_F(PackedRoomFile, FlippedBytesThrow) {
  writePackedRoom(someRoom(), path("room.xz"));
  const std::string xz = bytesOf(path("room.xz"));
  for (size_t n = 12; n < xz.size(); n += 211) {
    std::string bad = xz;
    bad[n] = char(bad[n] ^ 0x10);
    writeBytes(path("bad.xz"), bad);
    EXPECT_THROW(readPackedRoom(path("bad.xz")), Error) << n;
  }
}

TEST_F(PackedRoomFile, LiesThrowBeforeMemoryIsTaken) {
  const PackedRoom room = someRoom();
  writePackedRoom(room, path("room.xz"));
  const std::string bytes = unpacked(bytesOf(path("room.xz")));
  const auto rejected = [&](size_t at, int32_t value, const char* what) {
    std::string bad = bytes;
    std::memcpy(&bad[at], &value, sizeof(value));
    writeBytes(path("bad.xz"), packed(bad));
    EXPECT_THROW(readPackedRoom(path("bad.xz")), Error) << what << " " << value;
  };
  rejected(0, 0x32444256, "magic");
  for (int32_t n : {-1, 1 << 20, INT32_MAX, INT32_MIN}) {
    rejected(kBoundsAt, n, "bounds");
    rejected(kBoundsAt + 12, n, "bounds");
    rejected(kCamerasAt, n, "cameras");
    const size_t tokens_at = kCamerasAt + 4 + 2 * sizeof(PackedCamera);
    rejected(tokens_at, n, "tokens");
    const size_t states_at = tokens_at + 4 + room.target.tokens.ijk.size() * (6 + kPackedDim);
    rejected(states_at, n, "box of states");
    rejected(states_at + 24, n, "states");
  }
}

TEST_F(PackedRoomFile, ContradictionsThrow) {
  const auto rejected = [&](const char* what, const auto& change) {
    PackedRoom room = someRoom();
    change(&room);
    writePackedRoom(room, path("bad.xz"));
    EXPECT_THROW(readPackedRoom(path("bad.xz")), Error) << what;
  };
  rejected("kind", [](PackedRoom* r) { r->conditions[0].kind = kConditionKinds; });
  rejected("kind", [](PackedRoom* r) { r->conditions[0].kind = -1; });
  rejected("no condition", [](PackedRoom* r) { r->conditions.clear(); });
  rejected("voxel", [](PackedRoom* r) { r->voxel_m = 0; });
  rejected("voxel", [](PackedRoom* r) { r->voxel_m = NAN; });
  rejected("state", [](PackedRoom* r) { r->target.nodes.states[7] = 3; });
  rejected("states", [](PackedRoom* r) { r->target.coarse.states.pop_back(); });
  rejected("box", [](PackedRoom* r) { r->conditions[0].place.nodes.box.max().x() += 1; });
  rejected("box", [](PackedRoom* r) { r->target.bounds.min().x() = 9999; });
  rejected("token", [](PackedRoom* r) { r->target.tokens.ijk[3].x() = 12; });
}

// --- surfaces

TEST_F(PackedRoomFile, SurfacesAreReadAsWritten) {
  const std::vector<SurfaceNode> surfaces = {{Coord(1, 2, 3), true}, {Coord(-4, 0, 7), false}};
  writeSurfaces(surfaces, path("a.xz"));
  const std::vector<SurfaceNode> read = readSurfaces(path("a.xz"));
  ASSERT_EQ(read.size(), 2u);
  for (size_t i = 0; i < 2; ++i) {
    EXPECT_EQ(read[i].node, surfaces[i].node);
    EXPECT_EQ(read[i].inside, surfaces[i].inside);
  }
  writeBytes(path("b.xz"), packed(unpacked(bytesOf(path("a.xz"))).substr(0, 15)));
  EXPECT_THROW(readSurfaces(path("b.xz")), Error);
}

TEST_F(PackedRoomFile, WhatNoSurfacePassesIsEmpty) {  // section 5.2
  const PackedRoom room = someRoom();
  std::vector<SurfaceNode> surfaces;
  for (auto node = room.target.nodes.box.begin(); node; ++node)
    if ((*node).x() > 6 && (*node).z() % 2) surfaces.push_back({*node, true});
  surfaces.push_back({Coord(99, 0, 0), true});  // of no matter here
  PackedPlace labelled = room.target;
  labelBySurfaces(surfaces, &labelled);
  PackedRoom after = room;
  after.target = labelled;
  const CompletionSample before = sampleOf(room, 0), s = sampleOf(after, 0);
  int unknown = 0, turned = 0;
  for (auto n = s.target_nodes.box.begin(); n; ++n) {
    const NodeState was = before.target_nodes.at(*n);
    const bool surface = (*n).x() > 6 && (*n).z() % 2;
    EXPECT_EQ(s.target_nodes.at(*n),
              was != NodeState::kUnobserved || surface ? was : NodeState::kEmpty);
    unknown += was == NodeState::kUnobserved && surface;
    turned += was == NodeState::kUnobserved && !surface;
  }
  EXPECT_GT(unknown, 0);
  EXPECT_GT(turned, 0);
  for (auto n = s.target_coarse.box.begin(); n; ++n) {
    bool has_unknown = false;
    for (int slot = 0; slot < 8; ++slot)
      has_unknown |= s.target_nodes.at(childCoord(*n, slot)) == NodeState::kUnobserved;
    const NodeState was = before.target_coarse.at(*n);
    EXPECT_EQ(s.target_coarse.at(*n),
              was != NodeState::kUnobserved || has_unknown ? was : NodeState::kEmpty);
  }
}

// --- folders

TEST_F(PackedRoomFile, AFolderGivesEveryConditionAndTwoFarViewsHalfOfTheTime) {
  startPackedFolder(path("rooms"), "0123456789abcdef");
  PackedRoom room = someRoom();
  for (const int seed : {1000017, 1000003}) {
    room.seed = seed;
    writePackedRoom(room, packedPath(path("rooms"), uint64_t(seed)));
  }
  writeSurfaces({}, surfacesPath(path("rooms"), 1000003));
  const PackedSamples samples = packedSamples(path("rooms"), "0123456789abcdef");
  EXPECT_EQ(samples.seeds, (std::vector<uint64_t>{1000003, 1000017}));
  std::map<size_t, int> tokens;  // a condition's name here
  int labelled = 0;
  for (int64_t i = 0; i < samples.count; ++i) {
    const CompletionSample s = samples.source(uint64_t(i));
    ++tokens[size_t(s.condition.size())];
    labelled += unobservedNodes(s.target_nodes, s.target_nodes.box).empty();
  }
  EXPECT_EQ(labelled, samples.count / 2);  // no surface: all of it is empty
  ASSERT_EQ(tokens.size(), room.conditions.size());
  int of_two = 0;
  for (const PackedCondition& c : room.conditions)
    if (c.kind < kTwoFarViewsKinds) of_two += tokens.at(c.place.tokens.ijk.size());
  EXPECT_EQ(of_two, samples.count / 2);

  EXPECT_THROW(packedSamples(path("rooms"), "another"), Error);
  EXPECT_THROW(startPackedFolder(path("rooms"), "another"), Error);
  EXPECT_THROW(packedSamples(path("none"), ""), Error);
  std::filesystem::create_directory(path("empty"));
  EXPECT_THROW(packedSamples(path("empty"), ""), Error);
}

TEST_F(PackedRoomFile, RoomsOfEarlierVersionsAreRead) {
  const std::string tar = sharedFile("packed/rooms-1.tar");
  if (tar.empty()) GTEST_SKIP() << "no packed rooms";
  outputOf("tar -xf " + tar + " -C " + path("") + " 1000378.xz");
  const PackedRoom room = readPackedRoom(path("1000378.xz"));
  EXPECT_EQ(room.seed, 1000378);
  ASSERT_EQ(room.conditions.size(), size_t(kConditionKinds));
  const CompletionSample s = sampleOf(room, 0);
  EXPECT_EQ(s.target.size(), 3411);
  EXPECT_EQ(s.condition.size(), 1951);
  EXPECT_EQ(int64_t(filledNodes(s.target_nodes).size()), s.target.size());
}

}  // namespace
}  // namespace vdbc
