// Laws of the encoder-decoder and of its training (docs/method.md, sections 2 and 3; numbers behind
// tests are its sections), on networks of toy size.
#include "encoder/encoder.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <set>

#include "encoder/encoder_train.h"
#include "encoder/network.h"
#include "encoder/trainer.h"
#include "encoder/weights.h"
#include "splat/rasterize_torch.h"
#include "tests/expect_error.h"
#include "tests/files.h"
#include "tests/simple_room.h"
#include "tests/toy_completer.h"
#include "vdb/fit_volume.h"
#include "vdb/frontier.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

// --- scenes and networks of toy size -----------------------------------------------------------

/// Views of one room, 64 x 48 pixels.
std::vector<View> roomViews(size_t count) {
  static const std::vector<View> all = simpleRoomViews(16, 64, 48, 42);
  return {all.begin(), all.begin() + std::ptrdiff_t(count)};
}

/// A wall close to a small camera: a handful of voxels.
View nearWall(int side, float distance) {
  View view;
  view.camera.width = view.camera.height = side;
  view.camera.fx = view.camera.fy = side;
  view.camera.cx = view.camera.cy = side / 2.;
  view.colour = Image(side, side, 3);
  for (int y = 0; y < side; ++y)
    for (int x = 0; x < side; ++x)
      for (int c = 0; c < 3; ++c)
        view.colour.at(x, y, c) =
            float(x * (c == 0) + y * (c == 1)) / float(side) + .2f * float(c == 2);
  view.depth.assign(size_t(side * side), distance);
  return view;
}

EncoderConfig toyEncoder(int levels = 1) {
  EncoderConfig c;
  c.preset = "toy", c.voxel_m = .2f, c.levels = levels;
  c.patches_across = 4, c.patch_px = 8;
  c.voxel_width = 12, c.width = 24, c.heads = 2, c.blocks = 3, c.decoder_blocks = 2, c.window = 64;
  c.latent_dim = 16, c.latent_groups = 4;
  return c;
}

VoxelFrame frameOf(const std::vector<View>& views, float voxel_m) {
  std::vector<DepthView> depth;
  for (const View& v : views) depth.push_back(v.depthView());
  VolumeSettings volume;
  volume.voxel_m = voxel_m, volume.margin_m = .4f;  // as training does
  return fitVolume(depth, volume, CarveSettings());
}

Observation observed(const std::vector<View>& views, const VoxelFrame& frame,
                     const EncoderConfig& c) {
  ObserveSettings settings;
  settings.frame = frame;
  settings.patches_across = c.patches_across;
  settings.level = c.levels;
  Progress silent;
  return observe(views, settings, silent);
}
Observation observed(const std::vector<View>& views, const EncoderConfig& c) {
  return observed(views, frameOf(views, c.voxel_m), c);
}

std::shared_ptr<EncoderNet> makeNet(const EncoderConfig& c, uint64_t seed) {
  torch::manual_seed(seed);
  return std::make_shared<EncoderNet>(c);
}

void saveNet(const EncoderNet& net, const std::string& path) {
  TensorFile file;
  addModule(net, "", &file);
  file.metadata["encoder"] = net.config.toJson();
  file.metadata["trained_on"] = "rooms:1-2";
  writeTensors(file, path);
}

class InFolder : public testing::Test {
 protected:
  void SetUp() override {
    std::string pattern = testing::TempDir() + "vdbc_encoder_XXXXXX";
    ASSERT_NE(mkdtemp(pattern.data()), nullptr);
    folder_ = pattern;
  }
  void TearDown() override { fs::remove_all(folder_); }
  std::string path(const std::string& name) const { return folder_ + "/" + name; }

 private:
  std::string folder_;
};

// --- attention ---------------------------------------------------------------------------------

std::vector<Coord> scatteredCoords(int64_t n) {
  std::mt19937_64 random(5);
  std::set<Coord> coords;
  while (int64_t(coords.size()) < n)
    coords.insert(Coord(int(random() % 13) - 6, int(random() % 13) - 6, int(random() % 13) - 6));
  std::vector<Coord> rows(coords.begin(), coords.end());
  std::shuffle(rows.begin(), rows.end(), random);
  return rows;
}

TEST(EncoderAttention, RotaryScoresDependOnDifferencesOfPositionsOnly) {
  torch::manual_seed(1);
  const Tensor q = torch::randn({1, 1, 40}), k = torch::randn({1, 1, 40});
  const auto score = [&](const Coord& a, const Coord& b) {
    const auto at = [](const Coord& c) { return rotary(coordTensor({c}), 40, PositionConfig()); };
    return (rotate(q, at(a)) * rotate(k, at(b))).sum().item<double>();
  };
  const Coord a(3, -2, 5), b(-1, 4, 2), shift(17, -30, 8);
  EXPECT_NEAR(score(a, b), score(a + shift, b + shift), 1e-4);
  EXPECT_GT(std::abs(score(a, b) - score(a + shift, b)), 1e-2);
  EXPECT_NEAR(score(a, a), (q * k).sum().item<double>(), 1e-5);
}

TEST(EncoderAttention, TurnsByFrequenciesBetweenTheConfigurationsOwn) {
  PositionConfig config;
  config.rotary_highest = 1.2f, config.rotary_lowest = .3f;
  const Rotary turned = rotary(coordTensor({Coord(1, 0, 0), Coord(0, 0, -2)}), 40, config);
  ASSERT_EQ(turned.cos.sizes(), (std::vector<int64_t>{2, 20}));
  // 5 pairs for each axis, and 5 that do not turn.
  std::multiset<double> found[2], truth[2];
  for (int row : {0, 1})
    for (int i = 0; i < 20; ++i) {
      const double angle =
          std::atan2(turned.sin[row][i].item<double>(), turned.cos[row][i].item<double>());
      if (std::abs(angle) > 1e-6) found[row].insert(angle);
    }
  for (int i = 0; i < 5; ++i) {
    const double frequency = 1.2 * std::pow(.3 / 1.2, i / 4.);
    truth[0].insert(frequency);
    truth[1].insert(std::remainder(-2 * frequency, 2 * M_PI));
  }
  for (int row : {0, 1}) {
    ASSERT_EQ(found[row].size(), 5u);
    for (auto f = found[row].begin(), t = truth[row].begin(); f != found[row].end(); ++f, ++t)
      EXPECT_NEAR(*f, *t, 1e-5);
  }
}

TEST(EncoderAttention, PositionsAreSharesOfTheConfigurationsExtent) {
  VoxelFrame frame;
  frame.bounds = CoordBBox(Coord(-10, 0, 4), Coord(29, 59, 23)), frame.voxel_m = .2f;
  const Tensor coords = coordTensor({Coord(-4, 3, 5), Coord(2, 20, 9)});
  PositionConfig config;
  const Tensor own = tokenPositions(coords, 1, frame, config);
  config.extent_m *= 2;
  EXPECT_LT(largestDifference(tokenPositions(coords, 1, frame, config), own / 2), 1e-7);
  // Between two tokens: their distance in metres.
  EXPECT_LT(largestDifference((own[1] - own[0]) * PositionConfig().extent_m,
                              torch::tensor({6 * .4f, 17 * .4f, 4 * .4f})),
            1e-5);
}

