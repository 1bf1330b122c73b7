// What weights say they were made for, as JSON: both networks' configurations, and the files that
// are shipped.
#include <gtest/gtest.h>

#include <cstring>
#include <nlohmann/json.hpp>

#include "encoder/encoder.h"
#include "mar/completer.h"
#include "tests/files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using nlohmann::json;

template <typename Config>
json fieldsOf(const Config& config) {
  return json::parse(config.toJson());
}

template <typename Config>
class WeightsConfig : public testing::Test {};
using Configs = testing::Types<EncoderConfig, CompleterConfig>;
TYPED_TEST_SUITE(WeightsConfig, Configs);

TYPED_TEST(WeightsConfig, JsonRoundTripIsExact) {
  for (const TypeParam& c : {TypeParam::small(), TypeParam::paper()})
    EXPECT_EQ(TypeParam::fromJson(c.toJson(), "test").toJson(), c.toJson());
  EXPECT_NE(TypeParam::small().toJson(), TypeParam::paper().toJson());
}

TYPED_TEST(WeightsConfig, EveryFieldIsReadAndOthersKeepTheirDefaults) {
  const json defaults = fieldsOf(TypeParam());
  EXPECT_EQ(fieldsOf(TypeParam::fromJson("{}", "test")), defaults);
  for (const auto& [name, value] : defaults.items()) {
    json changed;
    if (value.is_boolean())
      changed = !value.template get<bool>();
    else if (value.is_string())
      changed = "another";
    else if (value.is_number_float())
      changed = value.template get<float>() / 2 + .0625f;
    else
      changed = 2 * value.template get<int>();
    json truth = defaults;
    truth[name] = changed;
    EXPECT_NE(truth, defaults) << name;
    EXPECT_EQ(fieldsOf(TypeParam::fromJson(json{{name, changed}}.dump(), "test")), truth) << name;
  }
  for (const char* name : {"extent_m", "rotary_highest", "rotary_lowest"})
    EXPECT_TRUE(defaults.contains(name)) << name;
}

TYPED_TEST(WeightsConfig, RefusesWhatItDoesNotKnow) {
  const auto rejected = [](const std::string& text) {
    EXPECT_THROW(TypeParam::fromJson(text, "test"), Error) << text;
  };
  json unknown = fieldsOf(TypeParam());
  unknown["widht"] = 3;
  rejected(unknown.dump());
  try {
    TypeParam::fromJson(unknown.dump(), "some/path");
  } catch (const Error& e) {
    EXPECT_NE(std::string(e.what()).find("widht"), std::string::npos) << e.what();
    EXPECT_NE(std::string(e.what()).find("some/path"), std::string::npos) << e.what();
  }
  for (const char* text : {"", "not JSON", "{", "[]", "null", "3", "\"small\"", "[{}]"})
    rejected(text);
  const json fields = fieldsOf(TypeParam());
  for (const auto& [name, value] : fields.items()) {
    rejected(json{{name, json::array({1})}}.dump());
    rejected(json{{name, value.is_string() ? json(1) : json("1")}}.dump());
  }
}

TEST(CompleterConfig, RefusesSizesThatCannotWork) {
  const auto rejected = [](const char* name, auto value) {
    EXPECT_THROW(CompleterConfig::fromJson(json{{name, value}}.dump(), "test"), Error)
        << name << " " << value;
  };
  for (const char* name : {"latent_dim", "width", "heads", "layers", "coarse_width", "coarse_heads",
                           "coarse_layers", "diffusion_width", "diffusion_steps", "context_tokens",
                           "chunk_tokens", "coarse_chunk_tokens"})
    rejected(name, 0);
  for (const char* name :
       {"latent_groups", "diffusion_draws", "empty_tokens", "coarse_empty_tokens"})
    rejected(name, -1);
  rejected("heads", 5), rejected("coarse_heads", 5), rejected("latent_groups", 7);
  rejected("extent_m", .5f), rejected("extent_m", 1001.f);
  rejected("window_overlap_m", -.1f), rejected("window_overlap_m", 3.3f);
}

// --- files ---------------------------------------------------------------------------------------

/// The metadata of a safetensors file.
json metadataOf(const std::string& path) {
  const std::string bytes = bytesOf(path);
  uint64_t length = 0;
  if (bytes.size() < sizeof(length)) return {};
  std::memcpy(&length, bytes.data(), sizeof(length));
  return json::parse(bytes.substr(sizeof(length), length))["__metadata__"];
}

/// Each field is what the file says or, where it says nothing, the default.
template <typename Config>
void expectFileOrDefault(const Config& config, const std::string& text) {
  const json file = json::parse(text), found = fieldsOf(config), defaults = fieldsOf(Config());
  for (const auto& [name, value] : found.items()) {
    const json& truth = file.contains(name) ? file[name] : defaults[name];
    if (truth.is_number_float()) {
      EXPECT_EQ(value.template get<float>(), truth.get<float>()) << name;
    } else {
      EXPECT_EQ(value, truth) << name;
    }
  }
}

TEST(ShippedWeights, AreWhatTheyWere) {
  const std::string folder = VDBC_SOURCE_DIR "/weights/indoor";
  const std::string encoder_path = folder + "/encoder.safetensors",
                    completer_path = folder + "/completer.safetensors";
  const Encoder encoder(encoder_path);
  EXPECT_EQ(encoder.hash(), "f7fa8a83edff251c");
  const std::string sizes = metadataOf(encoder_path)["encoder"];
  EXPECT_FALSE(json::parse(sizes).contains("extent_m"));  // from before some fields existed
  expectFileOrDefault(encoder.config(), sizes);
  const Completer completer(completer_path);
  EXPECT_EQ(completer.hash(), "e9d276e82057244a");
  expectFileOrDefault(completer.config(), metadataOf(completer_path)["completer"]);
}

TEST(ShippedWeights, OfOtherSizesLoadToo) {
  const std::string path = sharedFile("weights/completer-medium.safetensors");
  if (path.empty()) GTEST_SKIP() << "no medium weights";
  const Completer completer(path);
  EXPECT_EQ(completer.hash(), "b8b82da56325c453");
  expectFileOrDefault(completer.config(), metadataOf(path)["completer"]);
}

}  // namespace
}  // namespace vdbc
