#include "examples/lab/evaluate.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <map>
#include <numeric>
#include <random>

#include "encoder/views/read_views.h"
#include "examples/lab/feature_distances.h"
#include "examples/lab/judge.h"
#include "examples/lab/scenes.h"
#include "examples/lab/scores.h"
#include "examples/rooms/rooms.h"
#include "houdini_style_tools/verb.h"
#include "splat/image_files.h"
#include "splat/metrics.h"
#include "splat/rasterize.h"
#include "vdb/process.h"
#include "vdb/progress.h"
#include "vdb/token_map.h"

namespace vdbc {
namespace {

constexpr int kLeakRays = 8192;
constexpr size_t kShownViews = 4;  // rows of a picture

// What a method made: Gaussians to look at, voxels to trace and to count.
struct MethodOutput {
  Gaussians gaussians;
  std::vector<Coord> voxels;
};

EvaluationScene roomScene(Room room, uint64_t seed, int views) {
  EvaluationScene s;
  s.name = room.name;
  const RoomRenderer renderer(room);
  // The same targets for any number of input views up to that of training.
  const int inputs = std::max(views, kRoomViews);
  const std::vector<Camera> cameras =
      roomCameras(room, renderer, inputs + kTargetViews, kRoomSide, kRoomSide, seed);
  for (int i = 0; i < int(cameras.size()); ++i)
    if (i < views || i >= inputs)
      (i < views ? s.input : s.targets)
          .push_back(renderer.render(cameras[size_t(i)], kRoomSamples, seed + uint64_t(i)));
  s.truth = solidMesh(room.surface), s.shell = shellMesh(room);
  s.free_points = freePoints(room, 64, seed);
  s.is_within =
      [kept = std::make_shared<const Room>(std::move(room))](const Eigen::Vector3f& p_world) {
        return isWithin(*kept, kept->world_from_room.inverse() * p_world);
      };
  return s;
}

EvaluationScene folderScene(const std::string& folder, int views, std::vector<int> frames,
                            uint64_t seed) {
  EvaluationScene s;
  s.name = folder;
  s.up = conventionalUp(folder);
  const std::vector<View> all = readViews(folder);
  if (frames.empty()) {
    frames.resize(all.size());
    std::iota(frames.begin(), frames.end(), 0);
    std::mt19937_64 random(seed);
    for (size_t i = all.size() - 1; i > 0; --i) std::swap(frames[i], frames[random() % (i + 1)]);
    frames.resize(std::min(frames.size(), size_t(views)));
  }
  require(frames.size() < all.size(), "eval: ", folder, ": expected more than ", frames.size(),
          " frames, found ", all.size());
  for (int f = 0; f < int(all.size()); ++f) {
    const bool input = std::find(frames.begin(), frames.end(), f) != frames.end();
    (input ? s.input : s.targets).push_back(all[size_t(f)]);
  }
  require(s.input.size() == frames.size(), "eval: ", folder,
          ": --frames: expected different numbers below ", all.size());
  return s;
}

}  // namespace

Eigen::Vector3d centreOf(const Coord& node) {
  return {2. * node.x() + 1, 2. * node.y() + 1, 2. * node.z() + 1};
}

namespace {

// An opaque-looking Gaussian for a node of level 1.
void addNode(const VoxelFrame& frame, const Coord& node, const Eigen::Vector3f& srgb,
             Gaussians* g) {
  addIsotropic(frame.toWorld(centreOf(node)), frame.voxel_m, srgb, g);
}

Eigen::Vector3f meanColour(const SceneVoxels& voxels) {
  Eigen::Vector3f sum = Eigen::Vector3f::Zero();
  for (const auto& c : voxels.colour_linear)
    sum += Eigen::Vector3f(srgbFromLinear(c[0]), srgbFromLinear(c[1]), srgbFromLinear(c[2]));
  return sum / float(std::max<size_t>(1, voxels.colour_linear.size()));
}

void addVoxelsOfNode(const Coord& node, std::vector<Coord>* voxels) {
  for (int slot = 0; slot < 8; ++slot) voxels->push_back(childCoord(node, slot));
}

// Every unobserved node of the volume takes the colour of the nearest observed voxel. The nearest
// one is found by growing from the observed nodes, ring by ring.
MethodOutput nearestFill(const MethodOutput& observed, const SceneVoxels& seen,
                         const SeenSpace& states) {
  MethodOutput out = observed;
  std::map<Coord, Eigen::Vector3f> colour;
  for (size_t i = 0; i < seen.ijk.size(); ++i) {
    const auto& c = seen.colour_linear[i];
    colour.emplace(
        tokenCoord(seen.ijk[i], 1),
        Eigen::Vector3f(srgbFromLinear(c[0]), srgbFromLinear(c[1]), srgbFromLinear(c[2])));
  }
  std::vector<Coord> ring;
  for (const auto& entry : colour) ring.push_back(entry.first);
  while (!ring.empty()) {
    std::map<Coord, Eigen::Vector3f> next;
    for (const Coord& c : ring)
      for (int axis = 0; axis < 3; ++axis)
        for (int step : {-1, 1}) {
          Coord n = c;
          n[axis] += step;
          if (states.box.isInside(n) && !colour.count(n)) next.emplace(n, colour.at(c));
        }
    ring.clear();
    for (const auto& [node, value] : next) {
      colour.emplace(node, value);
      ring.push_back(node);
    }
  }
  for (const Coord& node : unobservedNodes(states, states.box)) {
    addNode(seen.frame, node, colour.at(node), &out.gaussians);
    addVoxelsOfNode(node, &out.voxels);
  }
  return out;
}

// Floor, ceiling and walls fitted to what was seen (the box of the seen voxels, a half per cent
// trimmed at each side); its unobserved nodes take the mean colour.
MethodOutput manhattanBox(const MethodOutput& observed, const SceneVoxels& seen,
                          const SeenSpace& states) {
  MethodOutput out = observed;
  Coord lo, hi;
  for (int axis = 0; axis < 3; ++axis) {
    std::vector<int> values;
    for (const Coord& v : seen.ijk) values.push_back(v[axis]);
    std::sort(values.begin(), values.end());
    const size_t trim = values.size() / 200;
    lo[axis] = values[trim] >> 1, hi[axis] = values[values.size() - 1 - trim] >> 1;
  }
  const Eigen::Vector3f colour = meanColour(seen);
  const CoordBBox box(lo, hi);
  for (auto i = box.begin(); i; ++i) {
    const Coord node = *i;
    const bool face = node.x() == lo.x() || node.x() == hi.x() || node.y() == lo.y() ||
                      node.y() == hi.y() || node.z() == lo.z() || node.z() == hi.z();
    if (!face || states.at(node) != NodeState::kUnobserved) continue;
    addNode(seen.frame, node, colour, &out.gaussians);
    addVoxelsOfNode(node, &out.voxels);
  }
  return out;
}

Eigen::Vector3f meanPixel(const std::vector<View>& views) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double count = 0;
  for (const View& v : views)
    for (size_t i = 0; i + 2 < v.colour.data.size(); i += 3, ++count)
      sum += Eigen::Map<const Eigen::Vector3f>(&v.colour.data[i]).cast<double>();
  return (sum / std::max(1., count)).cast<float>();
}

// What all methods are held to in a scene.
struct Truths {
  const SeenSpace& seen;   // of the input views, voxels
  SeenSpace all;           // of these and the targets
  Eigen::Vector3f ground;  // the input pictures' mean colour, display sRGB
  // [H * W] of each target: pixels whose surface the input saw, and those with another surface.
  std::vector<std::vector<uint8_t>> seen_pixels, unseen_pixels;

