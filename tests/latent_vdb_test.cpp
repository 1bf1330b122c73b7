// Laws of the latent file: what is written is what is read, z in half precision; no damaged or
// foreign file gets through; other programs open it.
#include "vdb/latent_vdb.h"

#include <gtest/gtest.h>
#include <openvdb/io/File.h>
#include <openvdb/openvdb.h>
#include <openvdb/points/PointDataGrid.h>

#include <cstring>
#include <map>
#include <random>
#include <set>

#include "tests/vdb_files.h"
#include "vdb/grid_instances.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using PointGrid = openvdb::points::PointDataGrid;

/// A shuffled half of the nodes of a turned volume, observed and generated, with what was seen.
Place somePlace(int level = 1, int side = 24, int dim = 32) {
  Place g;
  g.encoder_hash = "0123456789abcdef", g.growth = "level 3 of a run";
  g.level = level, g.dim = dim;
  g.frame.voxel_m = 0.07f;
  g.frame.world_from_grid.linear() =
      Eigen::AngleAxisd(0.5, Eigen::Vector3d(0.1, -0.2, 1).normalized()).toRotationMatrix();
  g.frame.world_from_grid.translation() = Eigen::Vector3d(3.1, 0, 1e-17);
  g.frame.bounds = CoordBBox(Coord(-8), Coord(side - 9));
  std::mt19937 random(5);
  std::normal_distribution<float> normal;
  const CoordBBox nodes(tokenCoord(g.frame.bounds.min(), level),
                        tokenCoord(g.frame.bounds.max(), level));
  for (const Coord& ijk : nodes)
    if (random() % 2) g.ijk.push_back(ijk);
  std::shuffle(g.ijk.begin(), g.ijk.end(), random);
  for (size_t i = 0; i < g.ijk.size(); ++i) {
    const bool generated = random() % 3 == 0;
    g.generated.push_back(generated);
    g.probability.push_back(generated ? .1f + .8f * float(random() % 1000) / 1000 : 1.f);
    g.bfs_level.push_back(generated ? 1 + int(random() % 9) : 0);
    for (int c = 0; c < dim; ++c) g.z.push_back(normal(random) * (c % 3 ? 1.f : 1e-5f));
  }
  const auto seen = std::make_shared<SeenSpace>();
  for (const Coord& ijk : g.frame.bounds) {
    const unsigned kind = random() % 8;
    if (kind == 0) seen->filled.setValueOn(ijk);
    if (kind == 1 || ijk.x() < 0) seen->empty.setValueOn(ijk);
  }
  seen->empty.prune();
  g.seen = seen;
  return g;
}

std::vector<float> inHalf(std::vector<float> values) {
  for (float& v : values) v = float(openvdb::math::half(v));
  return values;
}

std::set<Coord> setOf(const TokenMask& mask) {
  const std::vector<Coord> coords = activeCoords(mask);
  return {coords.begin(), coords.end()};
}

/// All of it equal bit for bit, but for z, which is `z`.
void expectSame(const Place& g, const Place& h, const std::vector<float>& z) {
  EXPECT_EQ(g.encoder_hash, h.encoder_hash);
  EXPECT_EQ(g.growth, h.growth);
  EXPECT_EQ(g.level, h.level);
  EXPECT_EQ(g.dim, h.dim);
  EXPECT_EQ(g.ijk, h.ijk);
  ASSERT_EQ(g.z.size(), z.size());
  EXPECT_TRUE(z.empty() || std::memcmp(g.z.data(), z.data(), z.size() * sizeof(float)) == 0);
  EXPECT_EQ(g.generated, h.generated);
  EXPECT_EQ(g.probability, h.probability);
  EXPECT_EQ(g.bfs_level, h.bfs_level);
  EXPECT_EQ(g.frame.voxel_m, h.frame.voxel_m);
  EXPECT_EQ(g.frame.bounds, h.frame.bounds);
  EXPECT_EQ(g.frame.world_from_grid.matrix(), h.frame.world_from_grid.matrix());
  EXPECT_EQ(setOf(g.seen->filled), setOf(h.seen->filled));
  EXPECT_EQ(setOf(g.seen->empty), setOf(h.seen->empty));
}