TEST(EncoderAttention, SelfBlocksAreTheirFormulaAlsoInBlocksOfRows) {
  torch::manual_seed(2);
  SelfBlock block(24, 2);
  const std::vector<Coord> coords = scatteredCoords(700);  // more than one block of rows
  const Tensor x = torch::randn({700, 24});
  const Rotary pos = rotary(coordTensor(coords), 12, PositionConfig());
  const Tensor normed = block.norm1->forward(x);
  const auto heads = [](const Tensor& rows) { return rows.view({700, 2, 12}).transpose(0, 1); };
  Attention& a = *block.attention;
  for (const Rotary* p : {&pos, static_cast<const Rotary*>(nullptr)}) {
    Tensor q = heads(a.query->forward(normed)), k = heads(a.key->forward(normed));
    if (p) q = rotate(q, *p), k = rotate(k, *p);
    const Tensor scores = (torch::matmul(q, k.transpose(1, 2)) / std::sqrt(12.)).softmax(2);
    const Tensor mixed =
        torch::matmul(scores, heads(a.value->forward(normed))).transpose(0, 1).reshape({700, 24});
    const Tensor y = x + a.output->forward(mixed);
    const Tensor truth = y + block.mlp->second->forward(
                                 torch::gelu(block.mlp->first->forward(block.norm2->forward(y))));
    EXPECT_LT(largestDifference(block.forward(x, p), truth), 1e-5);  // with gradients: whole
    torch::NoGradGuard no_grad;
    EXPECT_LT(largestDifference(block.forward(x, p), truth), 1e-5);
  }
}

TEST(EncoderAttention, WindowsAreFullAttentionAmongTheirOwnTokens) {
  torch::NoGradGuard no_grad;
  torch::manual_seed(2);
  SelfBlock block(24, 2);
  const std::vector<Coord> coords = scatteredCoords(150);
  const Tensor x = torch::randn({150, 24}), order = zOrder(coords);
  const Rotary pos = rotary(coordTensor(coords), 12, PositionConfig());
  EXPECT_TRUE(torch::equal(block.windowed(x, &pos, order, 150, true), block.forward(x, &pos)));
  for (const bool shifted : {false, true}) {
    Tensor truth = torch::zeros({150, 24});
    for (int64_t begin = shifted ? -16 : 0; begin < 150; begin += 32) {
      const Tensor rows =
          order.slice(0, std::max<int64_t>(0, begin), std::min<int64_t>(150, begin + 32));
      const Rotary p{pos.cos.index_select(0, rows), pos.sin.index_select(0, rows)};
      truth.index_copy_(0, rows, block.forward(x.index_select(0, rows), &p));
    }
    EXPECT_LT(largestDifference(block.windowed(x, &pos, order, 32, shifted), truth), 1e-5);
  }
}

TEST(EncoderAttention, ZOrderHalvesSpaceRecursively) {
  // All tokens of an aligned cube are consecutive, for cubes of any size.
  const std::vector<Coord> coords = scatteredCoords(400);
  const Tensor order = zOrder(coords);
  for (int level = 1; level <= 3; ++level) {
    std::set<Coord> left;
    Coord current(1000);
    for (int64_t i = 0; i < 400; ++i) {
      const Coord cube = tokenCoord(coords[size_t(order[i].item<int64_t>())], level);
      if (cube == current) continue;
      EXPECT_TRUE(left.insert(cube).second) << "the curve comes back to a cube it has left";
      current = cube;
    }
  }
}

/// A sparse matrix of counts and the same dense.
struct Counts {
  std::vector<int32_t> rows, columns;
  std::vector<float> counts;
  Tensor dense;
};
Counts randomCounts(int64_t n, int64_t m) {
  std::mt19937_64 random(3);
  Counts c;
  c.dense = torch::zeros({n, m}, torch::kFloat64);
  for (int32_t i = 1; i < n; ++i)  // row 0 stays empty
    for (int32_t j = 0; j < m; ++j) {
      if (random() % 4) continue;
      const float count = i == 1 ? 3000.f : float(1 + random() % 9);  // row 1 would overflow exp()
      c.rows.push_back(i), c.columns.push_back(j), c.counts.push_back(count);
      c.dense[i][j] = count;
    }
  return c;
}

TEST(EncoderGuide, IsTheSoftmaxOfTheCountsWithoutTheDenseMatrix) {  // section 3.2
  torch::manual_seed(4);
  const Counts c = randomCounts(20, 33);
  const Tensor values = torch::randn({33, 7});
  for (const bool log_counts : {false, true}) {
    const CountAttention a = countAttention(c.rows, c.columns, c.counts, 20, 33, log_counts);
    const Tensor matrix = (log_counts ? (1 + c.dense).log() : c.dense).softmax(1);
    EXPECT_LT(largestDifference(a.apply(values), torch::matmul(matrix, values.to(torch::kFloat64))),
              1e-5);
    EXPECT_LT(largestDifference(a.apply(torch::ones({33, 1})), torch::ones({20, 1})), 1e-6);
    EXPECT_EQ(a.weight.numel(), int64_t(c.rows.size()));
  }
}

TEST(EncoderGuide, MemoryGrowsWithTheCountedPairs) {  // section 3.2: never [N, M]
  const int64_t n = 3000, m = 50000;
  for (size_t pairs : {100u, 1000u, 10000u}) {
    std::vector<int32_t> rows, columns;
    for (size_t k = 0; k < pairs; ++k)
      rows.push_back(int32_t(k % n)), columns.push_back(int32_t(k * 7 % m));
    const CountAttention a =
        countAttention(rows, columns, std::vector<float>(pairs, 2), n, m, false);
    size_t bytes = 0;
    for (const Tensor& t : {a.rows, a.columns, a.weight, a.floor}) bytes += t.storage().nbytes();
    EXPECT_EQ(bytes, pairs * (8 + 8 + 4) + size_t(n) * 4);
  }
}

TEST(EncoderGuide, AlphaOneIsPlainAttentionAndZeroTheGuideAlone) {  // section 3.2
  torch::manual_seed(5);
  Attention attention(24, 2);
  const Counts c = randomCounts(20, 33);
  const CountAttention guide = countAttention(c.rows, c.columns, c.counts, 20, 33, false);
  const Tensor x = torch::randn({20, 24}), context = torch::randn({33, 24});
  const auto mixed = [&](float alpha) {
    return attention.guided(x, context, torch::full({1}, alpha),
                            [&](const Tensor& v) { return guide.apply(v); });
  };
  const Tensor plain = attention.forward(x, nullptr, attention.contextOf(context, nullptr));
  const Tensor counted = attention.output->forward(
      torch::matmul(c.dense.softmax(1).to(torch::kFloat32), attention.value->forward(context)));
  EXPECT_LT(largestDifference(mixed(1), plain), 1e-6);
  EXPECT_LT(largestDifference(mixed(0), counted), 1e-5);
  EXPECT_LT(largestDifference(mixed(.3f), .3 * plain + .7 * counted), 1e-5);
  EXPECT_GT(largestDifference(plain, counted), 1e-2);
}

TEST(EncoderGuide, ShareIsLearnedFromAHalfOrFixed) {  // section 3.2
  EncoderConfig c = toyEncoder();
  const auto learned = makeNet(c, 1);
  EXPECT_EQ(learned->blocks[0]->alpha.sigmoid().item<float>(), .5f);
  EXPECT_TRUE(learned->blocks[0]->alpha.requires_grad());
  c.guide_alpha = 1;
  const auto fixed = makeNet(c, 1);
  EXPECT_FALSE(fixed->blocks[0]->alpha.requires_grad());
  // With all of the attention learned, counts do not matter.
  const std::vector<View> views = roomViews(2);
  EncoderInput in = encoderInput(views, observed(views, c), c);
  EncoderInput other = in;
  other.voxels_from_patches.weight = torch::rand_like(in.voxels_from_patches.weight);
  other.patches_from_voxels.weight = torch::rand_like(in.patches_from_voxels.weight);
  EXPECT_TRUE(torch::equal(fixed->encode(in).mean, fixed->encode(other).mean));
  EXPECT_FALSE(torch::equal(learned->encode(in).mean, learned->encode(other).mean));
}