  Truths(const EvaluationScene& scene, const VoxelFrame& frame, const SeenSpace& input,
         const CarveSettings& carving, Progress& progress)
      : seen(input),
        all(seenByAll(scene, frame, carving, progress)),
        ground(meanPixel(scene.input)) {
    StateLookup states(input);
    for (const View& v : scene.targets) {
      const int w = v.camera.width;
      std::vector<uint8_t> in(v.depth.size(), 0), out = in;
      for (size_t i = 0; i < v.depth.size(); ++i) {
        if (!(v.depth[i] > 0) || !std::isfinite(v.depth[i])) continue;
        const Eigen::Vector3d p = frame.toIndex(v.camera.unproject(
            double(int(i) % w) + .5, double(int(i) / w) + .5, double(v.depth[i])));
        const Coord ijk(int(std::floor(p.x())), int(std::floor(p.y())), int(std::floor(p.z())));
        (states(ijk) == NodeState::kFilled ? in : out)[i] = 1;
      }
      seen_pixels.push_back(std::move(in)), unseen_pixels.push_back(std::move(out));
    }
  }
};

Image overColour(const RasterOutput& out, const Eigen::Vector3f& ground) {
  Image image = out.colour;
  for (size_t i = 0; i < image.data.size(); ++i)
    image.data[i] =
        std::clamp(image.data[i] + (1 - out.alpha.data[i / 3]) * ground[int(i % 3)], 0.f, 1.f);
  return image;
}

// What the target views' cameras see of the Gaussians, against what is there; keeps the first
// pictures in `shown`.
void measurePictures(const EvaluationScene& scene, const Truths& truths, const Gaussians& gaussians,
                     const UserNets& nets, MethodResult* r, std::vector<Image>* shown) {
  const double share = 1 / double(scene.targets.size());
  RasterSettings settings;
  settings.antialias = gaussians.antialias, settings.median_depth = true;
  std::vector<double> medians, rmses, seen, unseen, unseen_ssims, unseen_flips;
  PixelVerdict pixels;
  if (!nets.lpips) r->lpips = kNan;
  for (size_t t = 0; t < scene.targets.size(); ++t) {
    const View& target = scene.targets[t];
    RasterOutput out = rasterize(gaussians, target.camera, settings);
    const Image filled = overColour(out, truths.ground);
    for (float& v : out.colour.data) v = std::clamp(v, 0.f, 1.f);
    r->psnr += share * psnr(out.colour, target.colour);
    r->ssim += share * ssim(out.colour, target.colour);
    r->flip += share * flip(target.colour, out.colour);
    r->mean_psnr += share * psnr(filled, target.colour);
    r->mean_ssim += share * ssim(filled, target.colour);
    r->mean_flip += share * flip(target.colour, filled);
    const PictureError in = pictureError(target.colour, filled, truths.seen_pixels[t]),
                       out_of = pictureError(target.colour, filled, truths.unseen_pixels[t]);
    if (in.pixels > 0) seen.push_back(in.psnr);
    if (out_of.pixels > 0) {
      unseen.push_back(out_of.psnr), unseen_ssims.push_back(out_of.ssim);
      unseen_flips.push_back(out_of.flip);
    }
    const PixelVerdict verdict = judgePixels(out.median_depth.data, target.depth);
    r->blocked += share * verdict.blocked, r->right += share * verdict.right;
    r->behind += share * verdict.behind, r->open += share * verdict.open;
    if (nets.lpips) r->lpips += share * nets.lpips->distance(target.colour, out.colour);
    if (nets.features) {
      r->features.push_back(nets.features->features(out.colour));
      r->true_features.push_back(nets.features->features(target.colour));
    }
    if (shown->size() < kShownViews) shown->push_back(std::move(out.colour));
    const DepthError depth = depthError(out.median_depth.data, target.depth);
    if (std::isnan(depth.rmse_m)) continue;
    r->depth_share += share * depth.share;
    medians.push_back(depth.median_abs_m), rmses.push_back(depth.rmse_m);
  }
  r->depth_median_m = meanOf(medians), r->depth_rmse_m = meanOf(rmses);
  r->seen_psnr = meanOf(seen), r->unseen_psnr = meanOf(unseen);
  r->unseen_ssim = meanOf(unseen_ssims), r->unseen_flip = meanOf(unseen_flips);
}

void measureVoxels(const Truths& truths, const std::vector<Coord>& voxels, MethodResult* r) {
  const VoxelVerdict v = judgeVoxels(truths.seen, truths.all, voxels);
  r->confirmed = double(v.confirmed), r->contradicted = double(v.contradicted);
  r->undecided = double(v.undecided);
  r->voxel_precision = v.exact.precision, r->voxel_recall = v.exact.recall;
  r->voxel_f1 = v.exact.f1;
  r->near_precision = v.near.precision, r->near_recall = v.near.recall, r->near_f1 = v.near.f1;
}

// What input and target views say together, in the frame.
Place densePlace(const EvaluationScene& scene, const Encoder& encoder, ObserveSettings observing,
                 const VoxelFrame& frame, Progress& progress) {
  std::vector<View> views = scene.input;
  views.insert(views.end(), scene.targets.begin(), scene.targets.end());
  observing.frame = frame;
  return encoder.encode(views, observe(views, encoder.observing(observing), progress), progress);
}

// The latents that `from` has for tokens of `place`, in their place.
Place withLatentsOf(Place place, const Place& from) {
  TokenMap<size_t> rows;
  for (size_t i = 0; i < from.ijk.size(); ++i) rows.insert(from.ijk[i], i);
  const auto dim = size_t(place.dim);
  for (size_t i = 0; i < place.ijk.size(); ++i)
    if (const size_t* row = place.generated[i] ? rows.find(place.ijk[i]) : nullptr)
      std::copy_n(&from.z[*row * dim], dim, &place.z[i * dim]);
  return place;
}

// The nodes of level 1 that count: of a scene with truth, those that were unobserved.
struct UnseenNodes {
  const SeenSpace& states;
  std::set<Coord> truth, shell, furniture;  // what surfaces pass: shell, and the rest