TEST(LatentVdb, RoundTripIsExactInHalfPrecision) {
  const TemporaryFolder folder;
  for (int level : {0, 1, 2}) {
    const Place before = somePlace(level);
    ASSERT_GT(before.size(), 50);
    const std::vector<float> halves = inHalf(before.z);
    EXPECT_NE(before.z, halves);
    writeLatentVdb(before, folder / "a.vdb");
    const Place after = readLatentVdb(folder / "a.vdb");
    expectSame(after, before, halves);
    writeLatentVdb(after, folder / "b.vdb");
    expectSame(readLatentVdb(folder / "b.vdb"), after, halves);
  }
  EXPECT_EQ(std::distance(fs::directory_iterator(folder.path), fs::directory_iterator()), 2);
}

TEST(LatentVdb, LatentsThatAreEqualEverywhereRoundTrip) {  // OpenVDB stores them as one value
  const TemporaryFolder folder;
  Place before = somePlace();
  std::fill(before.z.begin(), before.z.end(), .5f);
  std::fill(before.probability.begin(), before.probability.end(), 1.f);
  writeLatentVdb(before, folder / "a.vdb");
  expectSame(readLatentVdb(folder / "a.vdb"), before, before.z);
}

TEST(LatentVdb, NoLatentsRoundTrip) {
  const TemporaryFolder folder;
  Place before;
  before.seen = std::make_shared<SeenSpace>();
  before.dim = 8;
  before.frame.bounds = CoordBBox(Coord(0), Coord(3));
  writeLatentVdb(before, folder / "a.vdb");
  expectSame(readLatentVdb(folder / "a.vdb"), before, {});
}

TEST(LatentVdb, OnePointAtEachNodesCentre) {
  const TemporaryFolder folder;
  const Place place = somePlace();
  writeLatentVdb(place, folder / "a.vdb");
  openvdb::io::File in(folder / "a.vdb");
  in.open(false);
  const auto grid = openvdb::gridPtrCast<PointGrid>(in.readGrid("latent"));
  std::set<Coord> expected(place.ijk.begin(), place.ijk.end()), found;
  for (auto leaf = grid->tree().cbeginLeaf(); leaf; ++leaf) {
    const openvdb::points::AttributeHandle<openvdb::Vec3f> p(leaf->constAttributeArray("P"));
    EXPECT_EQ(leaf->constAttributeArray("z").stride(), 32u);
    EXPECT_EQ(leaf->constAttributeArray("z").codecType(), "trnc");
    for (auto point = leaf->beginIndexOn(); point; ++point) {
      const Coord ijk = point.getCoord();
      found.insert(ijk);
      const openvdb::Vec3d world =
          grid->transform().indexToWorld(ijk.asVec3d() + openvdb::Vec3d(p.get(*point)));
      const Eigen::Vector3d centre =
          place.frame.toWorld(2 * Eigen::Vector3d(ijk.x() + .5, ijk.y() + .5, ijk.z() + .5));
      ASSERT_LT((Eigen::Vector3d(world.x(), world.y(), world.z()) - centre).norm(), 1e-9);
    }
  }
  EXPECT_EQ(found, expected);
  EXPECT_EQ(grid->metaValue<int64_t>("point_count"), place.size());
}

TEST(LatentVdb, EveryTruncationThrows) {
  const TemporaryFolder folder;
  writeLatentVdb(somePlace(1, 8, 4), folder / "a.vdb");
  expectEveryTruncationThrows(folder / "a.vdb", folder / "cut.vdb", 53, readLatentVdb);
}

TEST(LatentVdb, EveryCorruptionThrows) {
  const TemporaryFolder folder;
  writeLatentVdb(somePlace(1, 8, 4), folder / "a.vdb");
  expectEveryCorruptionThrows(folder / "a.vdb", folder / "bad.vdb", readLatentVdb);
}

