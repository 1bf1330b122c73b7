// vdb_lab as its users meet it.
#include "tests/program.h"

namespace vdbc {
namespace {

class Lab : public Program {
 protected:
  Lab() : Program(VDBC_LAB) {}
};

// ---- the command line

TEST_F(Lab, UsageErrorsExitWith2) {
  expectFailure({}, kUsage, "verb");
  expectFailure({"train"}, kUsage, "verb");
  expectFailure({"frobnicate"}, kUsage, "verb");
  expectFailure({"eval"}, kUsage, "--scenes");
  for (const char* change : {"width", "none=1", "width=wide", "width=7"})
    expectFailure({"train", "encoder", "-o", at("w.safetensors"), "--set", change}, kUsage,
                  "--set");
  expectFailure({"train", "mar", "-o", at("w.safetensors")}, kUsage, "--encoder");
  expectFailure({"train", "encoder", "-o", output_}, kUsage, output_);
  writeText(at("file"), "");
  expectFailure(
      {"train", "encoder", "-o", at("file") + "/x.safetensors", "--work", output_ + "/work"},
      kFailed, at("file"));
  expectFailure({"make_rooms", "rooms", "-o", output_ + "/rooms"}, kUsage, "--seeds");
  for (const char* seeds : {"3-", "2-1", "0,,1", "one", "0-100000"})
    expectFailure({"make_rooms", "rooms", "-o", output_ + "/rooms", "--seeds", seeds}, kUsage,
                  seeds);
  expectFailure({"make_rooms", "homes", "-o", output_ + "/homes", "--size", "4"}, kUsage, "--size");
  expectFailure({"pack", "-o", output_ + "/packed"}, kUsage, "--seeds");
  expectFailure({"pack", "-o", output_ + "/packed", "--seeds", "2147483648"}, kUsage, "--seeds");
  expectFailure({"train", "mar", "-o", at("w.safetensors"), "--encoder", "e.safetensors",
                 "--packed", at("packed"), "--rooms", "3"},
                kUsage, "--rooms");
}

TEST_F(Lab, HelpListsEveryVerb) {
  const Ended front = run({"--help"});
  EXPECT_EQ(front.code, kOk);
  for (const char* verb : {"train encoder", "train mar", "pack", "eval", "tables", "compare",
                           "make_rooms rooms", "make_rooms homes", "make_rooms models",
                           "make_rooms statistics", "make_rooms attribution", "make_rooms table"})
    EXPECT_NE(front.out.find(std::string("\n  ") + verb + " "), std::string::npos) << verb;
}

// ---- what it does

TEST_F(Lab, EvalRefusesTrainingRooms) {
  for (const char* seed : {"900000", "1000005", "1099999"})
    expectFailure({"eval", "--scenes", std::string("rooms:") + seed, "--weights", VDBC_WEIGHTS},
                  kFailed, seed);
  expectFailure({"eval", "--scenes", "rooms:899999-900000", "--weights", VDBC_WEIGHTS}, kFailed,
                "900000");
  expectFailure({"eval", "--scenes", "rooms:one"}, kUsage, "rooms:one");
  for (const char* option : {"--lpips", "--features"})
    expectFailure({"eval", "--scenes", "rooms:1", option, at("none.pt")}, kFailed, option);
  expectFailure({"eval", "--scenes", at("missing"), "--weights", VDBC_WEIGHTS}, kFailed,
                at("missing"));
}

TEST_F(Lab, EvalPrintsEveryMethodOnce) {
  NEEDS_WEIGHTS();
  const std::string folder = writeRoom("views", 3);
  const Ended ended =
      run({"eval", "--scenes", folder, "--views", "2", "--weights", VDBC_WEIGHTS, "--coarse-tau",
           "1", "--taus", ".2", "0.75", "--pictures", at("pictures"), "--json"});
  ASSERT_EQ(ended.code, kOk) << ended.err;
  std::map<std::string, int> scene, mean;
  for (const std::string& line : lines(ended.out)) {
    const json result = json::parse(line);
    ++(result.at("scene") == "mean" ? mean : scene)[result.at("method").get<std::string>()];
    EXPECT_GT(result.at("psnr").get<double>(), 0);
    EXPECT_GT(result.at("flip").get<double>(), 0);
    EXPECT_LT(result.at("flip").get<double>(), 1);
    EXPECT_TRUE(result.at("lpips").is_null());  // no network was given
    for (const char* of_truth :
         {"f1", "iou", "shell_recall", "furniture_recall", "outside", "ece", "leak"})
      EXPECT_TRUE(result.at(of_truth).is_null()) << of_truth;
    // Judged by the other views.
    for (const char* share : {"near_recall", "near_f1", "blocked", "right", "behind", "open"}) {
      EXPECT_GE(result.at(share).get<double>(), 0) << share;
      EXPECT_LE(result.at(share).get<double>(), 1) << share;
    }
    if (result.at("method") != "box") {
      EXPECT_GT(result.at("depth_rmse_m").get<double>(), result.at("depth_median_m").get<double>());
      EXPECT_GT(result.at("depth_share").get<double>(), 0);
    }
  }
  const std::map<std::string, int> once = {
      {"box", 1},          {"completed", 1}, {"completed-tau-0.2", 1}, {"completed-tau-0.75", 1},
      {"nearest", 1},      {"observed", 1},  {"oracle-latents", 1},    {"oracle-occupancy", 1},
      {"pixel-aligned", 1}};
  EXPECT_EQ(scene, once);
  EXPECT_EQ(mean, once);
  const Image sheet = readImage(at("pictures/0.png"));
  const View view = readViews(folder).front();
  // Truth, observed, nearest, box, completed and both oracles; the one other view.
  EXPECT_EQ(sheet.width, 7 * view.camera.width);
  EXPECT_EQ(sheet.height, view.camera.height);
  expectFailure({"eval", "--scenes", folder, "--views", "3", "--weights", VDBC_WEIGHTS}, kFailed,
                folder);
}

TEST_F(Lab, EvalReconstructNeedsOnlyTheEncoder) {
  NEEDS_WEIGHTS();
  const std::string folder = writeRoom("views", 3), weights = at("weights");
  fs::create_directory(weights);
  fs::copy(VDBC_WEIGHTS "/encoder.safetensors", weights);
  const Ended ended = run({"eval", "--reconstruct", "--scenes", folder, "--views", "2", "--weights",
                           weights, "--optimise", "0.2", "--pictures", at("pictures"), "--json"});
  ASSERT_EQ(ended.code, kOk) << ended.err;
  Args methods;
  for (const std::string& line : lines(ended.out)) {
    const json result = json::parse(line);
    methods.push_back(result.at("scene").get<std::string>() == "mean" ? "mean"
                                                                      : result.at("method"));
    EXPECT_EQ(result.at("views"), 2);
    EXPECT_TRUE(result.at("leak").is_null());  // no truth
    for (const char* kind : {"input", "other"}) {
      EXPECT_GT(result.at(std::string(kind) + "_psnr").get<double>(), 5);
      EXPECT_GT(result.at(std::string(kind) + "_flip").get<double>(), 0);
    }
    EXPECT_EQ(result.at("decode_seconds").is_null(), result.at("method") != "reconstructed");
  }
  EXPECT_EQ(methods, (Args{"reconstructed", "detail", "voxel-mean", "pixel-aligned", "optimised",
                           "mean", "mean", "mean", "mean", "mean"}));
  const Image sheet = readImage(at("pictures/0.png"));
  EXPECT_EQ(sheet.width % 6, 0);   // the truth and five methods
  EXPECT_EQ(sheet.height % 3, 0);  // two input views and the one other
}

TEST_F(Lab, TrainingRefusesAStartThatIsNoCompleterBeforeAnyWork) {
  NEEDS_WEIGHTS();
  for (const std::string& from :
       {at("missing.safetensors"), std::string(VDBC_WEIGHTS "/encoder.safetensors")}) {
    expectFailure({"train", "mar", "--encoder", VDBC_WEIGHTS "/encoder.safetensors", "--from", from,
                   "-o", at("new.safetensors")},
                  kFailed, from);
    EXPECT_FALSE(fs::exists(at("new.safetensors.work")));
  }
}

TEST_F(Lab, PackedRoomsAreTheSameOnAnyNumberOfThreadsAndAreLeftAlone) {
  NEEDS_WEIGHTS();
  if (!AssetLibrary::isInstalled()) GTEST_SKIP() << "sweethome3d is not installed";
  const std::string room = "1000001";
  for (const std::string threads : {"1", "2"}) {
    const std::string folder = at("packed" + threads);
    const Args args = {"pack",      "--seeds",    room,        "-o",    folder,
                       "--weights", VDBC_WEIGHTS, "--threads", threads, "--json"};
    const Ended ended = run(args);
    ASSERT_EQ(ended.code, kOk) << ended.err;
    const json result = json::parse(ended.out);
    EXPECT_EQ(result.at("room"), 1000001);
    EXPECT_EQ(result.at("conditions"), 7);
    EXPECT_EQ(result.at("bytes"), fs::file_size(folder + "/" + room + ".xz"));
    EXPECT_LT(result.at("bytes"), 200000);
    EXPECT_EQ(run(args).out, "");  // it is there
  }
  for (const char* file : {".xz", ".surfaces.xz"})
    EXPECT_TRUE(readText(at("packed1/" + room + file)) == readText(at("packed2/" + room + file)))
        << file;
}

TEST_F(Lab, EvalReconstructRefusesOptionsOfTheCompletion) {
  const Args reconstruct = {"eval", "--scenes", "rooms:1", "--reconstruct"};
  for (const Args& more : std::vector<Args>{{"--tau", ".1"},
                                            {"--taus", ".1"},
                                            {"--random-order"},
                                            {"--lpips", "x.pt"},
                                            {"--refine-observed"},
                                            {"--optimise", "-1"},
                                            {"--optimise", "nan"}}) {
    Args args = reconstruct;
    args.insert(args.end(), more.begin(), more.end());
    expectFailure(args, kUsage, more[0]);
  }
  expectFailure({"eval", "--scenes", "rooms:1", "--optimise", "1"}, kUsage, "--reconstruct");
}

}  // namespace
}  // namespace vdbc
