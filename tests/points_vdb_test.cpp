#include "splat/points_vdb.h"

#include <gtest/gtest.h>
#include <openvdb/io/File.h>
#include <openvdb/openvdb.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <random>

#include "splat/image.h"
#include "splat/ply.h"
#include "splat/rasterize.h"
#include "tests/expect_error.h"
#include "tests/files.h"
#include "tests/some_gaussians.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

class PointsVdb : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_ / name; }

  TemporaryFolder folder_;
};

/// Rows of `back` by the row of the original, found through the probability, which is stored
/// exactly.
std::vector<size_t> matchByProbability(const Provenance& original, const Provenance& back) {
  std::map<float, size_t> place;
  for (size_t i = 0; i < back.probability.size(); ++i) place[back.probability[i]] = i;
  std::vector<size_t> rows;
  for (float p : original.probability) rows.push_back(place.count(p) ? place[p] : SIZE_MAX);
  return rows;
}

Provenance someProvenance(int64_t n) {
  Provenance provenance;
  for (int64_t i = 0; i < n; ++i) {
    provenance.generated.push_back(uint8_t(i * 7 % 3 == 0));
    provenance.probability.push_back(float(i + 1) / float(n + 1));
  }
  return provenance;
}

TEST_F(PointsVdb, RoundTripWithinTheirCodecs) {
  for (int degree = 0; degree <= 3; ++degree) {
    const int64_t n = 3000;
    const Gaussians g = someGaussians(n, degree, unsigned(20 + degree));
    const Provenance provenance = someProvenance(n);
    writePointsVdb(g, provenance, path("a.vdb"));
    Provenance back_provenance;
    const Gaussians back = readPointsVdb(path("a.vdb"), &back_provenance);
    ASSERT_EQ(back.size(), n);
    ASSERT_EQ(back.sh_degree, degree);
    const std::vector<size_t> rows = matchByProbability(provenance, back_provenance);
    const size_t values = size_t(g.shCoefficients()) * 3;
    for (size_t i = 0; i < size_t(n); ++i) {
      const size_t j = rows[i];
      ASSERT_NE(j, SIZE_MAX) << i;
      EXPECT_EQ(back_provenance.generated[j], provenance.generated[i]);
      // 50 m^2 with 3,000 points, 8 a voxel: voxels of 0.37 m, in 65,535 steps.
      EXPECT_LT((back.mean[j] - g.mean[i]).cwiseAbs().maxCoeff(), 0.5 * 0.37 / 65535 + 5e-7);
      EXPECT_LT((back.log_scale[j] - g.log_scale[i]).cwiseAbs().maxCoeff(), 1. / 1024);  // half
      EXPECT_LT((back.rotation[j] - g.rotation[i]).cwiseAbs().maxCoeff(), 0.51 / 65536);
      const auto alpha = [](float logit) { return 1 / (1 + std::exp(-double(logit))); };
      EXPECT_NEAR(alpha(back.opacity_logit[j]), alpha(g.opacity_logit[i]), 0.51 / 65535);
      for (size_t k = 0; k < values; ++k) {  // half floats: 11 bits; of linear colour for degree 0
        const float sh = g.sh[i * values + k], offset = degree ? 0 : 1.8f;
        EXPECT_NEAR(back.sh[j * values + k], sh, (std::abs(sh) + offset) / 1024 + 6e-8);
      }
    }
  }
}

TEST_F(PointsVdb, TinyAndHugeScalesAreKept) {
  Gaussians g = someGaussians(400, 0, 5);
  for (size_t i = 0; i < 400; ++i) g.log_scale[i][0] = -40.f + 0.2f * float(i);  // 4e-18 to 2e17 m
  const Provenance provenance = someProvenance(400);
  writePointsVdb(g, provenance, path("a.vdb"));
  Provenance back_provenance;
  const Gaussians back = readPointsVdb(path("a.vdb"), &back_provenance);
  const std::vector<size_t> rows = matchByProbability(provenance, back_provenance);
  for (size_t i = 0; i < 400; ++i) {
    ASSERT_NE(rows[i], SIZE_MAX);
    EXPECT_LT((back.log_scale[rows[i]] - g.log_scale[i]).cwiseAbs().maxCoeff(), 2e-5);
  }
}

