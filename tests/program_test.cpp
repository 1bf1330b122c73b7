// vdb_complete as its users meet it.
#include "tests/program.h"

#include "vdb/fuse.h"
#include "vdb/vdb_file.h"

namespace vdbc {
namespace {

// ---- the command line

TEST_F(Program, UsageErrorsExitWith2) {
  const std::string views = writeRoom("views"), x = output_ + "/x.vdb";
  expectFailure({}, kUsage, "VIEWS");
  expectFailure({"--frobnicate"}, kUsage, "--frobnicate");
  expectFailure({views, "frobnicate", "-o", x}, kUsage, "frobnicate");
  expectFailure({views}, kUsage, "-o");
  expectFailure({"render", at("a.ply"), "-o", output_}, kUsage, "--cameras");
  expectFailure({"render", at("a.xyz"), "--cameras", views, "-o", output_}, kUsage, at("a.xyz"));
  expectFailure(complete(views, {"--seed", "one"}), kUsage, "--seed");
  expectFailure(complete(views, {"--threads", "-1"}), kUsage, "--threads");
}

TEST_F(Program, ValuesThatCannotBeExitWith2) {
  const std::string views = writeRoom("views");
  expectFailure(complete(views, {"--bounds", "1", "1", "1", "0", "2", "2"}), kUsage, "--bounds");
  expectFailure(complete(views, {"--bounds", "0", "0", "0", "1", "1", "nan"}), kUsage, "--bounds");
  expectFailure(complete(views, {"--bounds", "0", "0", "0", "1"}), kUsage, "--bounds");
  expectFailure(complete(views, {"--up", "0", "0", "0"}), kUsage, "--up");
  expectFailure(complete(views, {"--margin", "nan"}), kUsage, "--margin");
  expectFailure(complete(views, {"--tau", "1.5"}), kUsage, "--tau");
  for (const char* frames : {"3-", "2-1", "0,,1", "0;1"})
    expectFailure(complete(views, {std::string("--frames=") + frames}), kUsage, frames);
}

TEST_F(Program, FramesOutOfRangeNameTheViews) {
  const std::string views = writeRoom("views");
  expectBadViews(views, "", {"--frames", "2"});
  expectBadViews(views, "", {"--frames", "0,1,5-9"});
  writeViewExr(roomViews(1)[0], at("one.exr"));
  expectBadViews(at("one.exr"), "", {"--frames", "1"});
}

TEST_F(Program, HelpIsOfTheVerbOrOfAllOfThem) {
  const Args verbs = {"encode", "decode", "rethreshold", "render", "check", "info"};
  const Ended front = run({"--help"});
  EXPECT_EQ(front.code, kOk);
  EXPECT_EQ(front.err, "");
  EXPECT_NE(front.out.find("--tau"), std::string::npos);
  for (const std::string& verb : verbs) {
    SCOPED_TRACE(verb);
    EXPECT_NE(front.out.find("\n  " + verb + " "), std::string::npos);
    const Ended ended = run({verb, "--help"});
    EXPECT_EQ(ended.code, kOk);
    EXPECT_EQ(ended.err, "");
    EXPECT_EQ(ended.out.rfind("vdb_complete " + verb + ": ", 0), 0u) << ended.out;
    EXPECT_TRUE(run({verb, "-h"}).out == ended.out);
  }
  EXPECT_EQ(lines(run({"--version"}).out).size(), 1u);
}

TEST_F(Program, IsWithoutFurnitureAndTraining) {
  const std::string binary = readText(VDBC_PROGRAM);
  ASSERT_GT(binary.size(), 100000u);
  for (const char* of_the_lab : {"libpugixml", "tinyobj", "sweethome3d", "make_rooms", "torchrun"})
    EXPECT_EQ(binary.find(of_the_lab), std::string::npos) << of_the_lab;
}

TEST_F(Program, InfoIsOneJsonObject) {
  const Ended ended = run({"info", "--json", "--threads", "1"});
  EXPECT_EQ(ended.code, kOk);
  const json info = json::parse(ended.out);
  EXPECT_FALSE(info.at("blas").get<std::string>().empty());
  EXPECT_FALSE(info.at("core").get<std::string>().empty());
  EXPECT_FALSE(info.at("version").get<std::string>().empty());
  EXPECT_EQ(info.at("threads"), 1);
  EXPECT_GT(info.at("gflops").get<double>(), 0);
}

// ---- views that cannot be used

TEST_F(Program, ViewsThatAreNotThere) {
  expectBadViews(at("missing"));
  fs::create_directory(at("empty"));
  expectBadViews(at("empty"));
  writeText(at("notes.txt"), "no views");
  expectBadViews(at("notes.txt"));
  writeText(at("transforms.json"), R"({"fl_x": 50, "w": 64, "h": 48, "frames": []})");
  expectBadViews(at("transforms.json"));
}

TEST_F(Program, CorruptJson) {
  const std::string views = writeRoom("views"), path = views + "/transforms.json";
  const std::string text = readText(path);
  for (size_t length : {size_t(0), text.size() / 3, text.size() - 3}) {
    writeText(path, text.substr(0, length));
    expectBadViews(views, path);
  }
  writeText(path, "[1, 2]");
  expectBadViews(views, path);
  json singular = json::parse(text);
  for (auto& row : singular["frames"][1]["transform_matrix"]) row = {0, 0, 0, 0};
  writeText(path, singular.dump());
  expectBadViews(views, path);
}

TEST_F(Program, CorruptPictures) {
  const std::string views = writeRoom("views");
  for (const std::string name : {"/color/00001.png", "/depth/00001.png"}) {
    const std::string path = views + name, whole = readText(path);
    for (const std::string& damaged :
         {std::string("not a picture"), whole.substr(0, whole.size() / 2)}) {
      writeText(path, damaged);
      expectBadViews(views, path);
    }
    fs::remove(path);
    expectBadViews(views, path);
    writeText(path, whole);
  }
}

TEST_F(Program, CorruptExr) {
  writeViewExr(roomViews(1)[0], at("one.exr"));
  const std::string whole = readText(at("one.exr"));
  for (size_t length : {size_t(5), size_t(300), whole.size() / 2}) {
    writeText(at("one.exr"), whole.substr(0, length));
    expectBadViews(at("one.exr"));
  }
}

TEST_F(Program, ViewsWithoutDepth) {
  const std::string views = writeRoom("views"), path = views + "/transforms.json";
  json transforms = json::parse(readText(path));
  for (auto& frame : transforms["frames"]) frame.erase("depth_file_path");
  writeText(path, transforms.dump());
  expectBadViews(views, path);
}

TEST_F(Program, DepthWithoutOneMeasurement) {
  const std::string views = writeRoom("views");
  writePng16(std::vector<uint16_t>(64 * 48, 0), 64, 48, views + "/depth/00001.png");
  expectBadViews(views);
  View view = roomViews(1)[0];
  std::fill(view.depth.begin(), view.depth.end(), std::numeric_limits<float>::quiet_NaN());
  writeViewExr(view, at("nan.exr"));
  expectBadViews(at("nan.exr"));
}

TEST_F(Program, SizesThatDoNotMatch) {
  const std::string views = writeRoom("views");
  writePng16(std::vector<uint16_t>(32 * 48, 2000), 32, 48, views + "/depth/00000.png");
  expectBadViews(views);
  const std::string again = writeRoom("again");
  writePng(Image(64, 40, 3, .5f), again + "/color/00000.png");
  expectBadViews(again);
}

TEST_F(Program, CamerasThatSeeNothing) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views");
  expectBadViews(views, "", {"--bounds", "500", "500", "500", "503", "503", "503"});
  writePng16(std::vector<uint16_t>(64 * 48, 60000), 64, 48, views + "/depth/00000.png");  // 60 m
  expectBadViews(views, "", {"--frames", "0"});
}

// ---- other files that cannot be used

TEST_F(Program, CorruptVolumesAndSplats) {
  const std::string views = writeRoom("views");
  const std::string volume = writeVolume(), splats = writeSplats();
  for (const std::string& path : {volume, splats}) {
    const std::string whole = readText(path);
    for (size_t length : {size_t(10), whole.size() / 2, whole.size() * 9 / 10}) {
      writeText(path, whole.substr(0, length));
      if (path == volume)
        expectFailure({"check", views, path}, kFailed, path);
      else
        expectFailure({"render", path, "--cameras", views, "-o", output_}, kFailed, path);
    }
  }
  expectFailure({"check", views, at("missing.vdb")}, kFailed, at("missing.vdb"));
  writeText(at("points.vdb"), "neither points nor a grid");
  expectFailure({"render", at("points.vdb"), "--cameras", views, "-o", output_}, kFailed,
                at("points.vdb"));
}

TEST_F(Program, WeightsThatAreNone) {
  const std::string views = writeRoom("views");
  const std::string folder = at("weights"), encoder = folder + "/encoder.safetensors";
  fs::create_directory(folder);
  const Args args = {views, "-o", output_ + "/x.vdb", "--weights", folder};
  expectFailure(args, kFailed, encoder);
  const std::string empty_header("\x02\0\0\0\0\0\0\0{}", 10);  // valid, holds nothing
  for (const std::string& text : {std::string(64, '\xff'), std::string(64, '\0'), empty_header}) {
    writeText(encoder, text);
    expectFailure(args, kFailed, encoder);
  }
}

TEST_F(Program, WeightsThatAreDamagedOrOfTheOtherNetwork) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views");
  const std::string folder = at("weights"), encoder = folder + "/encoder.safetensors",
                    completer = folder + "/completer.safetensors";
  fs::create_directory(folder);
  const Args args = {views, "-o", output_ + "/x.vdb", "--weights", folder};
  fs::copy_file(VDBC_WEIGHTS "/encoder.safetensors", encoder);
  expectFailure(args, kFailed, completer);
  fs::copy_file(VDBC_WEIGHTS "/encoder.safetensors", completer);
  expectFailure(args, kFailed, completer);
  const std::string whole = readText(encoder);
  for (size_t length : {size_t(4), size_t(100), whole.size() - 1}) {
    writeText(encoder, whole.substr(0, length));
    expectFailure(args, kFailed, encoder);
  }
  fs::remove(encoder);
  fs::copy_file(VDBC_WEIGHTS "/completer.safetensors", encoder);
  expectFailure(args, kFailed, encoder);
}

