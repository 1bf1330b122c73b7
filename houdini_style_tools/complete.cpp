#include "houdini_style_tools/complete.h"

#include <tbb/parallel_for.h>
#include <tbb/parallel_for_each.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <functional>

#include "splat/detail_grids.h"
#include "splat/image_files.h"
#include "splat/ply.h"
#include "splat/rasterize.h"
#include "vdb/fuse.h"
#include "vdb/latent_vdb.h"
#include "vdb/threads.h"

namespace vdbc {

namespace fs = std::filesystem;

namespace {

std::shared_ptr<const Detail> detailOf(const std::vector<View>& views, const Place& place,
                                       const SceneSettings& settings, Progress& progress) {
  const auto detail =
      std::make_shared<Detail>(seenDetail(views, settings.detail, settings.observing.carving,
                                          place.frame.world_from_grid.translation(), progress));
  std::vector<DepthView> depths;
  for (const View& view : views) depths.push_back(view.depthView());
  FuseSettings fusing;
  fusing.voxel_m = settings.detail.voxel_m, fusing.carving = settings.observing.carving;
  detail->distance = fuseDepth(place.frame, *place.seen, depths, fusing);
  return detail;
}

}  // namespace

Place encodeScene(const std::vector<View>& views, const Encoder& encoder,
                  const SceneSettings& settings, Progress& progress) {
  const ObserveSettings observing = encoder.observing(settings.observing);
  if (settings.detail.voxel_m > observing.volume.voxel_m)
    throw UsageError(joinText("detail: expected detail voxels of at most ",
                              observing.volume.voxel_m, " m, found ", settings.detail.voxel_m));
  return withThreads(settings.threads, [&] {
    progress.start("carve");
    const Observation observation = observe(views, observing, progress);
    progress.end();
    progress.start("encode");
    Place place = encoder.encode(views, observation, progress);
    progress.end();
    for (const View& view : views) place.cameras.push_back(view.camera);
    if (settings.detail.seconds > 0) {
      progress.start("detail");
      place.detail = detailOf(views, place, settings, progress);
      progress.end();
    }
    return place;
  });
}

Place completeScene(const std::vector<View>& views, const Encoder& encoder,
                    const Completer& completer, const SceneSettings& settings, Progress& progress) {
  return withThreads(settings.threads, [&] {
    return completer.complete(encodeScene(views, encoder, settings, progress), settings.completion,
                              progress);
  });
}

namespace {

SceneVoxels sceneVoxels(const DecodedGrid& d, const Place& place) {
  SceneVoxels v;
  v.frame = place.frame;
  v.ijk = d.voxels;
  v.empty.root() = place.seen->empty.root();
  const size_t n = d.voxels.size(), m = n ? size_t(d.gaussians.size()) / n : 0;
  openvdb::tree::ValueAccessor<const TokenMask> filled(place.seen->filled);
  for (size_t i = 0; i < n; ++i) {
    Eigen::Vector3f colour = Eigen::Vector3f::Zero();
    float weight = 0, clear = 1;
    for (size_t g = i * m; g < (i + 1) * m; ++g) {
      const float opacity = 1 / (1 + std::exp(-d.gaussians.opacity_logit[g]));
      for (int c = 0; c < 3; ++c)
        colour[c] += opacity * std::clamp(.5f + kSh0 * d.gaussians.sh[3 * g + size_t(c)], 0.f, 1.f);
      weight += opacity;
      clear *= 1 - opacity;
    }
    colour /= std::max(weight, 1e-6f);
    v.colour_linear.emplace_back(linearFromSrgb(colour[0]), linearFromSrgb(colour[1]),
                                 linearFromSrgb(colour[2]));
    v.density.push_back(1 - clear);
    const size_t node = size_t(d.node[i]);
    // A voxel was observed if a pixel's point lies in it; an observed token may gain unseen voxels.
    const bool observed = filled.isValueOn(d.voxels[i]);
    v.observed.push_back(observed);
    v.probability.push_back(place.probability[node]);
    v.bfs_level.push_back(observed ? 0 : std::max(1, place.bfs_level[node]));
  }
  return v;
}

// Of the decoded Gaussians.
Provenance provenanceOf(const SceneVoxels& voxels, int64_t per_voxel) {
  Provenance p;
  for (size_t i = 0; i < voxels.ijk.size(); ++i)
    for (int64_t g = 0; g < per_voxel; ++g) {
      p.generated.push_back(!voxels.observed[i]);
      p.probability.push_back(voxels.probability[i]);
    }
  return p;
}

}  // namespace

Scene sceneOf(const DecodedGrid& decoded, const Place& place) {
  Scene scene{sceneVoxels(decoded, place), {}};
  const int64_t voxels = scene.voxels.size();
  const int64_t per_voxel = voxels ? decoded.gaussians.size() / voxels : 0;
  const Provenance provenance = provenanceOf(scene.voxels, per_voxel);
  if (place.detail) scene.voxels.seen_distance = place.detail->distance;
  if (!place.detail || voxels == 0) {
    scene.splats = {decoded.gaussians, provenance};
    return scene;
  }
  JoinSettings joining;
  joining.voxel_m = place.frame.voxel_m;
  scene.splats = join(place.detail->discs, decoded.gaussians, provenance, int(per_voxel),
                      place.cameras, joining);
  return scene;
}

namespace {

constexpr int kTileWidth = 320;

// From the mean camera place, four level headings, the first as the first view looks.
std::vector<Camera> novelCameras(const std::vector<View>& views, const Eigen::Vector3d& up,
                                 int width, int height) {
  Eigen::Vector3d place = Eigen::Vector3d::Zero();
  for (const View& v : views)
    place += v.camera.world_from_camera.translation() / double(views.size());
  Eigen::Vector3d forward = views[0].camera.world_from_camera.linear().col(2);
  forward -= up * forward.dot(up);
  if (forward.norm() < 1e-3) forward = up.unitOrthogonal();
  forward.normalize();
  std::vector<Camera> cameras;
  for (int i = 0; i < 4; ++i) {
    Camera c;
    c.width = width, c.height = height;
    c.fx = c.fy = width / (2 * std::tan(.5 * 80 * M_PI / 180));  // 80 degrees across
    c.cx = width / 2., c.cy = height / 2.;
    c.world_from_camera.linear() = lookAlong(Eigen::AngleAxisd(i * M_PI / 2, up) * forward, up);
    c.world_from_camera.translation() = place;
    cameras.push_back(c);
  }
  return cameras;
}

}  // namespace

Image contactSheet(const std::vector<View>& views, const Gaussians& observed,
                   const Gaussians& completed, const Eigen::Vector3d& up) {
  const int columns = 4, shown = std::min(columns, int(views.size()));
  const int height =
      int(std::lround(double(kTileWidth) * views[0].camera.height / views[0].camera.width));
  std::vector<Image> tiles;
  for (int i = 0; i < shown; ++i) {
    const Camera& c = views[size_t(i)].camera;
    const double shrink = std::min(double(kTileWidth) / c.width, double(height) / c.height);
    tiles.push_back(resizeImage(views[size_t(i)].colour, std::max(1, int(c.width * shrink)),
                                std::max(1, int(c.height * shrink))));
  }
  tiles.resize(size_t(columns));
  const std::vector<Camera> cameras = novelCameras(views, up, kTileWidth, height);
  RasterSettings settings;
  settings.antialias = completed.antialias;
  for (const Gaussians* gaussians : {&observed, &completed})
    for (const Camera& camera : cameras)
      tiles.push_back(rasterize(*gaussians, camera, settings).colour);
  return tileImages(tiles, columns);
}

namespace {

// What writes one of a scene's files, by its ending.
using Writers = std::vector<std::pair<const char*, std::function<void(const std::string&)>>>;

// Everything under other names first: all files appear, or none.
void writeTogether(const Writers& writers, const std::string& stem, Progress& progress) {
  progress.start("write");
  const std::string draft = stem + ".draft";
  size_t placed = 0;
  try {
    std::atomic<size_t> written{0};
    tbb::parallel_for_each(writers, [&](const auto& writer) {
      // A writer that was interrupted must not cancel the loops within the others: they would go on
      // with half of their work.
      tbb::task_group_context alone(tbb::task_group_context::isolated);
      tbb::parallel_for(
          0, 1, [&](int) { writer.second(draft + writer.first); }, alone);
      report(progress, int(100 * ++written / writers.size()));
    });
    for (; placed < writers.size(); ++placed)
      fs::rename(draft + writers[placed].first, stem + writers[placed].first);
  } catch (...) {
    std::error_code ignored;
    for (const auto& writer : writers) fs::remove(draft + writer.first, ignored);
    for (size_t i = 0; i < placed; ++i) fs::remove(stem + writers[i].first, ignored);
    throw;
  }
  progress.end();
}

// The grids and Gaussians of a scene.
Writers sceneWriters(const Scene& scene, const Eigen::Vector3d& up) {
  const Gaussians& gaussians = scene.splats.gaussians;
  return {
      {kPointsEnding,
       [&](const std::string& path) { writePointsVdb(gaussians, scene.splats.provenance, path); }},
      {".ply",
       [&gaussians, up](const std::string& path) { writePly(gaussians, path, up.cast<float>()); }},
      {".vdb", [&](const std::string& path) {
         writeSceneVdb(scene.voxels, path, detailGrids(scene.voxels, gaussians));
       }}};
}

Eigen::Vector3d upOf(const VoxelFrame& frame) { return frame.world_from_grid.linear().col(2); }

}  // namespace

void requireCreatable(const std::string& path) {
  const fs::path folder =
      fs::path(path).has_parent_path() ? fs::path(path).parent_path() : fs::path(".");
  if (!fs::exists(folder)) {
    std::error_code error;
    fs::create_directories(folder, error);
    require(!error, folder.string(), ": cannot create the folder: ", error.message());
  }
  require(fs::is_directory(folder), folder.string(), ": expected a folder");
  require(!fs::is_directory(path), path, ": is a folder (expected a file, or nothing)");
  // Asking the file system beats access(): root may pass access() on a read-only mount.
  const std::string probe = path + ".probe.tmp";
  std::FILE* f = std::fopen(probe.c_str(), "wb");
  require(f != nullptr, folder.string(), ": the folder is not writable");
  std::fclose(f);
  std::remove(probe.c_str());
}

std::string outputStem(const std::string& path, const std::vector<std::string>& more) {
  const fs::path p(path);
  if (p.extension() != ".vdb" || p.stem().empty() || p.stem().extension() == ".latent")
    throw UsageError(joinText("output: ", path, ": expected a name that ends in .vdb"));
  const std::string stem = (p.has_parent_path() ? p.parent_path() / p.stem() : p.stem()).string();
  for (const char* ending : kSceneEndings) requireCreatable(stem + ending);
  for (const std::string& ending : more) requireCreatable(stem + ending);
  return stem;
}

Scene writePlace(const Place& place, const std::vector<View>& views, const Encoder& encoder,
                 const SceneSettings& settings, const std::string& stem, Progress& progress) {
  const auto decode = [&](const Place& part) {
    DecodedGrid decoded = encoder.decode(part, settings.child_threshold, progress);
    decoded.gaussians.antialias = settings.antialias;
    return decoded;
  };
  return withThreads(settings.threads, [&] {
    progress.start("decode");
    Scene scene = sceneOf(decode(place), place);
    progress.end();
    const Eigen::Vector3d up = views.empty() ? upOf(place.frame) : settings.observing.volume.up;
    Writers writers = sceneWriters(scene, up);
    writers.push_back(
        {kLatentEnding, [&](const std::string& path) { writeLatentVdb(place, path); }});
    if (!views.empty())
      writers.push_back(
          {kPictureEnding, [&](const std::string& path) {
             const Gaussians observed =
                 place.detail ? place.detail->discs : decode(observedPart(place)).gaussians;
             writePng(contactSheet(views, observed, scene.splats.gaussians, up), path);
           }});
    writeTogether(writers, stem, progress);
    return scene;
  });
}

void writeScene(const Scene& scene, const std::string& stem, Progress& progress) {
  writeTogether(sceneWriters(scene, upOf(scene.voxels.frame)), stem, progress);
}

Rethresholded rethreshold(const std::string& from, float tau, const std::string& to,
                          Progress& progress) {
  progress.start("read");
  const std::string grids = from + ".vdb", points = from + kPointsEnding;
  const SceneVoxels all = readSceneVdb(grids);
  SplatScene splats;
  splats.gaussians = readPointsVdb(points, &splats.provenance);
  const Provenance& origin = splats.provenance;
  require(origin.recorded, "rethreshold: ", points,
          ": expected Gaussians with `probability` and `completed`, found neither");
  progress.end();
  Scene kept{keepRows(all, [&](size_t i) { return all.observed[i] || all.probability[i] > tau; }),
             {}};
  require(kept.voxels.size() < all.size(), "rethreshold: ", grids,
          ": every generated voxel exceeds ", tau, " already (expected a tau that is larger)");
  std::vector<int64_t> rows;
  for (int64_t i = 0; i < origin.size(); ++i)
    if (!origin.generated[size_t(i)] || origin.probability[size_t(i)] > tau) rows.push_back(i);
  kept.splats.provenance = selectRows(origin, rows);
  kept.splats.gaussians = selectRows(std::move(splats.gaussians), rows);
  writeScene(kept, to, progress);
  return {kept.voxels.size(), kept.splats.gaussians.size(), all.size() - kept.voxels.size()};
}

std::shared_ptr<const Detail> readDetail(const std::string& stem, const VoxelFrame& frame) {
  const std::string path = stem + kPointsEnding;
  Provenance provenance;
  Gaussians all = readPointsVdb(path, &provenance);
  auto detail = std::make_shared<Detail>();
  detail->discs = keepRows(std::move(all), [&](size_t i) { return !provenance.generated[i]; });
  require(detail->discs.sh_degree == 0 && detail->discs.size() > 0, "readDetail: ", path,
          ": expected observed Gaussians of SH degree 0");
  moveOrigin(frame.world_from_grid.translation(), &detail->discs);
  detail->distance = readSceneVdb(stem + ".vdb").seen_distance;
  return detail;
}

}  // namespace vdbc
