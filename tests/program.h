#pragma once
// A program as its users meet it: exit codes, error lines, what is left behind, what is written.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "encoder/views/read_views.h"
#include "splat/image_files.h"
#include "splat/ply.h"
#include "splat/points_vdb.h"
#include "splat/rasterize.h"
#include "splat/view.h"
#include "tests/simple_room.h"
#include "tests/view_files.h"
#include "vdb/error.h"
#include "vdb/fit_volume.h"
#include "vdb/latent_vdb.h"
#include "vdb/scene_vdb.h"

#ifndef VDBC_WEIGHTS
#define VDBC_WEIGHTS VDBC_SOURCE_DIR "/weights/indoor"
#endif

extern char** environ;

namespace vdbc {

namespace fs = std::filesystem;
using nlohmann::json;
using Args = std::vector<std::string>;

constexpr int kOk = 0, kFailed = 1, kUsage = 2, kInterrupted = 130;
const Args kSiblings = {"x.latent.vdb", "x.ply", "x.png", "x.points.vdb", "x.vdb"};  // sorted

inline std::string readText(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), std::istreambuf_iterator<char>()};
}

inline void writeText(const std::string& path, const std::string& text) {
  std::ofstream(path, std::ios::binary) << text;
}

inline std::vector<std::string> lines(const std::string& text) {
  std::vector<std::string> result;
  std::stringstream in(text);
  for (std::string line; std::getline(in, line);) result.push_back(line);
  return result;
}

// Everything below a folder, sorted.
inline Args listing(const std::string& folder) {
  Args names;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    names.push_back(fs::relative(entry.path(), folder).string());
  std::sort(names.begin(), names.end());
  return names;
}

inline int threadsOf(pid_t process) {
  std::error_code ended;
  const fs::directory_iterator tasks("/proc/" + std::to_string(process) + "/task", ended);
  return ended ? 0 : int(std::distance(begin(tasks), end(tasks)));
}

// How a run ended: its exit code, or 128 + the signal that killed it, as a shell says.
struct Ended {
  int code = -1;
  int threads = 0;  // the most at a time, those that libraries start at load among them
  std::string out, err;
};

// A scratch folder with small inputs, and the program to run on them.
class Program : public ::testing::Test {
 protected:
  explicit Program(std::string program = VDBC_PROGRAM) : program_(std::move(program)) {}
  void SetUp() override {
    std::string name = (fs::temp_directory_path() / "vdbc_program_XXXXXX").string();
    ASSERT_NE(mkdtemp(name.data()), nullptr);
    root_ = name;
    output_ = root_ + "/out";
    fs::create_directory(output_);
  }
  void TearDown() override {
    std::error_code ignored;
    fs::remove_all(root_, ignored);
  }

  std::string at(const std::string& name) const { return root_ + "/" + name; }