// ---- places that cannot be written to

TEST_F(Program, OutputsThatCannotBe) {
  const std::string views = writeRoom("views"), splats = writeSplats();
  writeText(at("file"), "");
  for (const std::string& name : {output_ + "/x.ply", output_ + "/.vdb", output_})
    expectFailure({views, "-o", name, "--weights", VDBC_WEIGHTS}, kUsage, name);
  for (const std::string& folder : {at("file"), at("file") + "/deeper", std::string("/proc")})
    expectFailure({views, "-o", folder + "/x.vdb", "--weights", VDBC_WEIGHTS}, kFailed, folder);
  fs::create_directory(output_ + "/x.ply");
  expectFailure(complete(views), kFailed, output_ + "/x.ply");
  expectFailure({"render", splats, "--cameras", views, "-o", at("file")}, kFailed, at("file"));
  expectFailure({"render", splats, "--cameras", views, "-o", "/proc"}, kFailed, "/proc");
}

// ---- what it does

TEST_F(Program, BundledViewsCompleteToFiveFiles) {
  NEEDS_WEIGHTS();
  const std::string views = VDBC_SOURCE_DIR "/examples/two_views";
  if (!fs::exists(views)) GTEST_SKIP() << "no " << views;
  const Ended ended = run(complete(views));
  EXPECT_EQ(ended.code, kOk);
  EXPECT_EQ(ended.err, "");  // progress is for terminals
  EXPECT_EQ(listing(output_), kSiblings);
  const SceneVoxels voxels = readSceneVdb(output_ + "/x.vdb");
  const int64_t gaussians = readPly(output_ + "/x.ply").size();
  EXPECT_GT(std::count(voxels.observed.begin(), voxels.observed.end(), 1), 0);
  EXPECT_GT(std::count(voxels.observed.begin(), voxels.observed.end(), 0), 0)
      << "nothing was generated";
  Provenance provenance;
  EXPECT_EQ(readPointsVdb(output_ + "/x.points.vdb", &provenance).size(), gaussians);
  const auto generated =
      std::count(provenance.generated.begin(), provenance.generated.end(), uint8_t(1));
  EXPECT_GT(generated, 1000);
  EXPECT_GT(gaussians - generated, 1000);
  EXPECT_LT(generated, 2 * int64_t(voxels.ijk.size())) << "of the decoder's eight a voxel";
  const Image sheet = readImage(output_ + "/x.png");
  EXPECT_GT(sheet.width * sheet.height, 100 * 100);
}