TEST(EncoderGuide,
     CountsPixelsOfThePatchInTheToken) {  // section 3.2, against a loop over the pixels
  const std::vector<View> views = roomViews(2);
  for (int level : {1, 2}) {
    const EncoderConfig c = toyEncoder(level);
    const Observation o = observed(views, c);
    const EncoderInput in = encoderInput(views, o, c);
    Tensor counts = torch::zeros({o.tokens.size(level), o.patches});
    auto count = counts.accessor<float, 2>();
    for (size_t i = 0; i < views.size(); ++i) {
      const std::vector<float> depth = usableDepth(views[i].depthView(), CarveSettings());
      for (int y = 0; y < 48; ++y)
        for (int x = 0; x < 64; ++x) {
          const double z = depth[size_t(y * 64 + x)];
          if (!(z > 0)) continue;
          const Eigen::Vector3d p = o.frame.toIndex(views[i].camera.unproject(x + .5, y + .5, z));
          const Coord voxel(int(std::floor(p.x())), int(std::floor(p.y())), int(std::floor(p.z())));
          const int32_t row = o.tokens.row(level, tokenCoord(voxel, level));
          if (row >= 0) ++count[row][int64_t(i) * 12 + y / 16 * 4 + x / 16];
        }
    }
    EXPECT_LT(
        largestDifference(in.voxels_from_patches.apply(torch::eye(o.patches)), counts.softmax(1)),
        1e-6);
    EXPECT_LT(largestDifference(in.patches_from_voxels.apply(torch::eye(o.tokens.size(level))),
                                counts.t().softmax(1)),
              1e-6);
  }
}

// --- the encoder -------------------------------------------------------------------------------

TEST(EncoderInput, PatchesAreThePixelsWhereTheSizeDividesTheImage) {  // section 2.6
  const std::vector<View> views = roomViews(2);
  for (int across : {4, 8}) {
    EncoderConfig c = toyEncoder();
    c.patches_across = across, c.patch_px = 64 / across;
    const int px = c.patch_px, rows = 48 / px;
    const EncoderInput in = encoderInput(views, observed(views, c), c);
    ASSERT_EQ(in.patches.sizes(), (std::vector<int64_t>{2 * across * rows, 3 * px * px}));
    EXPECT_EQ(in.patch_geometry.sizes(), (std::vector<int64_t>{2 * across * rows, 10}));
    const auto value = in.patches.accessor<float, 2>();
    float worst = 0;
    for (int i = 0; i < 2; ++i)
      for (int y = 0; y < 48; ++y)
        for (int x = 0; x < 64; ++x)
          for (int k = 0; k < 3; ++k)
            worst = std::max(
                worst,
                std::abs(
                    value[(i * rows + y / px) * across + x / px][(y % px * px + x % px) * 3 + k] /
                        4 +
                    .5f - views[size_t(i)].colour.at(x, y, k)));
    EXPECT_LT(worst, 1e-6);
  }
}

TEST(EncoderInput, AnyPatchSizeRuns) {  // section 2.6
  const std::vector<View> views = roomViews(2);
  for (const auto& [across, px] : {std::pair<int, int>{1, 3}, {5, 7}, {14, 16}}) {
    EncoderConfig c = toyEncoder();
    c.patches_across = across, c.patch_px = px;
    const Observation o = observed(views, c);
    const Tensor z = makeNet(c, 1)->encode(encoderInput(views, o, c)).mean;
    EXPECT_EQ(z.sizes(), (std::vector<int64_t>{o.tokens.size(1), c.latent_dim}));
    EXPECT_TRUE(torch::isfinite(z).all().item<bool>());
  }
}

TEST(EncoderNet, TheOrderOfViewsDoesNotMatter) {  // section 3.1
  torch::NoGradGuard no_grad;
  const EncoderConfig c = toyEncoder();
  const auto net = makeNet(c, 2);
  std::vector<View> views = roomViews(4);
  const VoxelFrame frame = frameOf(views, c.voxel_m);
  const Tensor z = net->encode(encoderInput(views, observed(views, frame, c), c)).mean;
  std::rotate(views.begin(), views.begin() + 1, views.end());
  std::swap(views[0], views[2]);
  const Tensor permuted = net->encode(encoderInput(views, observed(views, frame, c), c)).mean;
  EXPECT_LT(largestDifference(z, permuted), 1e-5);
}

CountAttention withRows(const CountAttention& a, const Tensor& order, const Tensor& place) {
  return {place.index_select(0, a.rows), a.columns, a.weight, a.floor.index_select(0, order)};
}
CountAttention withColumns(const CountAttention& a, const Tensor& place) {
  return {a.rows, place.index_select(0, a.columns), a.weight, a.floor};
}

TEST(EncoderNet, PermutedVoxelsGivePermutedLatents) {  // section 3.1
  torch::NoGradGuard no_grad;
  const std::vector<View> views = roomViews(3);
  for (int window : {32, 4096}) {
    EncoderConfig c = toyEncoder();
    c.window = window;
    const auto net = makeNet(c, 3);
    const Observation o = observed(views, c);
    const EncoderInput in = encoderInput(views, o, c);
    const int64_t n = in.coords.size(0), n0 = in.voxel_features.size(0);
    ASSERT_GT(n, 64);
    ASSERT_LT(n, 4096);
    const Tensor order = torch::randperm(n), order0 = torch::randperm(n0);
    const Tensor place = order.argsort();
    const Tensor place0 = torch::cat({order0.argsort(), torch::full({1}, n0, torch::kInt64)});
    EncoderInput other = in;
    other.voxel_features = in.voxel_features.index_select(0, order0);
    other.children[0] =
        place0.index_select(0, in.children[0].index_select(0, order).flatten()).view({n, 8});
    other.coords = in.coords.index_select(0, order);
    other.positions = in.positions.index_select(0, order);
    std::vector<Coord> coords;
    for (int64_t i = 0; i < n; ++i)
      coords.push_back(o.tokens.coords(1)[size_t(order[i].item<int64_t>())]);
    other.order = zOrder(coords);
    other.voxels_from_patches = withRows(in.voxels_from_patches, order, place);
    other.patches_from_voxels = withColumns(in.patches_from_voxels, place);
    EXPECT_LT(
        largestDifference(net->encode(other).mean, net->encode(in).mean.index_select(0, order)),
        1e-5);
  }
}

TEST(EncoderNet, PatchesAreUpdatedFromTheNewVoxelTokens) {  // section 3.1, paper eq. 2
  torch::NoGradGuard no_grad;
  const EncoderConfig c = toyEncoder();
  const std::vector<View> views = roomViews(2);
  const EncoderInput in = encoderInput(views, observed(views, c), c);
  torch::manual_seed(6);
  BidirectionalBlock block(c, true);
  const Tensor x3 = torch::randn({in.coords.size(0), c.width}),
               x2 = torch::randn({in.patches.size(0), c.width});
  const Rotary pos = rotary(in.coords, c.width / c.heads, c.positions);
  const auto update = [&] {
    Tensor new3 = x3, new2 = x2;
    block.forward(&new3, &new2, in, pos, 0);
    return std::make_pair(new3, new2);
  };
  const auto before = update();
  // By hand: the 2-D update reads what self3 returned.
  const auto guide = [&](const Tensor& v) { return in.patches_from_voxels.apply(v); };
  Tensor truth =
      x2 + block.cross2->guided(block.norm2->forward(x2), block.context3->forward(before.first),
                                torch::full({1}, .5f), guide);
  truth = block.self2->forward(truth, nullptr);
  EXPECT_LT(largestDifference(before.second, truth), 1e-5);
  // Old tokens of both kinds stay; only the new 3-D tokens change.
  block.self3->mlp->second->bias.slice(0, 0, 4) += 1;
  const auto after = update();
  EXPECT_GT(largestDifference(before.first, after.first), 1e-2);
  EXPECT_GT(largestDifference(before.second, after.second), 1e-3);
}