  UnseenNodes(const EvaluationScene& scene, const VoxelFrame& frame, const SeenSpace& node_states)
      : states(node_states) {
    if (!scene.truth) return;
    shell = of(surfaceNodes(*scene.shell, frame, 1));
    truth = furniture = of(surfaceNodes(*scene.truth, frame, 1));
    for (const Coord& node : shell) furniture.erase(node);
  }
  std::set<Coord> of(const std::vector<Coord>& nodes) const {
    std::set<Coord> unseen;
    for (const Coord& node : nodes)
      if (states.at(node) == NodeState::kUnobserved) unseen.insert(node);
    return unseen;
  }
};

void measureNodes(const EvaluationScene& scene, const VoxelFrame& frame, const UnseenNodes& unseen,
                  const std::vector<Coord>& voxels, MethodResult* r) {
  r->precision = r->recall = r->f1 = r->iou = r->shell_recall = r->furniture_recall = r->outside =
      r->leak = kNan;
  if (!scene.truth) return;
  std::vector<Coord> nodes;
  for (const Coord& voxel : voxels) nodes.push_back(tokenCoord(voxel, 1));
  const std::set<Coord> filled = unseen.of(nodes);
  const SetScores all = setScores(filled, unseen.truth);
  r->precision = all.precision, r->recall = all.recall, r->f1 = all.f1, r->iou = all.iou;
  r->shell_recall = setScores(filled, unseen.shell).recall;
  r->furniture_recall = setScores(filled, unseen.furniture).recall;
  r->outside = double(outsideCount(scene, frame, filled, unseen.truth));
  r->leak = sceneLeak(scene, frame, voxels);
}

Eigen::MatrixXd rowsOf(const std::vector<std::vector<float>>& rows) {
  Eigen::MatrixXd m(rows.size(), rows[0].size());
  for (size_t i = 0; i < rows.size(); ++i) {
    require(rows[i].size() == rows[0].size(), "--features: expected ", rows[0].size(),
            " features of every picture, found ", rows[i].size());
    m.row(Eigen::Index(i)) =
        Eigen::Map<const Eigen::RowVectorXf>(rows[i].data(), m.cols()).cast<double>();
  }
  return m;
}

// Those of rooms:N-N or homes:N-N.
std::vector<uint64_t> sceneNumbers(const std::string& spec) {
  try {
    return numberRanges(spec.substr(spec.find(':') + 1));
  } catch (const UsageError& e) {
    throw UsageError(joinText("--scenes: ", spec, ": ", e.what()));
  }
}

}  // namespace

