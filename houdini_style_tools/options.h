#pragma once
// Options that several verbs have, and what they name.
#include <nlohmann/json_fwd.hpp>
#include <string>
#include <vector>

#include "encoder/views/read_views.h"
#include "houdini_style_tools/complete.h"
#include "houdini_style_tools/verb.h"
#include "vdb/latent_vdb.h"

namespace vdbc {

/// What is completed or encoded, and in what volume.
struct SceneOptions {
  std::string views, output, weights;
  std::vector<int> frames;         // empty: all
  double metres_per_unit = 0;      // of pointmaps; 0: from their cameras' baseline
  std::vector<double> up, bounds;  // x y z; two corners; empty: as the views say
  SceneSettings settings;
};

Option viewsOption(std::string* views);
Option framesOption(std::vector<int>* frames);
Option scaleOption(double* metres_per_unit);
Option weightsOption(std::string* folder);
Option marginOption(SceneSettings* settings);
Option childTauOption(float* child_threshold);
Option antialiasOption(bool* antialias);
/// Where to complete: bounds, up, scale.
std::vector<Option> volumeOptions(SceneOptions* o);

/// How sharp what views saw is.
std::vector<Option> detailOptions(DetailSettings* settings);

Option tauOption(CompleteSettings* settings);
Option fromLevelOption(CompleteSettings* settings);
/// How a place grows, beside tau.
std::vector<Option> growthOptions(CompleteSettings* settings);
/// All options that change what is generated from the same tokens: those that a completion which
/// goes on where another stopped has to have in common with it.
std::vector<Option> identityOptions(CompleteSettings* settings);

/// The folder with encoder.safetensors and completer.safetensors: `given`, or the one beside the
/// program.
std::string weightsFolder(const std::string& given);
/// `given` (x y z), normalised.
Eigen::Vector3d upOf(const std::vector<double>& given);
/// The settings with `up` and the options' bounds.
SceneSettings settingsOf(const SceneOptions& o, const Eigen::Vector3d& up);

/// What completing and encoding start from.
struct SceneInput {
  std::vector<View> views;
  SceneSettings settings;  // with the views' up
};
SceneInput readScene(const SceneOptions& o);
/// Where the size of pointmaps is from: for the result of a verb, and as a line; nothing for other
/// views.
nlohmann::ordered_json scaleJson(const SceneOptions& o);
std::string scaleLine(const SceneOptions& o);

/// Latents that this encoder made, of a place that it could have seen.
Place readLatents(const std::string& path, const Encoder& encoder, const std::string& weights);

/// Code that only knows the views cannot say in an Error where they are from.
template <typename Function>
auto naming(const std::string& source, const Function& function) {
  try {
    return function();
  } catch (const Error& e) {
    throw Error(joinText(source, ": ", e.what()));
  }
}

/// Results would lie over what they were made of: refuses `stem`.vdb and its siblings for `from`.
void requireOtherName(const std::string& from, const std::string& ending, const std::string& stem);
bool endsWith(const std::string& text, const std::string& ending);

}  // namespace vdbc