TEST(EncoderNet, ImagesReachTheVoxelsAndVoxelsTheImages) {  // section 3.1
  torch::NoGradGuard no_grad;
  const EncoderConfig c = toyEncoder();
  const auto net = makeNet(c, 7);
  EXPECT_TRUE(net->blocks[0]->cross2 && net->blocks[1]->cross2);
  EXPECT_FALSE(net->blocks[2]->cross2) << "2-D tokens are dropped at the end";
  const std::vector<View> views = roomViews(2);
  EncoderInput in = encoderInput(views, observed(views, c), c);
  const Tensor before = net->encode(in).mean;
  net->blocks[0]->cross2->key->weight.add_(torch::randn_like(net->blocks[0]->cross2->key->weight));
  const Tensor keyed = net->encode(in).mean;
  EXPECT_GT(largestDifference(before, keyed), 1e-5);
  in.patches = in.patches.flip({1});
  EXPECT_GT(largestDifference(keyed, net->encode(in).mean), 1e-4);
}

TEST(EncoderNet, NormaliseGivesEveryTokensGroupsUnitDeviation) {  // section 3.3
  const EncoderConfig c = toyEncoder();
  torch::manual_seed(8);
  const Tensor z = makeNet(c, 8)->normalise(3 + 2 * torch::randn({50, c.latent_dim}));
  const Tensor groups = z.view({50, c.latent_groups, -1});
  EXPECT_LT(groups.mean(2).abs().max().item<double>(), 1e-5);
  EXPECT_LT((groups.var(2, /*unbiased=*/false) - 1).abs().max().item<double>(), 1e-3);
}

TEST(EncoderNet, GaussiansStayNearTheirSubLattice) {  // section 3.5
  torch::NoGradGuard no_grad;
  for (int per_axis : {1, 2, 6}) {
    EncoderConfig c = toyEncoder();
    c.gaussians_per_voxel = per_axis * per_axis * per_axis;
    const auto net = makeNet(c, 9);
    net->gaussian_out->weight.mul_(300);  // far beyond what training gives
    const std::vector<Coord> voxels = scatteredCoords(20);
    const float h = .2f;
    const int64_t m = int64_t(per_axis) * per_axis * per_axis;
    const GaussianTensors g = net->gaussians(
        {torch::randn({20, c.voxel_width}), torch::randn({20, 8, 3})}, coordTensor(voxels), h);
    ASSERT_EQ(g.mean.sizes(), (std::vector<int64_t>{20 * m, 3}));
    ASSERT_EQ(g.sh.sizes(), (std::vector<int64_t>{20 * m, 1, 3}));
    double farthest = 0;
    for (int64_t i = 0; i < 20 * m; ++i) {
      const int64_t k = i % m;
      const Coord v = voxels[size_t(i / m)];
      const int64_t cell[3] = {k / (per_axis * per_axis), k / per_axis % per_axis, k % per_axis};
      for (int a = 0; a < 3; ++a) {
        const double point = (v[a] + (double(cell[a]) + .5) / per_axis) * double(h);
        farthest = std::max(farthest, std::abs(g.mean[i][a].item<double>() - point));
      }
    }
    EXPECT_LT(farthest, .75 * double(h) * (1 + 1e-4));
    EXPECT_GT(farthest, .7 * double(h)) << "the bound is not reached: the test says nothing";
    const Tensor scale = g.log_scale.exp() / h;
    EXPECT_GE(scale.min().item<double>(), .02 * (1 - 1e-4));
    EXPECT_LE(scale.max().item<double>(), 1.5 * (1 + 1e-4));
  }
}

TEST(EncoderNet, AnyNumberOfGaussiansSharesTheLattice) {  // section 3.5: M
  for (int64_t m = 1; m <= 70; ++m) {
    const Tensor lattice = subLattice(m);
    ASSERT_EQ(lattice.sizes(), (std::vector<int64_t>{m, 3}));
    std::set<std::array<float, 3>> places;
    for (int64_t i = 0; i < m; ++i)
      places.insert(
          {lattice[i][0].item<float>(), lattice[i][1].item<float>(), lattice[i][2].item<float>()});
    EXPECT_EQ(int64_t(places.size()), m) << "two Gaussians share a cell";
    EXPECT_GT(lattice.min().item<float>(), 0);
    EXPECT_LT(lattice.max().item<float>(), 1);
    // Spread evenly: the centre of all lies within a cell of the voxel's.
    EXPECT_LE((lattice.mean(0) - .5f).abs().max().item<float>(),
              1 / std::ceil(std::cbrt(double(m)) - 1e-9));
  }
}

TEST(EncoderNet, OctantsKeepTheirColours) {  // the way around the transformers
  torch::NoGradGuard no_grad;
  EncoderConfig c = toyEncoder();
  c.gaussians_per_voxel = 8;
  const auto net = makeNet(c, 10);
  net->gaussian_out->weight.zero_();
  Tensor colours = torch::zeros({1, 8, 3});
  for (int octant = 0; octant < 8; ++octant)
    colours[0][octant][0] = .1f * float(octant);  // luminance
  const GaussianTensors g =
      net->gaussians({torch::randn({1, c.voxel_width}), colours}, coordTensor({Coord(3, 4, 5)}), 1);
  for (int64_t i = 0; i < 8; ++i) {
    const int64_t octant = (g.mean[i][0].item<float>() > 3.5f) * 4 +
                           (g.mean[i][1].item<float>() > 4.5f) * 2 +
                           (g.mean[i][2].item<float>() > 5.5f);
    EXPECT_NEAR(g.sh[i][0][1].item<float>() * kSh0, .05f * float(octant), 1e-5);
  }
}

// --- splitting ---------------------------------------------------------------------------------

TEST(FalsePositives, HaveTheExactCountAndLieHalfNearTheTruth) {  // section 3.4
  std::vector<Coord> nodes;
  for (int i = 0; i < 300; ++i) nodes.push_back(Coord(i % 20, i / 20, i % 3 == 0));
  torch::Generator random = at::detail::createCPUGenerator(1);
  // Truth is one corner of each node of the left half: the right half is far from all of it.
  Tensor truth = torch::zeros({300, 8}, torch::kBool);
  std::vector<Coord> filled;
  for (int64_t i = 0; i < 300; ++i)
    if (nodes[size_t(i)].x() < 10) {
      truth[i][0] = true;
      filled.push_back(childCoord(nodes[size_t(i)], 0));
    }
  const int64_t count = truth.sum().item<int64_t>();
  for (const float ratio : {0.f, .25f, .5f, 1.f}) {
    const Tensor mask = injectFalsePositives(truth, nodes, ratio, random);
    EXPECT_TRUE((mask | ~truth).all().item<bool>()) << "the truth is kept";
    const Tensor added = mask & ~truth;
    const int64_t wanted = std::lround(ratio * float(count));
    EXPECT_EQ(added.sum().item<int64_t>(), wanted);
    int64_t near = 0;
    for (int64_t i = 0; i < 300; ++i)
      for (int slot = 0; slot < 8; ++slot) {
        if (!added[i][slot].item<bool>()) continue;
        const Coord child = childCoord(nodes[size_t(i)], slot);
        near += std::any_of(filled.begin(), filled.end(), [&](const Coord& f) {
          const Coord d = child - f;
          return std::abs(d.x()) <= 1 && std::abs(d.y()) <= 1 && std::abs(d.z()) <= 1;
        });
      }
    EXPECT_GE(near, wanted / 2);
    // The other half is anywhere: not all of it lands near.
    EXPECT_TRUE(ratio == 0 || near < wanted);
  }
}

TEST(FalsePositives, AreAllThatIsFreeWhereLessIsFreeThanWanted) {  // section 3.4
  torch::Generator random = at::detail::createCPUGenerator(2);
  Tensor truth = torch::ones({4, 8}, torch::kBool);
  truth[1][3] = false, truth[2][5] = false;
  const Tensor mask = injectFalsePositives(
      truth, {Coord(0, 0, 0), Coord(1, 0, 0), Coord(2, 0, 0), Coord(3, 0, 0)}, .5f, random);
  EXPECT_TRUE(mask.all().item<bool>());
}

// --- Encoder: files to latents to Gaussians ----------------------------------------------------

