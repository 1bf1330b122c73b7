// The latent file stands in for the encoder's output: what is decoded from it is what would have
// been decoded at once, bit for bit, but for z in half precision.
#include <gtest/gtest.h>
#include <openvdb/Types.h>

#include <cstring>
#include <filesystem>

#include "encoder/encoder.h"
#include "tests/files.h"
#include "tests/simple_room.h"
#include "vdb/latent_vdb.h"

namespace vdbc {
namespace {

template <typename T>
bool sameBytes(const std::vector<T>& a, const std::vector<T>& b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0;
}

TEST(LatentDecode, FromTheFileIsFromMemoryByteForByte) {
  if (!std::filesystem::exists(kWeights + "/encoder.safetensors"))
    GTEST_SKIP() << "no trained weights in " << kWeights;
  const TemporaryFolder folder;
  const Encoder encoder(kWeights + "/encoder.safetensors");
  Progress silent;
  std::vector<View> views = simpleRoomViews(2, 64, 48, 7);
  // A world that is not the grid's: turned by nothing round, far from the origin.
  const Eigen::Isometry3d turn = Eigen::Translation3d(1.7, -9.3, 4.1) *
                                 Eigen::AngleAxisd(1.1, Eigen::Vector3d(1, -2, .5).normalized());
  for (View& v : views) v.camera.world_from_camera = turn * v.camera.world_from_camera;
  ObserveSettings settings;
  settings.volume.up = turn.linear() * Eigen::Vector3d::UnitZ();
  const Observation o = observe(views, encoder.observing(settings), silent);
  Place place = encoder.encode(views, o, silent);
  writeLatentVdb(place, folder / "a.latent.vdb");

  for (float& z : place.z) z = float(openvdb::math::half(z));
  const DecodedGrid at_once = encoder.decode(place, .05f, silent);
  ASSERT_GT(at_once.gaussians.size(), 1000);
  const Place read = readLatentVdb(folder / "a.latent.vdb");
  EXPECT_EQ(read.encoder_hash, encoder.hash());
  const DecodedGrid later = encoder.decode(read, .05f, silent);
  EXPECT_EQ(later.voxels, at_once.voxels);
  EXPECT_EQ(later.node, at_once.node);
  EXPECT_TRUE(sameBytes(later.child_probability, at_once.child_probability));
  EXPECT_EQ(later.gaussians.origin, at_once.gaussians.origin);
  EXPECT_TRUE(sameBytes(later.gaussians.mean, at_once.gaussians.mean));
  EXPECT_TRUE(sameBytes(later.gaussians.log_scale, at_once.gaussians.log_scale));
  EXPECT_TRUE(sameBytes(later.gaussians.rotation, at_once.gaussians.rotation));
  EXPECT_TRUE(sameBytes(later.gaussians.opacity_logit, at_once.gaussians.opacity_logit));
  EXPECT_TRUE(sameBytes(later.gaussians.sh, at_once.gaussians.sh));
}

}  // namespace
}  // namespace vdbc