TEST_F(Program, ObservedVoxelsAreTheCarvedViews) {
  NEEDS_WEIGHTS();
  const std::string folder = writeRoom("views");
  const Ended ended = run(complete(folder, {"--json", "--coarse-tau", "0.9"}));
  ASSERT_EQ(ended.code, kOk) << ended.err;
  const SceneVoxels written = readSceneVdb(output_ + "/x.vdb");

  const std::vector<View> views = readViews(folder);
  std::vector<DepthView> depth;
  for (const View& v : views) depth.push_back(v.depthView());
  VolumeSettings volume;
  volume.voxel_m = written.frame.voxel_m;
  const VoxelFrame frame = fitVolume(depth, volume, {});
  EXPECT_EQ(written.frame.bounds, frame.bounds);
  EXPECT_TRUE(written.frame.world_from_grid.isApprox(frame.world_from_grid, 1e-6));
  const SeenSpace space = carveByTraversal(frame, depth, {});
  std::set<Coord> expected, found;
  for (auto v = space.filled.cbeginValueOn(); v; ++v) expected.insert(v.getCoord());
  for (size_t i = 0; i < written.ijk.size(); ++i)
    if (written.observed[i]) found.insert(written.ijk[i]);
  EXPECT_EQ(found, expected);

  // The same numbers in what it says.
  const json result = json::parse(ended.out);
  EXPECT_EQ(result.at("views"), 2);
  EXPECT_EQ(result.at("voxels"), written.ijk.size());
  EXPECT_EQ(result.at("gaussians"), readPly(output_ + "/x.ply").size());
  std::set<std::string> stages;
  for (const std::string& line : lines(ended.err)) {
    const json progress = json::parse(line);
    stages.insert(progress.at("stage").get<std::string>());
    EXPECT_GE(progress.at("percent").get<int>(), 0);
    EXPECT_LE(progress.at("percent").get<int>(), 100);
  }
  EXPECT_EQ(stages, (std::set<std::string>{"carve", "complete", "decode", "detail", "encode",
                                           "read", "write"}));
}

TEST_F(Program, AScanCutInHalfCompletes) {
  NEEDS_WEIGHTS();
  SceneVoxels scan;  // a shell of 3.2 x 2.8 x 2.4 m, open at its largest x
  scan.frame.bounds = CoordBBox(Coord(0), Coord(31, 27, 23));
  const CoordBBox inside(Coord(1), Coord(31, 26, 22));
  std::vector<Coord> empty;
  for (const Coord& ijk : scan.frame.bounds) {
    if (inside.isInside(ijk)) {
      empty.push_back(ijk);
      continue;
    }
    scan.ijk.push_back(ijk);
    scan.colour_linear.emplace_back(.3f, .3f, .25f);
    scan.density.push_back(1), scan.observed.push_back(1), scan.probability.push_back(1);
    scan.bfs_level.push_back(0);
  }
  scan.empty.root() = maskFromCoords(empty).root();
  writeSceneVdb(scan, at("half.vdb"));

  const Ended ended = run(complete(at("half.vdb"), {"--json"}));
  ASSERT_EQ(ended.code, kOk) << ended.err;
  EXPECT_EQ(json::parse(ended.out).at("views"), 12);
  EXPECT_EQ(listing(output_), kSiblings);
  const SceneVoxels written = readSceneVdb(output_ + "/x.vdb");
  const std::set<Coord> walls(scan.ijk.begin(), scan.ijk.end());
  int64_t observed = 0, in_walls = 0, beyond = 0;
  for (size_t i = 0; i < written.ijk.size(); ++i) {
    const Eigen::Vector3d p = scan.frame.toIndex(written.frame.toWorld(
        Eigen::Vector3d(written.ijk[i].x(), written.ijk[i].y(), written.ijk[i].z()).array() + .5));
    beyond += !written.observed[i] && p.x() > 32;
    if (!written.observed[i]) continue;
    ++observed;
    // Measured points lie on the walls' inner faces, so in a voxel at one side or the other.
    EXPECT_LT(p.x(), 33);
    const Coord centre = Coord::floor(openvdb::Vec3d(p.x(), p.y(), p.z()));
    for (const Coord& near : CoordBBox(centre.offsetBy(-1), centre.offsetBy(1)))
      if (walls.count(near)) {
        ++in_walls;
        break;
      }
  }
  EXPECT_GT(observed, 2000);
  EXPECT_EQ(in_walls, observed);
  EXPECT_GT(beyond, 0);
}