class EncoderFile : public InFolder {
 protected:
  Encoder encoderOf(const EncoderConfig& c) {
    net_ = makeNet(c, 10);
    saveNet(*net_, path("encoder.safetensors"));
    return Encoder(path("encoder.safetensors"));
  }
  std::shared_ptr<EncoderNet> net_;
  Progress silent_;
};

TEST_F(EncoderFile, OneSetOfWeightsServesAnyNumberOfViews) {  // section 2.1
  const Encoder encoder = encoderOf(toyEncoder());
  for (size_t n : {1, 2, 4, 8, 12, 16}) {
    const std::vector<View> views = roomViews(n);
    const Observation o = observed(views, encoder.config());
    const Place place = encoder.encode(views, o, silent_);
    EXPECT_EQ(place.ijk, o.tokens.coords(1));
    EXPECT_EQ(int64_t(place.z.size()), place.size() * 16);
    for (float z : place.z) ASSERT_TRUE(std::isfinite(z));
    const Gaussians g = encoder.decode(place, .5f, silent_).gaussians;
    requireConsistent(g);
    for (const auto& m : g.mean) ASSERT_TRUE(m.allFinite());
    for (const auto& s : g.log_scale) ASSERT_TRUE(s.allFinite());
  }
}

TEST_F(EncoderFile, EncodesConditionAndTargetWithTheSameUnchangedWeights) {  // section 3.8
  const Encoder encoder = encoderOf(toyEncoder());
  const std::string hash = encoder.hash();
  const std::vector<View> few = roomViews(2), many = roomViews(6);
  const VoxelFrame frame = frameOf(few, encoder.config().voxel_m);
  const Observation sparse = observed(few, frame, encoder.config());
  const Place first = encoder.encode(few, sparse, silent_);
  const Place dense = encoder.encode(many, observed(many, frame, encoder.config()), silent_);
  EXPECT_EQ(encoder.encode(few, sparse, silent_).z, first.z);
  EXPECT_EQ(encoder.hash(), hash);
  EXPECT_EQ(weightsHash(*net_), hash);
  EXPECT_GT(dense.size(), first.size());
}

TEST_F(EncoderFile, LoadsExactlyWhatWasSaved) {  // section 3.8
  const EncoderConfig c = toyEncoder();
  const Encoder encoder = encoderOf(c);
  EXPECT_EQ(encoder.config().toJson(), c.toJson());
  EXPECT_EQ(encoder.trainedOn(), "rooms:1-2");
  const std::vector<View> views = roomViews(2);
  const Observation o = observed(views, c);
  const Place place = encoder.encode(views, o, silent_);
  torch::NoGradGuard no_grad;
  const Tensor z = net_->normalise(net_->encode(encoderInput(views, o, c)).mean)
                       .to(torch::kHalf)
                       .to(torch::kFloat32)
                       .contiguous();
  ASSERT_EQ(int64_t(place.z.size()), z.numel());
  EXPECT_EQ(std::memcmp(place.z.data(), z.data_ptr(), z.nbytes()), 0);
  net_->latent_in->bias[0] += 1;
  EXPECT_NE(weightsHash(*net_), encoder.hash());
}

/// `place` and a ring of generated tokens around it.
Place withGenerated(Place place) {
  torch::manual_seed(11);
  for (const Coord& ijk : neighbourRing(place.ijk, Neighbours::kFaces6)) {
    place.ijk.push_back(ijk);
    const Tensor z = torch::randn({place.dim});
    place.z.insert(place.z.end(), z.data_ptr<float>(), z.data_ptr<float>() + place.dim);
    place.generated.push_back(1), place.probability.push_back(.6f), place.bfs_level.push_back(1);
  }
  return place;
}

TEST_F(EncoderFile, DecodesWhatWasSeenExactlyAndNothingIntoSeenAir) {  // sections 3.4 and 3.5
  const std::vector<View> views = roomViews(3);
  for (int levels : {0, 1, 2})
    for (const float threshold : {.2f, .5f, 1.f}) {
      const EncoderConfig c = toyEncoder(levels);
      const Encoder encoder = encoderOf(c);
      const Observation o = observed(views, c);
      Place place = encoder.encode(views, o, silent_);
      if (levels > 0) place = withGenerated(place);
      const DecodedGrid d = encoder.decode(place, threshold, silent_);
      const std::set<Coord> voxels(d.voxels.begin(), d.voxels.end());
      EXPECT_EQ(voxels.size(), d.voxels.size()) << "a voxel is decoded twice";
      for (const Coord& ijk : o.tokens.coords(0))
        ASSERT_TRUE(voxels.count(ijk))
            << "levels " << levels << ": lost the observed voxel " << ijk;
      std::vector<int> children(size_t(place.size()), 0);
      for (size_t i = 0; i < d.voxels.size(); ++i) {
        const bool filled = o.seen->filled.isValueOn(d.voxels[i]);
        EXPECT_TRUE(filled || !o.seen->empty.isValueOn(d.voxels[i]))
            << "filled what was seen empty";
        EXPECT_EQ(tokenCoord(d.voxels[i], levels), place.ijk[size_t(d.node[i])]);
        EXPECT_TRUE(!filled || d.child_probability[i] == 1.f);
        ++children[size_t(d.node[i])];
      }
      // A generated token has a voxel unless all of it was seen empty.
      const int side = 1 << levels;
      for (int64_t t = 0; t < place.size(); ++t) {
        int open = 0;
        for (int v = 0; v < side * side * side; ++v)
          open +=
              !o.seen->empty.isValueOn(Coord(place.ijk[size_t(t)].x() * side + v / (side * side),
                                             place.ijk[size_t(t)].y() * side + v / side % side,
                                             place.ijk[size_t(t)].z() * side + v % side));
        EXPECT_EQ(children[size_t(t)] > 0, open > 0);
      }
      requireConsistent(d.gaussians);
      EXPECT_EQ(d.gaussians.size(), int64_t(d.voxels.size()) * 8) << "M = 2^3 a voxel";
      for (int64_t i = 0; i < d.gaussians.size(); ++i) {
        ASSERT_NEAR(d.gaussians.rotation[size_t(i)].norm(), 1, 1e-5);
        const Eigen::Vector3d p =
            o.frame.toIndex(d.gaussians.origin + d.gaussians.mean[size_t(i)].cast<double>());
        const Coord v = d.voxels[size_t(i / 8)];
        for (int a = 0; a < 3; ++a) ASSERT_LT(std::abs(p[a] - (v[a] + .5)), .25 + .75 + 1e-3);
      }
    }
}

TEST_F(EncoderFile, LowerThresholdsKeepMore) {  // section 3.4
  const EncoderConfig c = toyEncoder();
  const Encoder encoder = encoderOf(c);
  const std::vector<View> views = roomViews(2);
  const Observation o = observed(views, c);
  const Place place = withGenerated(encoder.encode(views, o, silent_));
  std::set<Coord> larger;
  for (const float threshold : {0.f, .3f, .5f, .7f, 1.f}) {
    const DecodedGrid d = encoder.decode(place, threshold, silent_);
    const std::set<Coord> kept(d.voxels.begin(), d.voxels.end());
    if (threshold == 0)
      for (const Coord& node : place.ijk)
        for (int slot = 0; slot < 8; ++slot) {
          const Coord child = childCoord(node, slot);
          EXPECT_EQ(kept.count(child) > 0,
                    o.seen->filled.isValueOn(child) || !o.seen->empty.isValueOn(child));
        }
    else
      EXPECT_TRUE(std::includes(larger.begin(), larger.end(), kept.begin(), kept.end()));
    larger = kept;
  }
}

TEST_F(EncoderFile, DecodesNoTokensToNoGaussians) {
  const Encoder encoder = encoderOf(toyEncoder());
  Place nothing;
  nothing.seen = std::make_shared<SeenSpace>();
  nothing.dim = 16;
  EXPECT_EQ(encoder.decode(nothing, .5f, silent_).gaussians.size(), 0);
  nothing.dim = 8;
  EXPECT_THROW(encoder.decode(nothing, .5f, silent_), Error);
}