  // Starts the program; with `signal_at`, sends SIGINT once that stage has begun (needs --json) and
  // that file is there.
  Ended run(const Args& args, const std::string& signal_at = "",
            const std::string& file = "") const {
    const std::string out = at("stdout.txt"), err = at("stderr.txt");
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    const int flags = O_WRONLY | O_CREAT | O_TRUNC;
    posix_spawn_file_actions_addopen(&actions, 0, "/dev/null", O_RDONLY, 0);
    posix_spawn_file_actions_addopen(&actions, 1, out.c_str(), flags, 0600);
    posix_spawn_file_actions_addopen(&actions, 2, err.c_str(), flags, 0600);
    std::vector<char*> argv = {const_cast<char*>(program_.c_str())};
    for (const std::string& a : args) argv.push_back(const_cast<char*>(a.c_str()));
    argv.push_back(nullptr);
    writeText(err, "");
    pid_t pid = 0;
    const int failure =
        posix_spawn(&pid, program_.c_str(), &actions, nullptr, argv.data(), environ);
    posix_spawn_file_actions_destroy(&actions);
    Ended ended;
    EXPECT_EQ(failure, 0) << "cannot start " << program_;
    if (failure) return ended;
    int status = 0;
    bool signalled = signal_at.empty();
    const std::string begun = "{\"stage\": \"" + signal_at + "\"";
    while (waitpid(pid, &status, WNOHANG) == 0) {
      ended.threads = std::max(ended.threads, threadsOf(pid));
      if (!signalled && readText(err).find(begun) != std::string::npos &&
          (file.empty() || fs::exists(file))) {
        kill(pid, SIGINT);
        signalled = true;
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    ended.code = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
    ended.out = readText(out), ended.err = readText(err);
    return ended;
  }

  // A failure: this exit code, nothing on stdout, one line on stderr that says `named`, and the
  // output folder as it was.
  void expectFailure(const Args& args, int code, const std::string& named) const {
    std::string command;
    for (const std::string& a : args) command += " " + a;
    const std::string program = fs::path(program_).filename().string();
    SCOPED_TRACE(program + command);
    const Args before = listing(output_);
    const Ended ended = run(args);
    EXPECT_EQ(ended.code, code);
    EXPECT_EQ(ended.out, "");
    EXPECT_EQ(std::count(ended.err.begin(), ended.err.end(), '\n'), 1) << ended.err;
    EXPECT_EQ(ended.err.rfind(program + ": ", 0), 0u) << ended.err;
    EXPECT_NE(ended.err.find(named), std::string::npos)
        << ended.err << "expected to name: " << named;
    EXPECT_EQ(listing(output_), before);
  }

  Args complete(const std::string& views, const Args& more = {}) const {
    Args args = {views, "-o", output_ + "/x.vdb", "--weights", VDBC_WEIGHTS};
    args.insert(args.end(), more.begin(), more.end());
    return args;
  }

  // Bad views: the message names `named`, or else the views.
  void expectBadViews(const std::string& views, const std::string& named = "",
                      const Args& more = {}) const {
    expectFailure(complete(views, more), kFailed, named.empty() ? views : named);
  }

  // Views of a room, small enough to complete in a second.
  static std::vector<View> roomViews(int count) { return simpleRoomViews(count, 64, 48, 7); }

  std::string writeRoom(const std::string& name, int count = 2) const {
    writeViews(roomViews(count), at(name));
    return at(name);
  }

  // A box of 1.6 m around what the first view looks at: completed in half a second.
  static Args smallBox() {
    const View view = roomViews(1)[0];
    const Camera& c = view.camera;
    const int x = c.width / 2, y = c.height / 2;
    const Eigen::Vector3d centre = c.unproject(x + .5, y + .5, view.depth[size_t(y * c.width + x)]);
    Args args = {"--bounds"};
    for (double side : {-.8, .8})
      for (int axis = 0; axis < 3; ++axis) args.push_back(std::to_string(centre[axis] + side));
    return args;
  }

  // Every voxel of a small box, for files to damage.
  std::string writeVolume() const {
    SceneVoxels v;
    v.frame.bounds = CoordBBox(Coord(0), Coord(7));
    for (auto i = CoordBBox(Coord(0), Coord(3)).begin(); i; ++i) {
      v.ijk.push_back(*i);
      v.colour_linear.emplace_back(.2f, .4f, .6f);
      v.density.push_back(1), v.observed.push_back(1), v.probability.push_back(1),
          v.bfs_level.push_back(0);
    }
    writeSceneVdb(v, at("volume.vdb"));
    return at("volume.vdb");
  }

  std::string writeSplats() const {
    Gaussians g;
    g.resize(50, 0);
    for (size_t i = 0; i < 50; ++i) {
      g.mean[i] = Eigen::Vector3f(float(i % 7), float(i % 5), float(i % 3));
      g.log_scale[i] = Eigen::Vector3f::Constant(-2);
      g.rotation[i] = Eigen::Vector4f(1, 0, 0, 0);
      g.opacity_logit[i] = 2;
    }
    writePly(g, at("splats.ply"));
    return at("splats.ply");
  }

  const std::string program_;
  std::string root_, output_;
};

inline bool haveWeights() {
  return fs::exists(VDBC_WEIGHTS "/encoder.safetensors") &&
         fs::exists(VDBC_WEIGHTS "/completer.safetensors");
}
#define NEEDS_WEIGHTS() \
  if (!haveWeights()) GTEST_SKIP() << "no trained weights in " << VDBC_WEIGHTS

}  // namespace vdbc
