#pragma once
// Private: options that both programs, vdb_complete and vdb_lab, have.
#include <malloc.h>

#include <CLI/CLI.hpp>
#include <cstdio>
#include <filesystem>
#include <sstream>
#include <string>
#include <vector>

#include "houdini_style_tools/blas.h"
#include "houdini_style_tools/complete.h"

namespace vdbc {

namespace fs = std::filesystem;

// Options, one struct a verb; names as on the command line.
struct Common {
  uint64_t seed = 1;
  int threads = 0;
  bool json = false;
};

struct Complete {
  std::string views, frames, output, weights, region, lock;
  int from_level = 1, samples = 1;
  bool resume = false;
  std::vector<double> up, bounds;
  double scale = 0;
  double margin = VolumeSettings().margin_m;
  double tau = CompleteSettings().tau, coarse_tau = CompleteSettings().coarse_tau;
  double hole_tau = CompleteSettings().hole_tau;
  double child_tau = SceneSettings().child_threshold;
  double temperature = 1;
  int sampling_steps = 0;
  bool generated_context = false, refine_observed = false, antialias = false;
};

// "0,3,5-9" -> 0 3 5 6 7 8 9.
inline std::vector<int> frameList(const std::string& text) {
  std::vector<int> frames;
  std::stringstream parts(text);
  for (std::string part; std::getline(parts, part, ',');) {
    int first = 0, last = 0, used = 0;
    const int found = std::sscanf(part.c_str(), "%d%n-%d%n", &first, &used, &last, &used);
    if (found == 1) last = first;
    if (found < 1 || size_t(used) != part.size() || first < 0 || last < first ||
        last - first > 100000)
      throw UsageError(
          joinText("--frames: ", text, ": expected numbers and ranges such as 0,3,5-9"));
    for (int f = first; f <= last; ++f) frames.push_back(f);
  }
  return frames;
}

inline std::string executableFolder() {
  std::error_code error;
  const fs::path self = fs::read_symlink("/proc/self/exe", error);
  return error ? "." : self.parent_path().string();
}

// The folder with encoder.safetensors and completer.safetensors.
inline std::string weightsFolder(const std::string& given) {
  if (!given.empty()) return given;
  for (const char* place : {"/../../weights/small", "/../share/vdb_complete/weights/small"}) {
    const std::string folder = executableFolder() + place;
    if (fs::exists(folder + "/encoder.safetensors")) return fs::weakly_canonical(folder).string();
  }
  throw Error(
      "--weights: no trained weights beside the program (expected weights/small; use --weights "
      "FOLDER)");
}

inline SceneSettings sceneSettings(const Complete& o, const Common& common,
                                   const Eigen::Vector3d& up) {
  SceneSettings s;
  s.observing.volume.up = up;
  s.observing.volume.margin_m = float(o.margin);
  if (!o.bounds.empty()) {
    s.observing.volume.bounds =
        Eigen::AlignedBox3d(Eigen::Vector3d(o.bounds[0], o.bounds[1], o.bounds[2]),
                            Eigen::Vector3d(o.bounds[3], o.bounds[4], o.bounds[5]));
    const Eigen::Vector3d sizes = s.observing.volume.bounds->sizes();
    if (!sizes.allFinite() || sizes.minCoeff() <= 0)
      throw UsageError(
          "--bounds: expected a box: x0 y0 z0 x1 y1 z1 with each second corner larger");
  }
  s.completion.tau = float(o.tau), s.completion.coarse_tau = float(o.coarse_tau);
  s.completion.hole_tau = float(o.hole_tau);
  s.child_threshold = float(o.child_tau);
  s.completion.sampling_steps = o.sampling_steps, s.completion.temperature = o.temperature;
  s.completion.generated_context = o.generated_context;
  s.completion.refine_observed = o.refine_observed;
  s.antialias = o.antialias;
  s.completion.seed = common.seed;
  return s;
}

inline Eigen::Vector3d upOf(const std::vector<double>& given) {
  const Eigen::Vector3d up(given[0], given[1], given[2]);
  if (!up.allFinite() || up.norm() < 1e-6)
    throw UsageError("--up: expected a finite vector that is not zero");
  return up.normalized();
}

// Code that only knows the views cannot say in an Error where they are from.
template <typename Function>
auto naming(const std::string& source, const Function& function) {
  try {
    return function();
  } catch (const Error& e) {
    throw Error(joinText(source, ": ", e.what()));
  }
}

// CLI::Range lets NaN pass.
struct Between : CLI::Range {
  Between(double low, double high) : Range(low, high) {
    func_ = [low, high](std::string& text) {
      double value = 0;
      if (CLI::detail::lexical_cast(text, value) && value >= low && value <= high)
        return std::string();
      return joinText("expected ", low, " to ", high, ", found ", text);
    };
  }
};

inline void addCommon(CLI::App* app, Common* c) {
  app->add_option("--seed", c->seed, "fixes every random choice")->capture_default_str();
  app->add_option("--threads", c->threads, "worker threads, 0 = all cores")
      ->envname("VDB_COMPLETE_THREADS")
      ->check(CLI::Range(0, 1024))
      ->capture_default_str();
  app->add_flag("--json", c->json,
                "results (stdout) and progress (stderr) as JSON, one object a line");
}

inline void addScale(CLI::App* app, double* scale) {
  app->add_option("--scale", *scale, "metres per unit of an .npz [from its camera baseline]")
      ->check(Between(1e-6, 1e6));
}

inline void addMargin(CLI::App* app, Complete* o) {
  app->add_option("--margin", o->margin, "room around what was seen [m]")
      ->check(Between(0, 100))
      ->capture_default_str();
}

inline void addChildTau(CLI::App* app, double* child_tau) {
  app->add_option("--child-tau", *child_tau,
                  "a voxel of a kept token is kept above this probability")
      ->check(Between(0, 1))
      ->capture_default_str();
}

inline void addWeights(CLI::App* app, std::string* weights) {
  app->add_option("--weights", *weights,
                  "folder with encoder.safetensors and completer.safetensors");
}

inline void addCompletion(CLI::App* app, Complete* o) {
  addMargin(app, o);
  app->add_option("--tau", o->tau, "a token is kept above this probability")
      ->check(Between(0, 1))
      ->capture_default_str();
  app->add_option("--coarse-tau", o->coarse_tau, "the same for the coarse gate")
      ->check(Between(0, 1))
      ->capture_default_str();
  app->add_option(
         "--hole-tau", o->hole_tau,
         "above this probability dropped tokens are taken back where they close a hole, 1 = none")
      ->check(Between(0, 1))
      ->capture_default_str();
  addChildTau(app, &o->child_tau);
  app->add_option("--sampling-steps", o->sampling_steps, "diffusion steps, 0 = the linear mean")
      ->check(CLI::Range(0, 1000))
      ->capture_default_str();
  app->add_option("--temperature", o->temperature, "of the diffusion head")
      ->check(Between(0, 10))
      ->capture_default_str();
  app->add_flag("--generated-context", o->generated_context,
                "generated tokens are context of later levels, as in the paper");
  app->add_flag("--refine-observed", o->refine_observed,
                "let the completer rewrite observed latents");
}

// Runs a program; its exit code.
inline int runProgram(const char* name, int run(int, char**), int argc, char** argv) {
  setUpProcess();
  // Tensors of some megabytes come and go: keep their pages instead of asking the kernel each time.
  mallopt(M_MMAP_THRESHOLD, 1 << 30);
  mallopt(M_TRIM_THRESHOLD, 1 << 30);
  try {
    const int code = run(argc, argv);
    require(std::fflush(stdout) == 0, "standard output: cannot write the results");
    return code;
  } catch (const Cancelled&) {
    std::fprintf(stderr, "%s: interrupted\n", name);
    return 130;
  } catch (const UsageError& e) {
    std::fprintf(stderr, "%s: %s\n", name, e.what());
    return 2;
  } catch (const std::exception& e) {
    std::fprintf(stderr, "%s: %s\n", name, firstLine(e).c_str());
    return 1;
  }
}

}  // namespace vdbc
