// Laws of threads: any number gives the same bytes, calls may overlap, one is one.
#include "vdb/threads.h"

#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <tbb/global_control.h>
#include <unistd.h>

#include <cstring>
#include <filesystem>
#include <thread>

#include "encoder/layers.h"
#include "houdini_style_tools/complete.h"
#include "tests/simple_room.h"

namespace vdbc {
namespace {

int threadsOfProcess() {
  const std::filesystem::directory_iterator tasks("/proc/self/task");
  return int(std::distance(begin(tasks), end(tasks)));
}

TEST(Arena, BoundsWhatRunsInIt) {
  EXPECT_EQ(withThreads(3, [] { return tbb::this_task_arena::max_concurrency(); }), 3);
  const int all = tbb::this_task_arena::max_concurrency();
  EXPECT_EQ(withThreads(0, [] { return tbb::this_task_arena::max_concurrency(); }), all);
}

TEST(Inference, SetsItsOwnThreadAndPutsItBack) {
  at::set_num_threads(3);  // as a host may have it
  {
    const Inference inference;
    EXPECT_EQ(at::get_num_threads(), 1);
    EXPECT_FALSE(at::GradMode::is_enabled());
    std::thread([] { EXPECT_EQ(at::get_num_threads(), 3); }).join();
    inTasks(16, [](int64_t) {
      EXPECT_EQ(at::get_num_threads(), 1);
      EXPECT_FALSE(at::GradMode::is_enabled());
    });
  }
  EXPECT_EQ(at::get_num_threads(), 3);
  EXPECT_TRUE(at::GradMode::is_enabled());
  at::set_num_threads(1);
}

TEST(Inference, WithGradientsPiecesComeInOrder) {
  std::vector<int64_t> order;
  inTasks(5, [&](int64_t i) { order.push_back(i); });
  EXPECT_EQ(order, (std::vector<int64_t>{0, 1, 2, 3, 4}));
}

TEST(Inference, AnErrorInAPieceIsThrown) {
  const Inference inference;
  EXPECT_THROW(inTasks(9, [](int64_t i) { require(i != 4, "piece ", i); }), Error);
}

TEST(Inference, BlocksOfRowsAreTheWhole) {
  torch::manual_seed(3);
  SelfBlock block(24, 2);
  std::vector<Coord> coords;
  for (int i = 0; i < 1300; ++i) coords.emplace_back(i % 13, i / 13 % 10, i / 130);
  const Tensor x = torch::randn({1300, 24}), context = torch::randn({300, 24});
  const Rotary pos = rotary(coordTensor(coords), 12, {});
  const auto self = [&] { return block.forward(x, &pos); };
  const auto guided = [&] {
    return block.attention->guided(x, context, torch::full({1}, .5f), [&](const Tensor& values) {
      return values.mean(0, true).expand({1300, 24});
    });
  };
  const Tensor whole = self(), whole_guided = guided();  // with gradients nothing is parted
  const Inference inference;
  EXPECT_LT((self() - whole).abs().max().item<float>(), 1e-5);
  EXPECT_LT((guided() - whole_guided).abs().max().item<float>(), 1e-5);
}

/// The main job on a room, by the shipped weights.
class MainJob : public testing::Test {
 protected:
  struct Result {
    Place place;
    DecodedGrid decoded;
  };

  static std::string weights(const std::string& name) {
    return VDBC_SOURCE_DIR "/weights/indoor/" + name + ".safetensors";
  }
  Result run(int threads) const {
    SceneSettings settings;
    settings.threads = threads;
    settings.completion.sampling_steps = 2;  // draws random numbers
    settings.completion.temperature = .5;
    Progress silent;
    Place place = completeScene(views_, encoder_, completer_, settings, silent);
    DecodedGrid decoded = withThreads(
        threads, [&] { return encoder_.decode(place, settings.child_threshold, silent); });
    return {std::move(place), std::move(decoded)};
  }
  static void expectSame(const Result& a, const Result& b) {
    EXPECT_TRUE(equalRows(a.place, b.place));
    EXPECT_EQ(a.decoded.voxels, b.decoded.voxels);
    EXPECT_EQ(a.decoded.child_probability, b.decoded.child_probability);
    EXPECT_TRUE(equalRows(a.decoded.gaussians, b.decoded.gaussians));
  }

  const std::vector<View> views_ = simpleRoomViews(3, 160, 120, 7);
  const Encoder encoder_{weights("encoder")};
  const Completer completer_{weights("completer")};
};

TEST_F(MainJob, AnyNumberOfThreadsGivesTheSameBytes) {
  const tbb::global_control cores(tbb::global_control::max_allowed_parallelism, 4);
  const Result one = run(1);
  // Several windows, chunks and pieces, else there is nothing to share out.
  EXPECT_GT(observedPart(one.place).size(), 2 * encoder_.config().window);
  EXPECT_GT(one.place.size(), 4 * completer_.config().chunk_tokens);
  EXPECT_GT(one.decoded.voxels.size(), 4096u);
  for (int threads : {2, 4}) {
    SCOPED_TRACE(threads);
    expectSame(run(threads), one);
  }
}

TEST_F(MainJob, CallsThatOverlapGiveWhatSerialOnesGive) {
  const Result alone = run(0);
  Result together[2];
  std::vector<std::thread> callers;
  for (Result& r : together) callers.emplace_back([&] { r = run(0); });
  for (std::thread& caller : callers) caller.join();
  for (const Result& r : together) expectSame(r, alone);
}

using MainJobDeathTest = MainJob;

TEST_F(MainJobDeathTest, NoThreadIsStartedForOneWhateverTheHostHasSet) {
  GTEST_FLAG_SET(death_test_style, "threadsafe");  // a process of its own
  EXPECT_EXIT(
      {
        at::set_num_threads(4);
        const int before = threadsOfProcess();
        run(1);
        _exit(threadsOfProcess() - before);
      },
      testing::ExitedWithCode(0), "");
}

}  // namespace
}  // namespace vdbc