TEST_F(Program, EncodeThenDecodeWritesWhatWasSeen) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views"), latents = output_ + "/x.latent.vdb";
  const Ended encoded = run({"encode", views, "-o", latents, "--weights", VDBC_WEIGHTS, "--json"});
  ASSERT_EQ(encoded.code, kOk) << encoded.err;
  EXPECT_EQ(listing(output_), Args{"x.latent.vdb"});
  const Place place = readLatentVdb(latents);
  const json said = json::parse(encoded.out);
  EXPECT_EQ(said.at("tokens"), place.size());
  EXPECT_EQ(said.at("output"), latents);
  EXPECT_GT(said.at("seconds").get<double>(), 0);
  EXPECT_EQ(place.encoder_hash.size(), 16u);

  const Ended decoded =
      run({"decode", latents, "-o", output_ + "/y.vdb", "--weights", VDBC_WEIGHTS, "--json"});
  ASSERT_EQ(decoded.code, kOk) << decoded.err;
  EXPECT_EQ(listing(output_), (Args{"x.latent.vdb", "y.ply", "y.points.vdb", "y.vdb"}));
  const SceneVoxels voxels = readSceneVdb(output_ + "/y.vdb");
  std::set<Coord> observed;
  for (size_t i = 0; i < voxels.ijk.size(); ++i)
    if (voxels.observed[i]) observed.insert(voxels.ijk[i]);
  const std::vector<Coord> filled = activeCoords(place.seen->filled);
  EXPECT_EQ(observed, std::set<Coord>(filled.begin(), filled.end()));
  const json result = json::parse(decoded.out);
  EXPECT_EQ(result.at("tokens"), place.size());
  EXPECT_EQ(result.at("voxels"), voxels.ijk.size());
  EXPECT_EQ(result.at("gaussians"), readPly(output_ + "/y.ply").size());
  // The place looks as it did.
  const View view = readViews(views)[0];
  const Image seen = rasterize(readPly(output_ + "/y.ply"), view.camera, {}).colour;
  EXPECT_GT(psnr(seen, view.colour), psnr(Image(64, 48, 3, .5f), view.colour) + 3);
}

TEST_F(Program, DecodeRefusesOtherWeightsAndFiles) {
  NEEDS_WEIGHTS();
  Place other;
  other.seen = std::make_shared<SeenSpace>();
  other.encoder_hash = "fedcba9876543210";
  other.dim = 32;
  other.frame.bounds = CoordBBox(Coord(0), Coord(7));
  other.ijk = {Coord(1, 2, 3)};
  other.z.assign(32, 0.f);
  other.generated = {0}, other.probability = {1}, other.bfs_level = {0};
  writeLatentVdb(other, at("other.latent.vdb"));
  const auto decode = [&](const std::string& latents, const std::string& output) {
    return Args{"decode", latents, "-o", output, "--weights", VDBC_WEIGHTS};
  };
  const std::string y = output_ + "/y.vdb";
  expectFailure(decode(at("other.latent.vdb"), y), kFailed, "fedcba9876543210");
  expectFailure(decode(writeVolume(), y), kFailed, at("volume.vdb"));
  expectFailure(decode(at("missing.latent.vdb"), y), kFailed, at("missing.latent.vdb"));
  const std::string whole = readText(at("other.latent.vdb"));
  writeText(at("cut.latent.vdb"), whole.substr(0, whole.size() / 2));
  expectFailure(decode(at("cut.latent.vdb"), y), kFailed, at("cut.latent.vdb"));
  expectFailure(decode(at("other.latent.vdb"), output_ + "/y.ply"), kUsage, "y.ply");
  expectFailure({"decode", at("other.latent.vdb")}, kUsage, "--output");
  const std::string views = writeRoom("views");
  expectFailure({"encode", views, "-o", output_ + "/x.vdb", "--weights", VDBC_WEIGHTS}, kUsage,
                ".latent.vdb");
  expectFailure({"encode", views}, kUsage, "--output");
  expectFailure(
      {"encode", at("missing"), "-o", output_ + "/x.latent.vdb", "--weights", VDBC_WEIGHTS},
      kFailed, at("missing"));
  expectFailure(complete(views, {"--scale", "2"}), kFailed, "metres already");
  expectFailure(complete(views, {"--scale", "0"}), kUsage, "--scale");
}