TEST(LatentVdb, FilesWrittenAgainByOthersAreRead) {
  const TemporaryFolder folder;
  const Place before = somePlace();
  writeLatentVdb(before, folder / "a.vdb");
  rewriteVdb(folder / "a.vdb", folder / "b.vdb", [](Grids&, openvdb::MetaMap&) {});
  expectSame(readLatentVdb(folder / "b.vdb"), before, inHalf(before.z));
}

TEST(LatentVdb, ForeignFilesWithNonsenseThrow) {
  using openvdb::MetaMap;
  const TemporaryFolder folder;
  writeLatentVdb(somePlace(1, 8, 4), folder / "a.vdb");
  const auto rejects = [&](const char* named, auto change) {
    rewriteVdb(folder / "a.vdb", folder / "b.vdb", change);
    try {
      readLatentVdb(folder / "b.vdb");
      ADD_FAILURE() << "was read: " << named;
    } catch (const Error& e) {
      const std::string text = e.what();
      EXPECT_NE(text.find(named), std::string::npos) << text << " lacks " << named;
      EXPECT_EQ(text.find('\n'), std::string::npos) << text;
    }
  };
  const auto leafOf = [](Grids& g) {
    return openvdb::gridPtrCast<PointGrid>(g["latent"])->tree().beginLeaf();
  };
  for (const char* name : {"latent", "filled", "empty"}) {
    rejects(name, [&](Grids& g, MetaMap&) { g.erase(name); });
    rejects("transform", [&](Grids& g, MetaMap&) {
      g[name]->setTransform(g[name]->transform().copy());
      g[name]->transform().postTranslate({1, 0, 0});
    });
  }
  for (const char* name :
       {"encoder_hash", "latent_level", "latent_dim", "voxel_m", "volume_min", "world_from_grid"})
    rejects(name, [&](Grids&, MetaMap& m) { m.removeMeta(name); });
  rejects("dim",
          [](Grids&, MetaMap& m) { m.insertMeta("latent_dim", openvdb::Int32Metadata(1 << 30)); });
  rejects("expected z with 3",
          [](Grids&, MetaMap& m) { m.insertMeta("latent_dim", openvdb::Int32Metadata(3)); });
  rejects("level",
          [](Grids&, MetaMap& m) { m.insertMeta("latent_level", openvdb::Int32Metadata(40)); });
  rejects("transform",
          [](Grids&, MetaMap& m) { m.insertMeta("latent_level", openvdb::Int32Metadata(2)); });
  rejects("outside the volume", [](Grids&, MetaMap& m) {
    m.insertMeta("volume_max", openvdb::Vec3IMetadata({-7, -7, -7}));
  });
  rejects("outside the volume", [](Grids& g, MetaMap&) {
    openvdb::gridPtrCast<BoolGrid>(g["filled"])->tree().setValueOn(Coord(99, 0, 0), true);
  });
  for (const float bad : {INFINITY, NAN})
    rejects("makes no sense", [&](Grids& g, MetaMap&) {
      openvdb::points::AttributeWriteHandle<float>(leafOf(g)->attributeArray("z")).set(0, 1, bad);
    });
  rejects("makes no sense", [&](Grids& g, MetaMap&) {
    openvdb::points::AttributeWriteHandle<float>(leafOf(g)->attributeArray("probability"))
        .set(0, 1.5f);
  });
  for (const int row : {-1, 1, 1 << 30})
    rejects("row", [&](Grids& g, MetaMap&) {
      openvdb::points::AttributeWriteHandle<int32_t> rows(leafOf(g)->attributeArray("row"));
      rows.set(rows.get(0) == 1, row);
    });
  rejects("one point a node", [&](Grids& g, MetaMap&) {  // all points in the last voxel
    auto leaf = leafOf(g);
    const auto points = leaf->getLastValue();
    std::vector<openvdb::PointDataIndex32> offsets(512, 0);
    offsets.back() = points;
    leaf->setOffsets(offsets);
  });
  writeBytes(folder / "b.vdb", "not a volume at all, but some words of text\n");
  EXPECT_THROW(readLatentVdb(folder / "b.vdb"), Error);
  EXPECT_THROW(readLatentVdb(folder / "missing.vdb"), Error);
  EXPECT_THROW(readLatentVdb(folder.path.string()), Error);
}