TEST_F(PointsVdb, FilesTakeAtMostThreeFifthsOfPly) {
  for (int degree = 0; degree <= 3; ++degree) {
    const Gaussians g = someGaussians(100000, degree, 7);
    Gaussians tiny = g;  // too small for half floats
    tiny.log_scale[0].x() = -20;
    for (const Gaussians& one : {g, tiny}) {
      writePly(one, path("a.ply"));
      writePointsVdb(one, {}, path("a.vdb"));
      EXPECT_LE(double(fs::file_size(path("a.vdb"))), .6 * double(fs::file_size(path("a.ply"))))
          << "degree " << degree;
    }
  }
}

TEST_F(PointsVdb, CloudsOfAnyShapeKeepTheirPlaces) {
  // Far from the origin, all at one place, on a line, with an outlier: places must survive each.
  std::vector<std::vector<Eigen::Vector3f>> clouds(5);
  std::mt19937 random(9);
  std::uniform_real_distribution<float> uniform(-1.f, 1.f);
  for (int i = 0; i < 300; ++i) {
    const Eigen::Vector3f p(uniform(random), uniform(random), uniform(random));
    clouds[0].push_back(p + Eigen::Vector3f(1000, -2000, 500));
    clouds[1].push_back({0.3f, -0.2f, 7.f});
    clouds[2].push_back({p.x(), 0, 0});
    clouds[3].push_back(i ? p : Eigen::Vector3f(1e6f, 0, 0));
  }
  clouds[4].push_back({-3.f, 4.f, 5.f});
  for (size_t c = 0; c < clouds.size(); ++c) {
    SCOPED_TRACE(c);
    const int64_t n = int64_t(clouds[c].size());
    Gaussians g = someGaussians(n, 0, 1);
    g.mean = clouds[c];
    const Provenance provenance = someProvenance(n);
    writePointsVdb(g, provenance, path("a.vdb"));
    Provenance back_provenance;
    const Gaussians back = readPointsVdb(path("a.vdb"), &back_provenance);
    ASSERT_EQ(back.size(), n);
    const std::vector<size_t> rows = matchByProbability(provenance, back_provenance);
    for (size_t i = 0; i < size_t(n); ++i) {
      ASSERT_NE(rows[i], SIZE_MAX);
      const float far = c == 3 ? 1e6f : g.mean[i].cwiseAbs().maxCoeff();
      EXPECT_LT((back.mean[rows[i]] - g.mean[i]).norm(), 1e-5f + 1e-7f * far);
    }
  }
}

TEST_F(PointsVdb, GaussiansWithoutProvenanceAreObserved) {
  writePointsVdb(someGaussians(50, 2, 3), {}, path("a.vdb"));
  Provenance provenance;
  EXPECT_EQ(readPointsVdb(path("a.vdb"), &provenance).size(), 50);
  EXPECT_TRUE(provenance.recorded);
  EXPECT_EQ(provenance.generated, std::vector<uint8_t>(50, 0));
  EXPECT_EQ(provenance.probability, std::vector<float>(50, 1.f));
  EXPECT_EQ(readPointsVdb(path("a.vdb")).size(), 50);
}

TEST_F(PointsVdb, WhatIsBrokenIsDropped) {
  Gaussians g = someGaussians(5, 0, 4);
  g.mean[0].y() = std::nanf("");
  g.rotation[1] = Eigen::Vector4f::Zero();
  g.log_scale[2].x() = 200;  // sigma overflows
  g.opacity_logit[3] = 100;
  writePointsVdb(g, someProvenance(5), path("a.vdb"));
  Provenance provenance;
  const Gaussians back = readPointsVdb(path("a.vdb"), &provenance);
  ASSERT_EQ(back.size(), 2);
  EXPECT_GT(*std::max_element(back.opacity_logit.begin(), back.opacity_logit.end()), 11);
  for (float logit : back.opacity_logit) EXPECT_TRUE(std::isfinite(logit));
  writePointsVdb(Gaussians(), {}, path("a.vdb"));
  EXPECT_EQ(readPointsVdb(path("a.vdb"), &provenance).size(), 0);
}

TEST_F(PointsVdb, UnreadableFilesThrow) {
  expectError([&] { readPointsVdb(path("none.vdb")); }, {"none.vdb", "no such file"});
  writeBytes(path("a.vdb"), "hello");
  expectError([&] { readPointsVdb(path("a.vdb")); }, {"a.vdb"});
  writeBytes(path("a.vdb"), "");
  expectError([&] { readPointsVdb(path("a.vdb")); }, {"a.vdb"});
}