TEST_F(Program, LatentsOfACompletionAreCompletedAgain) {
  NEEDS_WEIGHTS();
  const Ended first = run(complete(writeRoom("views"), {"--margin", ".4"}));
  ASSERT_EQ(first.code, kOk) << first.err;
  const std::string latents = output_ + "/x.latent.vdb";
  const Place before = readLatentVdb(latents);
  const int32_t last = *std::max_element(before.bfs_level.begin(), before.bfs_level.end());
  ASSERT_GE(last, 3);
  auto again = [&](const Args& more) {
    Args args = {latents, "-o", at("y/y.vdb"), "--weights", VDBC_WEIGHTS, "--json"};
    args.insert(args.end(), more.begin(), more.end());
    const Ended ended = run(args);
    EXPECT_EQ(ended.code, kOk) << ended.err;
    return readLatentVdb(at("y/y.latent.vdb"));
  };
  // The same run from encoded latents: the same bytes.
  EXPECT_EQ(again({}).z, before.z);
  EXPECT_EQ(listing(at("y")), (Args{"y.latent.vdb", "y.ply", "y.points.vdb", "y.vdb"}));
  EXPECT_TRUE(readText(at("y/y.latent.vdb")) == readText(latents));
  // What views saw is found in the files, as exact as they hold it.
  const auto observed = [](const std::string& points) {
    Provenance provenance;
    readPointsVdb(points, &provenance);
    return std::count(provenance.generated.begin(), provenance.generated.end(), uint8_t(0));
  };
  EXPECT_EQ(observed(at("y/y.points.vdb")), observed(output_ + "/x.points.vdb"));
  EXPECT_EQ(readSceneVdb(at("y/y.vdb")).seen_distance->activeVoxelCount(),
            readSceneVdb(output_ + "/x.vdb").seen_distance->activeVoxelCount());
  // Levels below the given one stay, whatever tau is, the others are made anew.
  const Place other =
      again({"--from-level", "2", "--sampling-steps", "2", "--seed", "9", "--tau", ".6"});
  const Place kept = keepRows(before, [&](size_t i) { return before.bfs_level[i] < 2; });
  ASSERT_GT(other.size(), kept.size());
  EXPECT_TRUE(std::equal(kept.ijk.begin(), kept.ijk.end(), other.ijk.begin()));
  EXPECT_TRUE(std::equal(kept.z.begin(), kept.z.end(), other.z.begin()));
  EXPECT_NE(other.z, before.z);
  // Nothing outside of a region, nothing new where it is locked.
  SceneVoxels half;
  half.frame = before.frame;
  const CoordBBox box = half.frame.bounds;
  const int middle = (box.min().x() + box.max().x() + 1) / 2;
  for (auto v = box.begin(); v; ++v) {
    if ((*v).x() >= middle) continue;
    half.ijk.push_back(*v), half.colour_linear.emplace_back(0, 0, 0), half.density.push_back(1);
    half.observed.push_back(1), half.probability.push_back(1), half.bfs_level.push_back(0);
  }
  writeSceneVdb(half, at("half.vdb"));
  auto generatedSides = [&](const Place& g) {
    std::set<bool> sides;
    for (size_t i = 0; i < g.ijk.size(); ++i)
      if (g.generated[i]) sides.insert(g.ijk[i].x() * 2 >= middle);
    return sides;
  };
  ASSERT_EQ(generatedSides(before).size(), 2u);
  EXPECT_EQ(generatedSides(again({"--region", at("half.vdb")})), std::set<bool>{false});
  const Place locked = again({"--lock", at("half.vdb"), "--sampling-steps", "2", "--seed", "9"});
  std::map<Coord, size_t> row;
  for (size_t i = 0; i < locked.ijk.size(); ++i) row[locked.ijk[i]] = i;
  for (size_t i = 0; i < before.ijk.size(); ++i) {
    if (before.ijk[i].x() * 2 >= middle) continue;
    const size_t same = row.at(before.ijk[i]), dim = size_t(locked.dim);
    EXPECT_TRUE(std::equal(&locked.z[same * dim], &locked.z[same * dim] + dim, &before.z[i * dim]));
  }
  for (const Args& more : {Args{"--frames", "0"}, Args{"--margin", "1"}, Args{"--scale", "2"},
                           Args{"--up", "0", "0", "1"}}) {
    Args args = {latents, "-o", at("y/z.vdb"), "--weights", VDBC_WEIGHTS};
    args.insert(args.end(), more.begin(), more.end());
    expectFailure(args, kUsage, more[0]);
  }
  expectFailure({latents, "-o", output_ + "/x.vdb", "--weights", VDBC_WEIGHTS}, kUsage, latents);
  expectFailure({latents, "-o", at("y/z.vdb"), "--weights", VDBC_WEIGHTS, "--from-level", "900"},
                kFailed, "--from-level");
  expectFailure(complete(at("views"), {"--from-level", "2"}), kUsage, "--from-level");
  expectFailure(complete(at("views"), {"--region", at("missing.vdb")}), kFailed, at("missing.vdb"));
}

TEST_F(Program, SeveralSamplesComeWithTheirMeanAndVariance) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views");
  Args options = smallBox();
  options.insert(options.end(),
                 {"--samples", "2", "--sampling-steps", "2", "--generated-context", "--json"});
  const Ended ended = run(complete(views, options));
  ASSERT_EQ(ended.code, kOk) << ended.err;
  Args expected = {"x.occupancy.vdb"};
  for (const char* stem : {"x", "x.2"})
    for (const char* ending : {".latent.vdb", ".ply", ".png", ".points.vdb", ".vdb"})
      expected.push_back(std::string(stem) + ending);
  std::sort(expected.begin(), expected.end());
  EXPECT_EQ(listing(output_), expected);
  EXPECT_FALSE(readText(output_ + "/x.ply") == readText(output_ + "/x.2.ply"));
  // The second is the run with the next seed.
  options.insert(options.end(), {"--seed", "2", "-o", at("z/z.vdb")});
  Args second = {views, "--weights", VDBC_WEIGHTS};
  for (const std::string& o : options) second.push_back(o);
  second.erase(std::find(second.begin(), second.end(), "--samples"),
               std::find(second.begin(), second.end(), "--samples") + 2);
  ASSERT_EQ(run(second).code, kOk);
  EXPECT_TRUE(readText(at("z/z.ply")) == readText(output_ + "/x.2.ply"));
  expectFailure(complete(views, {"--samples", "2"}), kUsage, "--sampling-steps");
}