SceneList sceneList(const std::string& spec, int views, const std::vector<int>& frames,
                    uint64_t seed) {
  const bool is_rooms = spec.rfind("rooms:", 0) == 0, is_homes = spec.rfind("homes:", 0) == 0;
  if (!is_rooms && !is_homes)
    return {1, [=](int64_t) { return folderScene(spec, views, frames, seed); }};
  if (!frames.empty()) throw UsageError("--frames: expected a folder as --scenes, found rooms");
  const std::vector<uint64_t> numbers = sceneNumbers(spec);
  const auto count = int64_t(numbers.size());
  if (is_rooms) {
    for (uint64_t room : numbers) requireHeldOut(room);
    return {count, [=](int64_t i) {
              const uint64_t room = numbers[size_t(i)];
              return roomScene(makeRoom(roomAssets(), room), room, views);
            }};
  }
  const auto homes = uint64_t(homeRoomCount(roomAssets()));
  for (uint64_t home : numbers)
    if (home >= homes)
      throw UsageError(joinText("--scenes: ", spec, ": expected numbers below ", homes));
  return {count, [=](int64_t i) {
            const uint64_t home = numbers[size_t(i)];
            return roomScene(homeRoom(roomAssets(), int(home)), home, views);
          }};
}

SetScores setScores(const std::set<Coord>& filled, const std::set<Coord>& truth) {
  double hit = 0;
  for (const Coord& node : filled) hit += double(truth.count(node));
  return {
      filled.empty() ? kNan : hit / double(filled.size()),
      truth.empty() ? kNan : hit / double(truth.size()),
      filled.empty() && truth.empty() ? kNan : 2 * hit / double(truth.size() + filled.size()),
      filled.empty() && truth.empty() ? kNan : hit / (double(truth.size() + filled.size()) - hit)};
}