TEST(LatentVdb, BadLatentsThrowAndLeaveNothing) {
  const TemporaryFolder folder;
  const auto rejects = [&](auto change) {
    Place place = somePlace(1, 8, 4);
    change(place);
    EXPECT_THROW(writeLatentVdb(place, folder / "a.vdb"), Error);
  };
  rejects([](Place& p) { p.z.pop_back(); });
  rejects([](Place& p) { p.bfs_level.pop_back(); });
  rejects([](Place& p) { p.generated.pop_back(); });
  rejects([](Place& p) { p.ijk[0] = p.ijk[1]; });
  rejects([](Place& p) { p.ijk[0] = Coord(1000, 0, 0); });
  rejects([](Place& p) { p.z[3] = NAN; });
  rejects([](Place& p) { p.z[3] = 1e6f; });
  rejects([](Place& p) { p.probability[0] = 2; });
  rejects([](Place& p) { p.frame.voxel_m = 0; });
  rejects([](Place& p) { p.level = 3; });
  rejects([](Place& p) {
    const auto seen = std::make_shared<SeenSpace>(*p.seen);
    seen->filled.setValueOn(Coord(-9, 0, 0));
    p.seen = seen;
  });
  EXPECT_THROW(writeLatentVdb(somePlace(), folder / "no/such/folder/a.vdb"), Error);
  EXPECT_TRUE(fs::is_empty(folder.path));
}

TEST(LatentVdb, VdbPrintOpensIt) {
  if (!installed("vdb_print")) GTEST_SKIP() << "vdb_print is not installed";
  const TemporaryFolder folder;
  writeLatentVdb(somePlace(), folder / "a.vdb");
  const std::string text =
      outputOf("vdb_print -l " + folder / "a.vdb") + outputOf("vdb_print -m " + folder / "a.vdb");
  for (const char* part : {"latent", "ptdataidx32", "filled", "empty", "encoder_hash",
                           "0123456789abcdef", "point_attributes", "latent_dim"})
    EXPECT_NE(text.find(part), std::string::npos) << part << " in\n" << text;
}

TEST(LatentVdb, BlenderListsItsGrids) {
  if (!installed("blender")) GTEST_SKIP() << "blender is not installed";
  const TemporaryFolder folder;
  writeLatentVdb(somePlace(), folder / "a.vdb");
  writeBytes(folder / "look.py", R"(
import bpy, sys
bpy.ops.object.volume_import(filepath=sys.argv[-1])
grids = bpy.context.object.data.grids
grids.load()
for grid in grids:
    print('GRID', grid.name, grid.data_type, '.')
)");
  const std::string text =
      outputOf("timeout 120 blender -b --factory-startup -noaudio --python-exit-code 1 -P " +
               folder / "look.py" + " -- " + folder / "a.vdb");
  for (const char* line : {"GRID latent POINTS .", "GRID filled BOOLEAN .", "GRID empty BOOLEAN ."})
    EXPECT_NE(text.find(line), std::string::npos) << line << " in\n" << text;
}

TEST(LatentVdb, PythonReadsTheVoxelsSeen) {
  if (outputOf("python3 -c 'import pyopenvdb; print(1)'").empty())
    GTEST_SKIP() << "python3-openvdb is not installed";
  const TemporaryFolder folder;
  const Place place = somePlace();
  writeLatentVdb(place, folder / "a.vdb");
  const std::string text = outputOf("python3 -c \"import pyopenvdb; print(pyopenvdb.read('" +
                                    folder / "a.vdb" + "', 'filled').activeVoxelCount())\"");
  EXPECT_EQ(text, std::to_string(setOf(place.seen->filled).size()) + "\n");
}

}  // namespace
}  // namespace vdbc