TEST_F(EncoderFile, BadFilesThrow) {
  const EncoderConfig c = toyEncoder();
  encoderOf(c);
  const std::string good = path("encoder.safetensors"), bad = path("bad.safetensors");
  const TensorFile file = readTensors(good);
  EXPECT_THROW(Encoder(path("missing")), Error);
  EXPECT_THROW(Encoder(path("")), Error) << "a folder";
  const auto rejected = [&](const auto& change) {
    TensorFile changed = file;
    for (auto& t : changed.tensors) t.second = t.second.detach().clone();
    change(changed);
    writeTensors(changed, bad);
    EXPECT_THROW(Encoder{bad}, Error);
  };
  rejected([](TensorFile& f) { f.metadata.erase("encoder"); });
  rejected([](TensorFile& f) {  // weights of a completer
    f.metadata["completer"] = f.metadata["encoder"];
    f.metadata.erase("encoder");
  });
  rejected([](TensorFile& f) { f.metadata["encoder"] = "{}"; });
  rejected([](TensorFile& f) { f.metadata["encoder"] = "not JSON"; });
  rejected([](TensorFile& f) { f.tensors.erase("latent_in.bias"); });
  rejected([](TensorFile& f) { f.tensors["latent_in.bias"] = torch::zeros({3}); });
  for (const double value :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()})
    rejected([&](TensorFile& f) { f.tensors["latent_in.bias"][2] = value; });
  for (const auto& break_it : std::vector<void (*)(EncoderConfig&)>{
           [](EncoderConfig& e) { e.heads = 0; }, [](EncoderConfig& e) { e.heads = 5; },
           [](EncoderConfig& e) { e.levels = 3; }, [](EncoderConfig& e) { e.width = -24; },
           [](EncoderConfig& e) { e.latent_groups = 3; }, [](EncoderConfig& e) { e.voxel_m = 0; },
           [](EncoderConfig& e) { e.gaussians_per_voxel = 1000; },
           [](EncoderConfig& e) { e.patch_px = 0; },
           [](EncoderConfig& e) { e.width = 48; }})  // valid, but not what the tensors are of
    rejected([&](TensorFile& f) {
      EncoderConfig e = c;
      break_it(e);
      f.metadata["encoder"] = e.toJson();
    });
  const std::string bytes = bytesOf(good);
  for (size_t n = 0; n < bytes.size(); n += bytes.size() / 40) {
    writeBytes(bad, bytes.substr(0, n));
    EXPECT_THROW(Encoder{bad}, Error) << n;
  }
  EXPECT_NO_THROW(Encoder{good});
}

TEST(EncoderConfig, JsonRoundTripIsExact) {
  for (const EncoderConfig& c : {EncoderConfig::small(), EncoderConfig::paper(), toyEncoder(2)})
    EXPECT_EQ(EncoderConfig::fromJson(c.toJson(), "test").toJson(), c.toJson());
}

TEST(EncoderConfig, PaperSizes) {  // sections 3.3 and 3.5
  const EncoderConfig c = EncoderConfig::paper();
  EXPECT_EQ(c.gaussians_per_voxel, 216);
  EXPECT_EQ(c.latent_dim, 32);
  EXPECT_EQ(c.latent_groups, 8);
  EXPECT_EQ(c.kl_weight, .1f);
  EXPECT_EQ(c.false_positives, .25f);
}

// --- tensors in files --------------------------------------------------------------------------

class TensorFiles : public InFolder {
 protected:
  TensorFile sample() const {
    torch::manual_seed(12);
    TensorFile file;
    file.tensors["a"] = torch::randn({3, 5});
    file.tensors["b.c"] = torch::randint(-9, 9, {2, 2, 2}, torch::kInt64);
    file.tensors["scalar"] = torch::tensor(7, torch::kInt32);
    file.tensors["none"] = torch::zeros({0, 4});
    file.tensors["turned"] = torch::randn({4, 6}).t();  // not contiguous
    file.metadata = {{"key", "value with \"quotes\" and \n"}, {"other", ""}};
    return file;
  }
  static void expectSame(const TensorFile& a, const TensorFile& b) {
    EXPECT_EQ(a.metadata, b.metadata);
    ASSERT_EQ(a.tensors.size(), b.tensors.size());
    for (const auto& [name, tensor] : a.tensors) {
      ASSERT_TRUE(b.tensors.count(name)) << name;
      EXPECT_EQ(tensor.scalar_type(), b.tensors.at(name).scalar_type());
      EXPECT_TRUE(torch::equal(tensor, b.tensors.at(name))) << name;
    }
  }
  void writeHeader(const std::string& header, const std::string& data = "") const {
    const uint64_t length = header.size();
    writeBytes(path("bad"), std::string(reinterpret_cast<const char*>(&length), 8) + header + data);
  }
};

TEST_F(TensorFiles, RoundTripIsExact) {
  writeTensors(sample(), path("file"));
  expectSame(sample(), readTensors(path("file")));
  EXPECT_FALSE(fs::exists(path("file.tmp")));
}

TEST_F(TensorFiles, HalfFloatsComeAsFloats) {
  // 1, -2 and the least one above 0, by IEEE 754.
  writeHeader(R"({"a":{"dtype":"F16","shape":[3],"data_offsets":[0,6]}})",
              std::string("\x00\x3c\x00\xc0\x01\x00", 6));
  const torch::Tensor a = readTensors(path("bad")).tensors.at("a");
  ASSERT_EQ(a.scalar_type(), torch::kFloat32);
  EXPECT_TRUE(torch::equal(a, torch::tensor({1.f, -2.f, std::ldexp(1.f, -24)})));
}

TEST_F(TensorFiles, EveryTruncationThrows) {
  writeTensors(sample(), path("file"));
  const std::string bytes = bytesOf(path("file"));
  for (size_t n = 0; n < bytes.size(); ++n) {
    writeBytes(path("cut"), bytes.substr(0, n));
    EXPECT_THROW(readTensors(path("cut")), Error) << n << " of " << bytes.size() << " bytes";
  }
}

TEST_F(TensorFiles, ACorruptHeaderThrowsErrorOrIsStillConsistent) {
  writeTensors(sample(), path("file"));
  const std::string bytes = bytesOf(path("file"));
  const size_t end = bytes.find("}}") + 2;
  for (size_t i = 0; i < std::min(bytes.size(), end + 8); ++i)
    for (const size_t kind : {i % 6, (i + 1 + i / 6) % 6}) {
      std::string changed = bytes;
      changed[i] = "\0009\"-{\xff"[kind];
      writeBytes(path("bad"), changed);
      try {
        readTensors(path("bad"));
      } catch (const Error&) {
      }  // anything else, std::bad_alloc say, fails the test
    }
}

TEST_F(TensorFiles, HostileHeadersThrow) {
  for (
      const char* header :
      {"", "{", "[1]", "3", "null-", R"({"a":3})", R"({"a":{"dtype":"F32"}})",
       R"({"__metadata__":{"a":3}})", R"({"a":{"dtype":"F64","shape":[1],"data_offsets":[0,8]}})",
       R"({"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}})",
       R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[4,0]}})",
       R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4,8]}})",
       R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}})",
       R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[18446744073709551612,18446744073709551616]}})",
       R"({"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}})",
       R"({"a":{"dtype":"F32","shape":[0,4611686018427387904,4611686018427387904],"data_offsets":[0,0]}})",
       R"({"a":{"dtype":"F32","shape":[1000000000,1000000000,16],"data_offsets":[0,8]}})"}) {
    writeHeader(header, "12345678");
    EXPECT_THROW(readTensors(path("bad")), Error) << header;
  }
  const uint64_t huge = ~uint64_t(0) - 4;
  writeBytes(path("bad"), std::string(reinterpret_cast<const char*>(&huge), 8) + "{}");
  EXPECT_THROW(readTensors(path("bad")), Error);
}