int64_t outsideCount(const EvaluationScene& scene, const VoxelFrame& frame,
                     const std::set<Coord>& filled, const std::set<Coord>& truth) {
  return std::count_if(filled.begin(), filled.end(), [&](const Coord& node) {
    return !truth.count(node) && !scene.is_within(frame.toWorld(centreOf(node)).cast<float>());
  });
}

Reliability reliabilityOf(const std::vector<Outcome>& outcomes) {
  Reliability bins;
  for (const Outcome& o : outcomes) {
    const double p = o.probability;
    ReliabilityBin& bin = bins[std::min(bins.size() - 1, size_t(p * double(bins.size())))];
    ++bin.count, bin.sum_probability += p, bin.hits += o.occupied;
  }
  return bins;
}

SeenSpace seenByAll(const EvaluationScene& scene, const VoxelFrame& frame,
                    const CarveSettings& carving, Progress& progress) {
  std::vector<DepthView> depths;
  for (const std::vector<View>* views : {&scene.input, &scene.targets})
    for (const View& v : *views) depths.push_back(v.depthView());
  return carve(frame, depths, carving, progress);
}

std::vector<Outcome> outcomesOf(const Place& place, const SeenSpace& all) {
  std::vector<Outcome> outcomes;
  for (size_t i = 0; i < place.ijk.size(); ++i) {
    const NodeState state = all.at(place.ijk[i]);
    if (place.generated[i] && state != NodeState::kUnobserved)
      outcomes.push_back({place.probability[i], state == NodeState::kFilled});
  }
  return outcomes;
}