TEST_F(PointsVdb, TruncatedFilesThrow) {
  writePointsVdb(someGaussians(20, 0, 3), {}, path("whole.vdb"));
  const std::string bytes = bytesOf(path("whole.vdb"));
  EXPECT_NO_THROW(readPointsVdb(path("whole.vdb")));
  // The last 16 bytes are the checksum, which other programs drop: the grid is whole without it.
  const size_t end = bytes.size() - 16;
  for (size_t n = 0; n < end; n += n + 20 < end ? 1 + end / 150 : 1) {
    writeBytes(path("cut.vdb"), bytes.substr(0, n));
    EXPECT_THROW(readPointsVdb(path("cut.vdb")), Error) << n << " of " << bytes.size();
  }
  writeBytes(path("cut.vdb"), bytes.substr(0, end));
  EXPECT_EQ(readPointsVdb(path("cut.vdb")).size(), 20);
}

TEST_F(PointsVdb, FlippedBitsAreFound) {
  writePointsVdb(someGaussians(20, 0, 3), {}, path("whole.vdb"));
  const std::string bytes = bytesOf(path("whole.vdb"));
  std::mt19937 random(3);
  for (int i = 0; i < 200; ++i) {
    std::string damaged = bytes;
    damaged[random() % (bytes.size() - 16)] ^= char(1 << random() % 8);
    writeBytes(path("damaged.vdb"), damaged);
    EXPECT_THROW(readPointsVdb(path("damaged.vdb")), Error);
  }
}

TEST_F(PointsVdb, TheSameGaussiansGiveTheSamePoints) {
  const Gaussians g = someGaussians(500, 1, 8);
  writePointsVdb(g, {}, path("a.vdb"));
  writePointsVdb(g, {}, path("b.vdb"));
  EXPECT_EQ(readPointsVdb(path("a.vdb")).mean, readPointsVdb(path("b.vdb")).mean);
}

TEST_F(PointsVdb, FailedWritesThrowAndLeaveNothing) {
  const Gaussians g = someGaussians(3, 0, 1);
  EXPECT_THROW(writePointsVdb(g, {}, path("no/such/folder/a.vdb")), Error);
  EXPECT_THROW(writePointsVdb(g, {{1}, {}}, path("a.vdb")), Error);  // provenance of another count
  Gaussians broken = g;
  broken.log_scale.pop_back();
  EXPECT_THROW(writePointsVdb(broken, {}, path("a.vdb")), Error);
  EXPECT_TRUE(fs::is_empty(folder_.path));
}

TEST_F(PointsVdb, FilesRenderAsWhatWasWritten) {
  for (int degree : {0, 3}) {
    const Gaussians g = visibleGaussians(degree);
    const Camera c = visibleGaussiansCamera();
    const Image expected = rasterize(g, c, {}).colour;
    ASSERT_LT(psnr(expected, Image(160, 160, 3)), 20);  // there is something to see
    writePointsVdb(g, {}, path("a.vdb"));
    EXPECT_GE(psnr(rasterize(readPointsVdb(path("a.vdb")), c, {}).colour, expected), 50);
  }
}

TEST_F(PointsVdb, FilesSayWhetherTheyAreAntialiased) {
  Gaussians g = someGaussians(10, 0, 1);
  for (bool antialias : {false, true}) {
    g.antialias = antialias;
    writePointsVdb(g, {}, path("a.vdb"));
    EXPECT_EQ(readPointsVdb(path("a.vdb")).antialias, antialias);
  }
}

TEST_F(PointsVdb, ADegreeThatTheColoursDoNotReachIsRefused) {
  writePointsVdb(someGaussians(20, 1, 3), {}, path("a.vdb"));
  openvdb::io::File file(path("a.vdb"));
  file.open();
  const openvdb::GridPtrVecPtr grids = file.getGrids();
  file.close();
  grids->front()->insertMeta("sh_degree", openvdb::Int32Metadata(3));
  openvdb::io::File(path("b.vdb")).write(*grids);
  expectError([&] { readPointsVdb(path("b.vdb")); },
              {"b.vdb", "expected at least 16 values of GS_SPH_R", "found 4"});
}

// ---- files by others

TEST_F(PointsVdb, ForeignFilesAreRefusedClearly) {
  const std::string vdb = sharedFile("data/vdb");
  if (vdb.empty()) GTEST_SKIP() << "no grids by others";
  expectError([&] { readPointsVdb(vdb + "/points.vdb"); }, {"points.vdb", "no splats"});
  expectError([&] { readPointsVdb(vdb + "/smoke.vdb"); }, {"smoke.vdb", "no splats", "density"});
}

}  // namespace
}  // namespace vdbc
