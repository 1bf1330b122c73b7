#include "examples/lab/perceptual.h"

#include <gtest/gtest.h>
#include <torch/csrc/jit/api/module.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <functional>

#include "vdb/error.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

class Perceptual : public testing::Test {
 protected:
  Perceptual() { fs::create_directories(folder_); }
  ~Perceptual() override { fs::remove_all(folder_); }

  /// A network with this body of forward.
  std::string network(const std::string& body,
                      const std::string& arguments = "reference, test") const {
    torch::jit::Module m("net");
    m.define("def forward(self, " + arguments + "):\n  " + body + "\n");
    m.save(folder_ + "/net.pt");
    return folder_ + "/net.pt";
  }

  static void expectError(const std::string& part, const std::function<void()>& run) {
    try {
      run();
      ADD_FAILURE() << "was taken; expected an error with " << part;
    } catch (const Error& e) {
      const std::string message = e.what();
      EXPECT_NE(message.find(part), std::string::npos) << message;
      EXPECT_EQ(message.find('\n'), std::string::npos) << message;
    }
  }

  const std::string folder_ =
      (fs::temp_directory_path() / ("vdbc_perceptual_" + std::to_string(getpid()))).string();
};

Image checkers(int phase) {
  Image image(20, 12, 3);
  for (int y = 0; y < 12; ++y)
    for (int x = 0; x < 20; ++x)
      for (int c = 0; c < 3; ++c)
        image.at(x, y, c) = (x / 4 + y / 3 + phase) % 2 ? .2f * float(c + 1) : .9f;
  return image;
}

TEST_F(Perceptual, GivesTheNetworkPicturesInMinusOneToOne) {
  const PerceptualNet net(network("return (reference - test).abs().mean()"));
  EXPECT_EQ(net.distance(checkers(0), checkers(0)), 0);
  // All pixels differ by 2 |.9 - .2 (c + 1)|, c = 0, 1, 2.
  EXPECT_NEAR(net.distance(checkers(0), checkers(1)), 2 * (.7 + .5 + .3) / 3, 1e-6);
  const PerceptualNet first(network("return reference[0, 2, 1, 4].reshape([1, 1, 1, 1])"));
  EXPECT_NEAR(first.distance(checkers(0), checkers(1)), 2 * .6 - 1, 1e-6);  // [1, 3, H, W]
  const PerceptualNet number(network("return float(test.max())"));
  EXPECT_NEAR(number.distance(checkers(0), checkers(1)), .8, 1e-6);
}

TEST_F(Perceptual, RefusesWhatIsNoNetworkOfTwoPictures) {
  expectError("no such file", [&] { PerceptualNet(folder_ + "/none.pt"); });
  std::ofstream(folder_ + "/text.pt") << "hello";
  expectError("not a TorchScript network", [&] { PerceptualNet(folder_ + "/text.pt"); });
  torch::jit::Module empty("net");
  empty.save(folder_ + "/empty.pt");
  expectError("forward", [&] { PerceptualNet(folder_ + "/empty.pt"); });
  const PerceptualNet map(network("return (reference - test).abs()"));
  expectError("expected one number", [&] { map.distance(checkers(0), checkers(1)); });
  const PerceptualNet three(network("return torch.mm(reference, test)"));
  expectError("the network failed", [&] { three.distance(checkers(0), checkers(1)); });
  const PerceptualNet nan(network("return (reference - test).abs().mean() * float('nan')"));
  expectError("expected a finite number", [&] { nan.distance(checkers(0), checkers(1)); });
  expectError("one size", [&] { nan.distance(checkers(0), Image(3, 3, 3)); });
}

TEST_F(Perceptual, FeaturesOfOnePicture) {
  const FeatureNet net(network("return image.mean([2, 3])", "image"));
  const std::vector<float> features = net.features(Image(4, 4, 3, .75f));
  ASSERT_EQ(features.size(), 3u);
  for (float f : features) EXPECT_NEAR(f, .5f, 1e-6);
  const FeatureNet nan(network("return image * float('nan')", "image"));
  expectError("finite features", [&] { nan.features(checkers(0)); });
  const FeatureNet number(network("return 3.0", "image"));
  expectError("expected features", [&] { number.features(checkers(0)); });
  expectError("--features", [&] { FeatureNet(folder_ + "/none.pt"); });
}

}  // namespace
}  // namespace vdbc