TEST_F(Program, RethresholdDropsWhatIsLessProbable) {
  NEEDS_WEIGHTS();
  Args options = smallBox();
  options.insert(options.end(), {"--hole-tau", "1", "--tau", ".1"});
  ASSERT_EQ(run(complete(writeRoom("views"), options)).code, kOk);
  const std::string x = output_ + "/x.vdb";
  const SceneVoxels before = readSceneVdb(x);
  std::vector<float> chances;
  for (size_t i = 0; i < before.ijk.size(); ++i)
    if (!before.observed[i]) chances.push_back(before.probability[i]);
  ASSERT_FALSE(chances.empty());
  std::nth_element(chances.begin(), chances.begin() + std::ptrdiff_t(chances.size() / 2),
                   chances.end());
  const float tau = chances[chances.size() / 2];
  const Ended ended =
      run({"rethreshold", x, "--tau", std::to_string(tau), "-o", at("y/y.vdb"), "--json"});
  ASSERT_EQ(ended.code, kOk) << ended.err;
  EXPECT_EQ(listing(at("y")), (Args{"y.ply", "y.points.vdb", "y.vdb"}));
  const SceneVoxels after = readSceneVdb(at("y/y.vdb"));
  std::map<Coord, float> expected, found;
  const float limit = std::stof(std::to_string(tau));
  for (size_t i = 0; i < before.ijk.size(); ++i)
    if (before.observed[i] || before.probability[i] > limit)
      expected[before.ijk[i]] = before.probability[i];
  for (size_t i = 0; i < after.ijk.size(); ++i) found[after.ijk[i]] = after.probability[i];
  EXPECT_EQ(found, expected);
  EXPECT_LT(found.size(), before.ijk.size());
  const json said = json::parse(ended.out);
  EXPECT_EQ(said.at("voxels"), found.size());
  EXPECT_EQ(said.at("dropped_voxels"), before.ijk.size() - found.size());
  Provenance provenance;
  const int64_t gaussians = readPointsVdb(at("y/y.points.vdb"), &provenance).size();
  EXPECT_EQ(gaussians, readPly(at("y/y.ply")).size());
  for (size_t i = 0; i < provenance.generated.size(); ++i)
    EXPECT_TRUE(!provenance.generated[i] || provenance.probability[i] > limit);
  // The surface is that of the voxels that are left.
  ASSERT_TRUE(after.seen_distance);
  const FloatGrid::Ptr surface =
      closedSurface(after.frame, solidVoxels(after), *after.seen_distance);
  const VdbFile file = readVdb("test", at("y/y.vdb"), uint64_t(1) << 30);
  const auto written = findGrid<FloatGrid>("test", file.grids, "surface", "y.vdb");
  ASSERT_EQ(written->activeVoxelCount(), surface->activeVoxelCount());
  const auto values = written->getConstAccessor();
  for (auto value = surface->cbeginValueOn(); value; ++value)
    ASSERT_EQ(values.getValue(value.getCoord()), *value) << value.getCoord();
  // A new run with that tau keeps the same tokens.
  options.back() = std::to_string(tau);
  ASSERT_EQ(run(complete(at("views"), options)).code, kOk);
  auto tokensOf = [](const SceneVoxels& voxels) {
    std::set<Coord> tokens;
    for (const Coord& ijk : voxels.ijk) tokens.insert(tokenCoord(ijk, 1));
    return tokens;
  };
  EXPECT_EQ(tokensOf(readSceneVdb(x)), tokensOf(after));
  expectFailure({"rethreshold", x, "--tau", "0", "-o", output_ + "/z.vdb"}, kFailed, x);
  expectFailure({"rethreshold", writeVolume(), "--tau", ".5", "-o", output_ + "/z.vdb"}, kFailed,
                "points.vdb");
  expectFailure({"rethreshold", output_ + "/x.latent.vdb", "--tau", ".5", "-o", output_ + "/z.vdb"},
                kUsage, "x.latent.vdb");
  expectFailure({"rethreshold", x, "--tau", ".5", "-o", x}, kUsage, x);
  expectFailure({"rethreshold", x, "--tau", "2", "-o", output_ + "/z.vdb"}, kUsage, "--tau");
}

TEST_F(Program, AnInterruptedCompletionIsResumedToTheSameBytes) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views"), checkpoint = output_ + "/x.checkpoint.latent.vdb";
  Args options = {"--sampling-steps", "4", "--json"};
  expectFailure(complete(views, {"--resume"}), kFailed, checkpoint);
  const Ended whole = run(complete(views, options));
  ASSERT_EQ(whole.code, kOk) << whole.err;
  const Place place = readLatentVdb(output_ + "/x.latent.vdb");
  std::map<std::string, std::string> bytes;
  for (const std::string& name : kSiblings) {
    bytes[name] = readText(output_ + "/" + name);
    fs::remove(output_ + "/" + name);
  }
  const Ended cut = run(complete(views, options), "complete", checkpoint);
  ASSERT_EQ(cut.code, kInterrupted) << "it was faster than the signal";
  EXPECT_EQ(listing(output_), Args{"x.checkpoint.latent.vdb"});
  const auto last_level = [](const Place& p) {
    return *std::max_element(p.bfs_level.begin(), p.bfs_level.end());
  };
  EXPECT_LT(last_level(readLatentVdb(checkpoint)), last_level(place));
  expectFailure({"decode", checkpoint, "-o", at("y/y.vdb"), "--weights", VDBC_WEIGHTS}, kFailed,
                "cut short");
  options.push_back("--resume");
  Args other = options;
  other.insert(other.end(), {"--tau", ".3"});
  other.erase(std::find(other.begin(), other.end(), "--json"));
  expectFailure(complete(views, other), kFailed, checkpoint);
  const Ended resumed = run(complete(views, options));
  ASSERT_EQ(resumed.code, kOk) << resumed.err;
  EXPECT_EQ(listing(output_), kSiblings);
  for (const std::string& name : kSiblings)
    EXPECT_TRUE(readText(output_ + "/" + name) == bytes[name]) << name;
}

TEST_F(Program, AnyNumberOfThreadsWritesTheSameBytes) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views", 3);
  std::map<std::string, std::string> first;
  for (const char* threads : {"1", "2", "4"}) {
    SCOPED_TRACE(threads);
    const Ended ended = run(complete(views, {"--threads", threads}));
    ASSERT_EQ(ended.code, kOk) << ended.err;
    for (const std::string& name : kSiblings) {
      const std::string bytes = readText(output_ + "/" + name);
      EXPECT_TRUE(first.emplace(name, bytes).first->second == bytes) << name;
    }
  }
}