double calibrationError(const Reliability& reliability) {
  double error = 0, count = 0;
  for (const ReliabilityBin& bin : reliability)
    error += std::abs(double(bin.hits) - bin.sum_probability), count += double(bin.count);
  return count > 0 ? error / count : kNan;
}

double sceneLeak(const EvaluationScene& scene, const VoxelFrame& frame,
                 const std::vector<Coord>& voxels) {
  return leakRate(RayTarget::fromMesh(*scene.truth), RayTarget::fromVoxels(frame, voxels),
                  scene.free_points, kLeakRays, 2 * frame.voxel_m, 1);
}

void addIsotropic(const Eigen::Vector3d& mean, double sigma_m, const Eigen::Vector3f& srgb,
                  Gaussians* g) {
  g->mean.push_back((mean - g->origin).cast<float>());
  g->log_scale.push_back(Eigen::Vector3f::Constant(float(std::log(sigma_m))));
  g->rotation.emplace_back(1, 0, 0, 0);
  g->opacity_logit.push_back(5);  // .993; the rasteriser stops at .99
  for (int c = 0; c < 3; ++c) g->sh.push_back((srgb[c] - .5f) / kSh0);
}

Gaussians pixelAligned(const std::vector<View>& views,
                       const std::vector<std::vector<uint8_t>>& observed) {
  // Of .3, .4, .5, .7, 1, 1.4 and 2 best on views that are not among the input of validation rooms
  // 900000-900003, 12 views in (21.5 dB; .4: 21.4, .7: 21.3, 1: 20.8): wider blurs, narrower leaves
  // gaps where surfaces slope.
  constexpr double kSigmaPixels = .5;
  Gaussians g;
  for (size_t i = 0; i < views.size(); ++i) {
    const View& v = views[i];
    for (int y = 0; y < v.camera.height; ++y)
      for (int x = 0; x < v.camera.width; ++x) {
        const size_t p = size_t(y) * size_t(v.camera.width) + size_t(x);
        if (!observed[i][p]) continue;
        const double z = v.depth[p];
        addIsotropic(v.camera.unproject(x + .5, y + .5, z),
                     kSigmaPixels * z / std::sqrt(v.camera.fx * v.camera.fy),
                     {v.colour.at(x, y, 0), v.colour.at(x, y, 1), v.colour.at(x, y, 2)}, &g);
      }
  }
  return g;
}

void writeColumns(const std::vector<std::vector<Image>>& columns, const std::string& path) {
  const Image& first = columns[0][0];
  std::vector<Image> tiles;
  for (size_t row = 0; row < columns[0].size(); ++row)
    for (const std::vector<Image>& column : columns)
      tiles.push_back(resizeImage(column[row], first.width, first.height));
  writePng(tileImages(tiles, int(columns.size())), path);
}

namespace {
const std::vector<Score<MethodResult>> kMethodScores = {
    {"psnr", &MethodResult::psnr},
    {"ssim", &MethodResult::ssim},
    {"flip", &MethodResult::flip},
    {"mean_psnr", &MethodResult::mean_psnr},
    {"mean_ssim", &MethodResult::mean_ssim},
    {"mean_flip", &MethodResult::mean_flip},
    {"seen_psnr", &MethodResult::seen_psnr},
    {"unseen_psnr", &MethodResult::unseen_psnr},
    {"unseen_ssim", &MethodResult::unseen_ssim},
    {"unseen_flip", &MethodResult::unseen_flip},
    {"lpips", &MethodResult::lpips},
    {"fid", &MethodResult::fid},
    {"kid", &MethodResult::kid},
    {"depth_median_m", &MethodResult::depth_median_m},
    {"depth_rmse_m", &MethodResult::depth_rmse_m},
    {"depth_share", &MethodResult::depth_share},
    {"precision", &MethodResult::precision},
    {"recall", &MethodResult::recall},
    {"f1", &MethodResult::f1},
    {"iou", &MethodResult::iou},
    {"shell_recall", &MethodResult::shell_recall},
    {"furniture_recall", &MethodResult::furniture_recall},
    {"outside", &MethodResult::outside},
    {"ece", &MethodResult::ece},
    {"leak", &MethodResult::leak},
    {"confirmed", &MethodResult::confirmed},
    {"contradicted", &MethodResult::contradicted},
    {"undecided", &MethodResult::undecided},
    {"voxel_precision", &MethodResult::voxel_precision},
    {"voxel_recall", &MethodResult::voxel_recall},
    {"voxel_f1", &MethodResult::voxel_f1},
    {"near_precision", &MethodResult::near_precision},
    {"near_recall", &MethodResult::near_recall},
    {"near_f1", &MethodResult::near_f1},
    {"blocked", &MethodResult::blocked},
    {"right", &MethodResult::right},
    {"behind", &MethodResult::behind},
    {"open", &MethodResult::open},
    {"seconds", &MethodResult::seconds},
    {"peak_rss_mb", &MethodResult::peak_rss_mb}};
}  // namespace