TEST_F(TensorFiles, AFailedWriteThrowsAndLeavesNothing) {
  EXPECT_THROW(writeTensors(sample(), path("no/such/folder")), Error);
  fs::create_directory(path("folder"));
  writeBytes(path("folder/inside"), "x");
  EXPECT_THROW(writeTensors(sample(), path("folder")), Error) << "a folder is in the way";
  EXPECT_FALSE(fs::exists(path("folder.tmp")));
  TensorFile file;
  file.tensors["a"] = torch::zeros({2}, torch::kFloat64);
  EXPECT_THROW(writeTensors(file, path("double")), Error);
  EXPECT_FALSE(fs::exists(path("double")));
  EXPECT_FALSE(fs::exists(path("double.tmp")));
}

// --- training ----------------------------------------------------------------------------------

TEST(Training, CosineRateIsItsFormula) {  // section 3.7
  const auto rate = [](int64_t step) { return cosineRate(1e-3, step, 1100, 100, .02); };
  EXPECT_DOUBLE_EQ(rate(0), 1e-5);  // warm-up: linear, never zero
  EXPECT_DOUBLE_EQ(rate(49), 5e-4);
  EXPECT_DOUBLE_EQ(rate(99), 1e-3);
  EXPECT_DOUBLE_EQ(rate(100), 1e-3);
  EXPECT_NEAR(rate(600), 1e-3 * .51, 1e-15);
  EXPECT_NEAR(rate(1100), 2e-5, 1e-15);
  EXPECT_NEAR(rate(5000), 2e-5, 1e-15);
  for (int64_t s = 100; s < 1100; ++s) {
    EXPECT_NEAR(rate(s),
                1e-3 * (.02 + .98 * std::pow(std::cos(M_PI / 2 * double(s - 100) / 1000), 2)),
                1e-12);
    EXPECT_GT(rate(s), rate(s + 1));
  }
}

TEST(Training, AverageMovesByItsShareOfTheDifference) {
  std::vector<Tensor> average = {torch::full({3}, 2.f)};
  updateAverage(average, {torch::full({3}, 4.f)}, .75);
  EXPECT_TRUE(torch::allclose(average[0], torch::full({3}, 2.5f)));
}

TEST(Training, XavierBoundsMatricesAndZeroesBiases) {  // section 3.7
  torch::manual_seed(13);
  Mlp mlp(300, 200, 100);
  initialiseXavier(mlp);
  const double bound = std::sqrt(6. / 500);
  EXPECT_LE(mlp.first->weight.abs().max().item<double>(), bound);
  EXPECT_NEAR(mlp.first->weight.std().item<double>(), bound / std::sqrt(3.), .01 * bound);
  EXPECT_EQ(mlp.first->bias.abs().max().item<double>(), 0);
}

/// Loss of a fresh network of seed 14, and what the test recomputes it from.
struct FirstStep {
  std::shared_ptr<EncoderNet> net;
  Observation o;
  EncoderInput in;
  EncoderNet::Posterior posterior;
  torch::Generator random = at::detail::createCPUGenerator(14);
  Tensor z;  // the sample that the step draws first

  FirstStep(const std::vector<View>& views, const EncoderConfig& c)
      : net(makeNet(c, 14)),
        o(observed(views, c)),
        in(encoderInput(views, o, c)),
        posterior(net->encode(in)) {
    const Tensor noise = torch::randn(posterior.mean.sizes(), random);
    z = net->normalise(posterior.mean + (posterior.log_variance / 2).exp() * noise);
  }
};
double firstLoss(EncoderConfig c, const std::vector<View>& views, float kl_weight,
                 float occupancy_weight) {
  c.kl_weight = kl_weight, c.occupancy_weight = occupancy_weight;
  return encoderStepLoss(c, views, 14).first;
}

TEST(EncoderLoss, KlEqualsMonteCarlo) {  // sections 3.3 and 3.7
  torch::NoGradGuard no_grad;
  const EncoderConfig c = toyEncoder();
  const std::vector<View> views = roomViews(2);
  double kl;
  {
    torch::AutoGradMode grad(true);
    kl = firstLoss(c, views, 1, 0) - firstLoss(c, views, 0, 0);
  }
  const FirstStep step(views, c);
  const Tensor mean = step.posterior.mean.to(torch::kFloat64);
  const Tensor deviation = (step.posterior.log_variance.to(torch::kFloat64) / 2).exp();
  double sum = 0;
  constexpr int kDraws = 200;
  for (int i = 0; i < kDraws; ++i) {
    const Tensor e = torch::randn(mean.sizes(), torch::kFloat64), z = mean + deviation * e;
    // log q(z) - log p(z); the 2 pi cancel.
    sum += (-e.square() / 2 - deviation.log() + z.square() / 2).mean().item<double>();
  }
  EXPECT_NEAR(kl, sum / kDraws, .01 * sum / kDraws);
}

TEST(EncoderLoss, ImageTermIsTheMeanOverObservedPixelsAndChannels) {  // section 3.7
  const EncoderConfig c = toyEncoder(0);  // no splits: nothing else is random
  std::vector<View> views = roomViews(2);
  for (size_t i = 0; i < 900; ++i) views[1].depth[i] = 0;  // pixels that do not count
  const FirstStep step(views, c);
  torch::NoGradGuard no_grad;
  const GaussianTensors g = step.net->gaussians(
      step.net->decodeTokens(step.z, step.in.coords, step.in.order), step.in.coords, c.voxel_m);
  double sum = 0, values = 0;
  for (const View& view : views) {
    Camera camera = view.camera;
    camera.world_from_camera =
        step.o.frame.world_from_grid.inverse() * view.camera.world_from_camera;
    const Tensor image =
        rasterizeTorch(g.mean, g.log_scale, g.rotation, g.opacity_logit, g.sh, camera, {});
    const auto pixel = image.accessor<float, 3>();
    const std::vector<float> depth = usableDepth(view.depthView(), CarveSettings());
    for (int y = 0; y < 48; ++y)
      for (int x = 0; x < 64; ++x) {
        if (depth[size_t(y * 64 + x)] <= 0) continue;
        for (int k = 0; k < 3; ++k)
          sum += std::pow(double(pixel[y][x][k] - view.colour.at(x, y, k)), 2);
        values += 3;
      }
  }
  torch::AutoGradMode grad(true);
  EXPECT_NEAR(firstLoss(c, views, 0, 0), sum / values, 1e-5 * sum / values);
}

TEST(EncoderLoss, SplitTermIsTheCrossEntropyOfWhatIsKnown) {  // sections 3.4 and 3.7
  const EncoderConfig c = toyEncoder(1);
  const std::vector<View> views = roomViews(2);
  const double split = firstLoss(c, views, 0, 1) - firstLoss(c, views, 0, 0);
  const FirstStep step(views, c);
  torch::NoGradGuard no_grad;
  const Tensor logits =
      step.net->childLogits(step.net->decodeTokens(step.z, step.in.coords, step.in.order), 0);
  double sum = 0, known = 0, unknown = 0;
  for (int64_t i = 0; i < logits.size(0); ++i)
    for (int slot = 0; slot < 8; ++slot) {
      const Coord child = childCoord(step.o.tokens.coords(1)[size_t(i)], slot);
      const bool filled = step.o.seen->filled.isValueOn(child);
      if (!filled && !step.o.seen->empty.isValueOn(child)) {
        ++unknown;
        continue;
      }
      const double p = 1 / (1 + std::exp(-logits[i][slot].item<double>()));
      sum -= std::log(filled ? p : 1 - p), ++known;
    }
  ASSERT_GT(unknown, 0);
  EXPECT_NEAR(split, sum / known, 1e-4 * sum / known);
}

TEST(EncoderTraining, AStepLowersTheLossAtEveryLevel) {  // sections 2.3 and 3.7
  const std::vector<View> views = roomViews(2);
  for (int levels : {0, 1, 2}) {
    const auto [before, after] = encoderStepLoss(toyEncoder(levels), views, 15);
    EXPECT_TRUE(std::isfinite(before));
    EXPECT_LT(after, before) << levels << " levels";
  }
}