TEST_F(Program, OneThreadIsOneThread) {
  NEEDS_WEIGHTS();
  const Ended idle = run({"--version"});
  Args options = smallBox();
  options.insert(options.end(), {"--threads", "1"});
  const Ended ended = run(complete(writeRoom("views"), options));
  ASSERT_EQ(ended.code, kOk) << ended.err;
  EXPECT_EQ(ended.threads, idle.threads);
}

TEST_F(Program, WhereOpenMpMayNotHaveThreadsItStillEnds) {
  NEEDS_WEIGHTS();
  Args options = smallBox();
  options.insert(options.end(), {"--threads", "2"});
  setenv("OMP_THREAD_LIMIT", "1", 1);
  const Ended ended = run(complete(writeRoom("views"), options));
  unsetenv("OMP_THREAD_LIMIT");
  EXPECT_EQ(ended.code, kOk) << ended.err;
}

TEST_F(Program, TheSeedFixesEveryByteOfThePly) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views");
  std::map<std::string, std::string> bytes;
  for (const char* seed : {"5", "5 again", "6"}) {
    Args options = smallBox();
    options.insert(options.end(),
                   {"--sampling-steps", "2", "--seed", std::string(seed).substr(0, 1)});
    const Ended ended = run(complete(views, options));
    ASSERT_EQ(ended.code, kOk) << ended.err;
    bytes[seed] = readText(output_ + "/x.ply");
  }
  EXPECT_TRUE(bytes["5"] == bytes["5 again"]);
  EXPECT_FALSE(bytes["5"] == bytes["6"]) << "the seed has no effect";
}

TEST_F(Program, RenderShowsTheSplatsFromTheCameras) {
  const std::string folder = writeRoom("views");
  const std::vector<View> views = readViews(folder);
  // Every pixel becomes a splat of its size and colour: the pictures come back.
  Gaussians g;
  for (const View& v : views)
    for (int y = 0; y < v.camera.height; ++y)
      for (int x = 0; x < v.camera.width; ++x) {
        const float z = v.depth[size_t(y * v.camera.width + x)];
        if (z <= 0) continue;
        g.mean.push_back(v.camera.unproject(x + .5, y + .5, z).cast<float>());
        g.log_scale.push_back(Eigen::Vector3f::Constant(std::log(.5f * z / float(v.camera.fx))));
        g.rotation.emplace_back(1, 0, 0, 0);
        g.opacity_logit.push_back(5);
        for (int c = 0; c < 3; ++c) g.sh.push_back((v.colour.at(x, y, c) - .5f) / kSh0);
      }
  writePly(g, at("pixels.ply"));
  const Ended ended =
      run({"render", at("pixels.ply"), "--cameras", folder, "-o", output_, "--json"});
  EXPECT_EQ(ended.code, kOk) << ended.err;
  EXPECT_EQ(listing(output_), (Args{"0000.png", "0001.png"}));
  const std::vector<std::string> said = lines(ended.out);
  ASSERT_EQ(said.size(), 2u);
  for (size_t i = 0; i < 2; ++i) {
    const Image shown = readImage(json::parse(said[i]).at("image").get<std::string>());
    ASSERT_EQ(shown.width, 64);
    ASSERT_EQ(shown.height, 48);
    EXPECT_GT(psnr(shown, rasterize(readPly(at("pixels.ply")), views[i].camera, {}).colour), 50);
    EXPECT_GT(psnr(shown, views[i].colour), 15);
    EXPECT_GT(psnr(shown, views[i].colour), psnr(shown, views[1 - i].colour) + 3);
  }
  writePointsVdb(g, {}, at("pixels.points.vdb"));
  const Ended points = run({"render", at("pixels.points.vdb"), "--cameras", folder, "--frames", "1",
                            "--width", "32", "-o", output_ + "/small"});
  EXPECT_EQ(points.code, kOk) << points.err;
  EXPECT_EQ(listing(output_ + "/small"), Args{"0001.png"});  // named by the frame's number
  const Image small = readImage(output_ + "/small/0001.png");
  EXPECT_EQ(small.width, 32);
  EXPECT_EQ(small.height, 24);
  EXPECT_GT(psnr(small, rasterize(g, resized(views[1].camera, 32, 24), {}).colour), 30);
}

TEST_F(Program, RenderGoesRoundAndAlong) {
  const std::string splats = writeSplats(), views = writeRoom("views", 3);
  const Ended turn =
      run({"render", splats, "--turntable", "12", "--size", "40", "30", "--fov", "50", "--frames",
           "0,10-11", "-o", output_ + "/turn.###.exr", "--preview", "--json"});
  EXPECT_EQ(turn.code, kOk) << turn.err;
  EXPECT_EQ(listing(output_), (Args{"turn.000.exr", "turn.000.png", "turn.010.exr", "turn.010.png",
                                    "turn.011.exr", "turn.011.png"}));
  ASSERT_EQ(lines(turn.out).size(), 3u);
  const json said = json::parse(lines(turn.out)[1]);
  EXPECT_EQ(said.at("frame"), 10);
  EXPECT_EQ(said.at("image"), output_ + "/turn.010.exr");
  EXPECT_EQ(said.at("preview"), output_ + "/turn.010.png");
  EXPECT_NE(turn.err.find("{\"stage\": \"render\", \"percent\": 66"), std::string::npos)
      << turn.err;
  EXPECT_EQ(readImage(output_ + "/turn.010.png").width, 40);

  const Ended flight =
      run({"render", splats, "--cameras", views, "--flythrough", "5", "-o", output_ + "/flight"});
  EXPECT_EQ(flight.code, kOk) << flight.err;
  EXPECT_EQ(listing(output_ + "/flight"),
            (Args{"0000.png", "0001.png", "0002.png", "0003.png", "0004.png"}));
  const Gaussians g = readPly(splats);
  const std::vector<View> through = readViews(views);
  for (size_t i = 0; i < 3; ++i)  // every other frame is a view's
    EXPECT_GT(psnr(readImage(output_ + "/flight/000" + std::to_string(2 * i) + ".png"),
                   rasterize(g, through[i].camera, {}).colour),
              45);
}