std::string resultJson(const MethodResult& r) { return scoresJson(r, kMethodScores); }

std::string reliabilityJson(const MethodResult& r) {
  nlohmann::ordered_json bins = nlohmann::ordered_json::array();
  for (const ReliabilityBin& bin : *r.reliability)
    bins.push_back({bin.count, bin.sum_probability, bin.hits});
  return nlohmann::ordered_json{
      {"scene", r.scene}, {"views", r.views}, {"method", r.method}, {"reliability", bins}}
      .dump();
}

std::vector<MethodResult> evaluateScene(const EvaluationScene& scene, const Encoder& encoder,
                                        const Completer& completer, const SceneSettings& settings,
                                        const std::vector<double>& taus, const std::string& picture,
                                        Progress& progress, const UserNets& nets) {
  SceneSettings s = settings;
  s.observing.volume.up = scene.up;

  resetPeakMemory();
  auto start = std::chrono::steady_clock::now();
  const Place place = completeScene(scene.input, encoder, completer, s, progress);
  const auto look = [&](const Place& p) -> MethodOutput {
    Scene made = sceneOf(encoder.decode(p, s.child_threshold, progress), p);
    return {std::move(made.splats.gaussians), std::move(made.voxels.ijk)};
  };
  const MethodOutput completed = look(place);
  const double completed_seconds = secondsSince(start);
  const double completed_rss = peakMemoryMb();
  const VoxelFrame& frame = place.frame;
  const SeenSpace states = poolSeen(*place.seen, 1);
  const UnseenNodes unseen(scene, frame, states);
  const Truths truths(scene, frame, *place.seen, s.observing.carving, progress);

  std::vector<MethodResult> results;
  std::vector<std::vector<Image>> columns(1);
  for (size_t i = 0; i < std::min(kShownViews, scene.targets.size()); ++i)
    columns[0].push_back(scene.targets[i].colour);
  auto add = [&](const std::string& method, const MethodOutput& output, double seconds) {
    MethodResult r;
    r.scene = scene.name, r.method = method, r.views = int(scene.input.size());
    r.gaussians = output.gaussians.size();
    columns.emplace_back();
    measurePictures(scene, truths, output.gaussians, nets, &r, &columns.back());
    measureVoxels(truths, output.voxels, &r);
    measureNodes(scene, frame, unseen, output.voxels, &r);
    r.seconds = seconds, r.peak_rss_mb = peakMemoryMb();
    results.push_back(r);
    resetPeakMemory();
  };

  // Observed-only without the completion, on its own clock.
  resetPeakMemory();
  start = std::chrono::steady_clock::now();
  const Observation o = observe(scene.input, encoder.observing(s.observing), progress);
  const double observe_seconds = secondsSince(start);
  Place seen_place = encoder.encode(scene.input, o, progress);
  // The same detail of what was seen for all methods.
  seen_place.detail = place.detail, seen_place.cameras = place.cameras;
  const Scene observed_scene =
      sceneOf(encoder.decode(seen_place, s.child_threshold, progress), seen_place);
  const double observed_seconds = secondsSince(start) + (place.detail ? place.detail->seconds : 0);
  const SceneVoxels& seen = observed_scene.voxels;
  const MethodOutput observed{observed_scene.splats.gaussians, seen.ijk};
  add("observed", observed, observed_seconds);

  start = std::chrono::steady_clock::now();
  std::vector<std::vector<uint8_t>> pixels;
  for (const View& v : scene.input)
    pixels.push_back(observedPixels(v, o, place.level, s.observing.carving));
  const MethodOutput aligned{pixelAligned(scene.input, pixels), o.tokens.coords(0)};
  add("pixel-aligned", aligned, observe_seconds + secondsSince(start));
  columns.pop_back();

  start = std::chrono::steady_clock::now();
  const MethodOutput nearest = nearestFill(observed, seen, states);
  add("nearest", nearest, observed_seconds + secondsSince(start));
  start = std::chrono::steady_clock::now();
  const MethodOutput box = manhattanBox(observed, seen, states);
  add("box", box, observed_seconds + secondsSince(start));
  add("completed", completed, completed_seconds);
  results.back().peak_rss_mb = completed_rss;

  const SeenSpace all_nodes = poolSeen(truths.all, 1);
  const std::vector<Outcome> outcomes = outcomesOf(place, all_nodes);
  if (!outcomes.empty()) {
    results.back().reliability = reliabilityOf(outcomes);
    results.back().ece = calibrationError(*results.back().reliability);
  }
  start = std::chrono::steady_clock::now();
  const std::vector<Coord> occupied =
      scene.truth ? surfaceNodes(*scene.truth, frame, 1) : filledNodes(all_nodes);
  const Place oracle = completer.completeAt(seen_place, occupied, s.completion, progress);
  add("oracle-occupancy", look(oracle), observed_seconds + secondsSince(start));
  start = std::chrono::steady_clock::now();
  const Place told =
      withLatentsOf(oracle, densePlace(scene, encoder, s.observing, frame, progress));
  add("oracle-latents", look(told), observed_seconds + secondsSince(start));
  if (!picture.empty()) writeColumns(columns, picture);
  for (double tau : taus) {
    s.completion.tau = float(tau);
    start = std::chrono::steady_clock::now();
    const Place other = completer.complete(seen_place, s.completion, progress);
    add(joinText("completed-tau-", tau), look(other), observed_seconds + secondsSince(start));
  }
  return results;
}