TEST(EncoderTraining, MixedPrecisionIsCloseToFloatAndEndsWithItsScope) {
  torch::manual_seed(17);
  SelfBlock block(32, 2);
  const Tensor x = torch::randn({40, 32});
  const auto run = [&] {
    block.zero_grad();
    const Tensor y = block.forward(x, nullptr);
    y.square().mean().backward();
    return std::pair(y.detach().clone(), block.mlp->first->weight.grad().clone());
  };
  const auto exact = run();
  const auto mixed = [&] {
    const MixedPrecision on(true);
    return run();
  }();
  const auto off = [](const Tensor& a, const Tensor& b) {
    return ((a - b).norm() / b.norm()).item<double>();
  };
  EXPECT_EQ(mixed.first.scalar_type(), torch::kFloat32);
  EXPECT_EQ(mixed.second.scalar_type(), torch::kFloat32);
  EXPECT_GT(off(mixed.first, exact.first), 1e-6) << "not in bfloat16";
  EXPECT_LT(off(mixed.first, exact.first), .01);
  EXPECT_LT(off(mixed.second, exact.second), .03);
  EXPECT_TRUE(torch::equal(run().first, exact.first));
}

TEST(EncoderTraining, PaperPresetRunsAStep) {  // sections 3.5 and 3.7: M = 216, width 512
  const auto [before, after] = encoderStepLoss(EncoderConfig::paper(), {nearWall(32, .35f)}, 16);
  EXPECT_TRUE(std::isfinite(before));
  EXPECT_TRUE(std::isfinite(after));
  EXPECT_NE(before, after);
}

class EncoderResume : public InFolder {};

/// Four views of one room, others for each index.
std::vector<View> rotatedViews(uint64_t index) {
  std::vector<View> views = roomViews(8);
  std::rotate(views.begin(), views.begin() + std::ptrdiff_t(index % 8), views.end());
  views.resize(4);
  return views;
}

TEST_F(EncoderResume, AnInterruptedRunEndsAsAnUninterruptedOne) {  // section 3.7
  const EncoderConfig c = toyEncoder();
  const SceneSource validation = [](uint64_t) { return roomViews(6); };
  TrainSettings settings;
  settings.steps = 6, settings.warmup = 2, settings.validate_every = settings.checkpoint_every = 3;
  settings.metadata["trained_on"] = "rooms:42-42";
  const auto train = [&](const std::string& name, bool resume, Progress& progress) {
    settings.weights_path = path(name + ".safetensors"), settings.work_folder = path(name);
    settings.resume = resume;
    std::vector<TrainLogRow> rows;
    trainEncoder(
        c, rotatedViews, 5, validation, 1, settings,
        [&](const TrainLogRow& row) { rows.push_back(row); }, progress);
    return rows;
  };
  Progress silent;
  const std::vector<TrainLogRow> rows = train("whole", false, silent);
  ASSERT_EQ(rows.size(), 2u);
  for (const char* value : {"loss", "image", "kl", "split", "input_psnr", "novel_psnr"})
    EXPECT_TRUE(std::isfinite(rows[1].values.at(value))) << value;
  StopAtHalf stop;
  EXPECT_THROW(train("parts", false, stop), Cancelled);
  EXPECT_NE(bytesOf(path("parts.safetensors")), bytesOf(path("whole.safetensors")));
  train("parts", true, silent);
  EXPECT_EQ(bytesOf(path("parts.safetensors")), bytesOf(path("whole.safetensors")));
  EXPECT_EQ(bytesOf(path("parts/checkpoint.safetensors")),
            bytesOf(path("whole/checkpoint.safetensors")));
  EXPECT_EQ(bytesOf(path("parts/log.csv")), bytesOf(path("whole/log.csv")));
  EXPECT_EQ(Encoder(path("whole.safetensors")).trainedOn(), "rooms:42-42");
  // A checkpoint of another network is not taken up.
  settings.resume = true;
  EncoderConfig other = c;
  other.kl_weight = .5f;
  EXPECT_THROW(trainEncoder(other, rotatedViews, 5, validation, 0, settings, nullptr, silent),
               Error);
}

/// Trains a toy network on rotations of one room's views and returns the log.
std::vector<TrainLogRow> trainToy(TrainSettings settings, const std::string& folder) {
  settings.steps = 4, settings.warmup = 1, settings.validate_every = 1, settings.batch = 2;
  settings.weights_path = folder + "/w.safetensors", settings.work_folder = folder + "/work";
  std::vector<TrainLogRow> rows;
  Progress silent;
  trainEncoder(
      toyEncoder(), rotatedViews, 5, [](uint64_t) { return roomViews(6); }, 1, settings,
      [&](const TrainLogRow& row) { rows.push_back(row); }, silent);
  return rows;
}

TEST_F(EncoderResume, ABatchesGradientIsTheMeanOfItsSamples) {  // section 3.7
  auto net = std::make_shared<torch::nn::LinearImpl>(3, 1),
       average = std::make_shared<torch::nn::LinearImpl>(3, 1);
  TrainSettings settings;
  settings.batch = 2, settings.work_folder = path("mean");
  Trainer trainer(net, average, "toy", "{}", settings, nullptr);
  const Tensor x = torch::randn({2, 3});
  for (int i = 0; i < 2; ++i) trainer.addLoss((i + 1) * net->forward(x[i]).sum(), {});
  EXPECT_TRUE(torch::allclose(net->weight.grad(), ((x[0] + 2 * x[1]) / 2).unsqueeze(0)));
}

TEST_F(EncoderResume, TwoProcessesTrainAsOneWithTheirBatch) {  // section 3.7, data parallel by Gloo
  const std::vector<TrainLogRow> alone = trainToy({}, path("one"));
  TrainSettings shared;
  shared.processes.size = 2, shared.processes.port = uint16_t(20000 + getpid() % 20000);
  // fork() and threads do not mix: the second process starts over in this program, as the test
  // below.
  ASSERT_EQ(
      setenv("VDBC_SECOND_PROCESS", joinText(shared.processes.port, " ", path("two")).c_str(), 1),
      0);
  const std::string program = fs::read_symlink("/proc/self/exe").string();
  FILE* second = popen((program + " --gtest_also_run_disabled_tests "
                                  "--gtest_filter=EncoderResume.DISABLED_SecondProcess 2>&1")
                           .c_str(),
                       "r");
  ASSERT_NE(second, nullptr);
  const std::vector<TrainLogRow> together = trainToy(shared, path("two"));
  std::string output;
  for (int c; (c = std::fgetc(second)) != EOF;) output += char(c);
  EXPECT_EQ(pclose(second), 0) << output;
  ASSERT_EQ(together.size(), alone.size());
  for (size_t i = 0; i < alone.size(); ++i)
    for (const char* value : {"loss", "image", "kl", "split", "novel_psnr"})
      EXPECT_NEAR(together[i].values.at(value), alone[i].values.at(value),
                  1e-4 * std::abs(alone[i].values.at(value)))
          << "step " << i + 1 << ", " << value;
}

TEST_F(EncoderResume, DISABLED_SecondProcess) {
  std::istringstream text(std::getenv("VDBC_SECOND_PROCESS"));
  TrainSettings shared;
  std::string folder;
  text >> shared.processes.port >> folder;
  shared.processes.size = 2, shared.processes.rank = 1;
  EXPECT_TRUE(trainToy(shared, folder + "_second").empty());  // the first process logs
  EXPECT_FALSE(fs::exists(folder + "_second/w.safetensors"));
}

TEST_F(EncoderResume, ABatchThatProcessesCannotShareIsRefused) {
  TrainSettings settings;
  settings.processes.size = 3;
  settings.processes.rank = 3;
  EXPECT_THROW(trainToy(settings, path("bad")), Error);
}

}  // namespace
}  // namespace vdbc