TEST_F(Program, RenderRefusesContradictions) {
  const std::string splats = writeSplats(), views = writeRoom("views"), x = output_ + "/####.png";
  expectFailure({"render", splats, "--turntable", "4", "--cameras", views, "-o", x}, kUsage,
                "--cameras");
  expectFailure({"render", splats, "--turntable", "4", "--flythrough", "4", "-o", x}, kUsage,
                "--flythrough");
  expectFailure({"render", splats, "--flythrough", "4", "-o", x}, kUsage, "--cameras");
  expectFailure({"render", splats, "--flythrough", "4", "--cameras", views + "/transforms.json",
                 "--frames", "4", "-o", x},
                kUsage, "--frames");
  expectFailure({"render", splats, "--turntable", "0", "-o", x}, kUsage, "--turntable");
  expectFailure({"render", splats, "--turntable", "4", "-o", output_ + "/one.png"}, kUsage, "####");
  expectFailure({"render", splats, "--turntable", "4", "--preview", "-o", x}, kUsage, "--preview");
  expectFailure({"render", splats, "--turntable", "4", "--size", "0", "9", "-o", x}, kUsage,
                "--size");
  expectFailure({"render", splats, "--turntable", "4", "--fov", "180", "-o", x}, kUsage, "--fov");
  expectFailure({"render", splats, "--turntable", "4", "--up", "0", "0", "0", "-o", x}, kUsage,
                "--up");
  expectFailure({"render", splats, "--turntable", "4", "-o", at("splats.ply") + "/x.####.png"},
                kFailed, "splats.ply");
}

TEST_F(Program, AnInterruptOfRenderLeavesWholeFrames) {
  const std::string splats = writeSplats();
  const Ended ended = run({"render", splats, "--turntable", "100000", "--size", "64", "64", "-o",
                           output_ + "/######.exr", "--json"},
                          "render");
  EXPECT_EQ(ended.code, kInterrupted);
  EXPECT_EQ(lines(ended.err).back(), "vdb_complete: interrupted");
  const Args files = listing(output_);
  EXPECT_EQ(lines(ended.out).size(), files.size());
  for (const std::string& name : files) {
    EXPECT_EQ(name.size(), 10u) << name;  // 000000.exr, nothing temporary
    EXPECT_NE(readText(output_ + "/" + name).find("worldToNDC"), std::string::npos);
  }
}

TEST_F(Program, CheckFindsCarvedVoxelsInAgreement) {
  const std::string folder = writeRoom("views");
  const std::vector<View> views = readViews(folder);
  std::vector<DepthView> depth;
  size_t rays = 0;
  for (const View& v : views) {
    depth.push_back(v.depthView());
    rays += size_t(std::count_if(v.depth.begin(), v.depth.end(), [](float z) { return z > 0; }));
  }
  CarveSettings all;
  all.flying_pixel_ratio = 0;
  SceneVoxels v;
  v.frame = fitVolume(depth, {}, all);
  const SeenSpace space = carveByTraversal(v.frame, depth, all);
  for (auto voxel = space.filled.cbeginValueOn(); voxel; ++voxel) {
    v.ijk.push_back(voxel.getCoord());
    v.colour_linear.emplace_back(.5f, .5f, .5f);
    v.density.push_back(1), v.observed.push_back(1), v.probability.push_back(1),
        v.bfs_level.push_back(0);
  }
  writeSceneVdb(v, at("carved.vdb"));
  const Ended ended = run({"check", folder, at("carved.vdb"), "--json"});
  EXPECT_EQ(ended.code, kOk) << ended.err;
  const json result = json::parse(ended.out);
  EXPECT_EQ(result.at("voxels"), v.ijk.size());
  EXPECT_EQ(result.at("rays"), rays);
  // Voxels hold the points: no ray goes past its own but for points outside the trimmed volume.
  EXPECT_LT(result.at("missed").get<double>(), .01);
  EXPECT_LT(result.at("median_depth_error_m").get<double>(), v.frame.voxel_m * std::sqrt(3.));
  EXPECT_GT(result.at("within_two_voxels").get<double>(), .8);
  EXPECT_GT(result.at("open_directions").get<double>(), 0);  // two views see a part of the room
  EXPECT_LT(result.at("open_directions").get<double>(), 1);
}

TEST_F(Program, AnInterruptLeavesNothing) {
  NEEDS_WEIGHTS();
  const std::string views = writeRoom("views");
  Args options = smallBox();
  options.push_back("--json");
  for (const char* stage : {"read", "complete", "write"}) {
    SCOPED_TRACE(stage);
    const Ended ended = run(complete(views, options), stage);
    ASSERT_FALSE(ended.err.empty());
    if (ended.code == kOk) {  // it was faster than the signal
      EXPECT_EQ(listing(output_), kSiblings);
      for (const std::string& name : kSiblings) fs::remove(output_ + "/" + name);
      continue;
    }
    EXPECT_EQ(ended.code, kInterrupted);
    EXPECT_EQ(ended.out, "");
    EXPECT_EQ(lines(ended.err).back(), "vdb_complete: interrupted");
    fs::remove(output_ + "/x.checkpoint.latent.vdb");  // where it goes on
    EXPECT_EQ(listing(output_), Args{});
  }
  // What was there before stays.
  for (const std::string& name : kSiblings) writeText(output_ + "/" + name, "older");
  if (run(complete(views, options), "read").code != kInterrupted) return;
  EXPECT_EQ(listing(output_), kSiblings);
  for (const std::string& name : kSiblings) EXPECT_EQ(readText(output_ + "/" + name), "older");
}

}  // namespace
}  // namespace vdbc