std::vector<MethodResult> meanResults(const std::vector<MethodResult>& results) {
  std::vector<MethodResult> means = summaries(results, kMethodScores, "mean", meanOf);
  for (MethodResult& mean : means) {
    for (const MethodResult& r : results) {
      if (r.method != mean.method) continue;
      mean.features.insert(mean.features.end(), r.features.begin(), r.features.end());
      mean.true_features.insert(mean.true_features.end(), r.true_features.begin(),
                                r.true_features.end());
      if (!r.reliability) continue;
      if (!mean.reliability) mean.reliability.emplace();
      for (size_t i = 0; i < r.reliability->size(); ++i) {
        ReliabilityBin& sum = (*mean.reliability)[i];
        const ReliabilityBin& bin = (*r.reliability)[i];
        sum.count += bin.count, sum.hits += bin.hits, sum.sum_probability += bin.sum_probability;
      }
    }
    if (mean.features.size() < 2) continue;
    const Eigen::MatrixXd a = rowsOf(mean.true_features), b = rowsOf(mean.features);
    mean.fid = frechetDistance(a, b), mean.kid = kernelDistance(a, b);
    mean.features.clear(), mean.true_features.clear();
  }
  return means;
}

std::vector<MethodResult> deviationResults(const std::vector<MethodResult>& results) {
  return summaries(results, kMethodScores, "std", deviationOf);
}

}  // namespace vdbc
