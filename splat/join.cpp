#include "splat/join.h"

#include <tbb/parallel_for.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>
#include <unordered_set>

#include "splat/cells.h"
#include "splat/merge.h"
#include "splat/rasterize.h"
#include "vdb/error.h"
#include "vdb/uniform.h"

namespace vdbc {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector3d;
using Eigen::Vector3f;

constexpr int kMostPlanes = 16, kPlaneDraws = 48, kPlaneRounds = 3;
constexpr float kPlaneSlack = .03f;       // metres; discs within are of a plane
constexpr float kPlaneCosine = .9f;       // of their normals
constexpr float kPlaceCell = .5f;         // metres
constexpr float kLeastPlane = .1f;        // m^2 of discs
constexpr float kPlaneSigma = .9f;        // of a disc that continues a plane, voxels
constexpr float kPlaneThickness = .003f;  // metres
constexpr float kBehind = .03f;  // metres; what continues a plane lies behind what was seen of it

constexpr int kSideDirections = 8;  // to both sides each, in which a Gaussian is looked at
constexpr float kInner = 1.3f, kOuter = 3.3f;  // sigmas; beyond nothing is drawn
constexpr int kMostCuts = 14, kMostPushes = 2;
constexpr float kCut = .85f;             // what a cut leaves of a Gaussian's width
constexpr float kFarSide = 3;            // sigmas to the other side, which stays where it is
constexpr float kPush = .03f;            // metres
constexpr float kLeastVariance = 1e-8f;  // m^2

constexpr float kMostAcross = .5f;  // of the variance within a sheet, that across it

constexpr float kTouching = 1.8f;   // voxels between centres of neighbours: also across corners
constexpr float kRim = 3;           // voxels; discs within meet what was generated
constexpr float kRimSigma = 1;      // voxels; nearer ones count more
constexpr float kRimPull = 10;      // of a colour where both meet, against that of a neighbour
constexpr float kCovered = .3f;     // of a voxel's face by discs: where the pull is whole
constexpr float kOtherThing = .3f;  // display sRGB
constexpr float kLeak = .05f;  // of a difference in colour on its way from voxel to voxel: a metre
constexpr int kRounds = 60;

constexpr int kRimParts = 2;           // along both sides of a flat disc that meets what was seen
constexpr float kRimOverlap = 1.25f;   // of these
constexpr float kSpreadShare = .6f;    // of how neighbours lie, added to a voxel's Gaussian
constexpr float kLeastOpacity = .95f;  // of it
constexpr float kTileSigmas = 2.6f;    // by which tiles are widened to close up

Matrix3f axesOf(const Eigen::Vector4f& q) {
  return Eigen::Quaternionf(q[0], q[1], q[2], q[3]).normalized().toRotationMatrix();
}

Blob scaled(Blob b, float by) {
  b.covariance *= by * by;
  return b;
}

// --- what the views saw -----------------------------------------------------------------------

// Where the discs stand in the views: nothing that is made up may stand before them there. Found by
// looking at the discs, so that a finished place is bounded without its photos too.
class Bounds {
 public:
  Bounds(const Gaussians& discs, const std::vector<Camera>& cameras, float slack)
      : cameras_(cameras), slack_(slack) {
    RasterSettings raster;
    raster.antialias = discs.antialias, raster.median_depth = true;
    for (const Camera& c : cameras_) {
      depths_.push_back(rasterize(discs, c, raster).median_depth.data);
      eye_ += c.world_from_camera.translation().cast<float>() / float(cameras_.size());
    }
  }

  // The mean camera, from the origin.
  const Vector3f& eye() const { return eye_; }

  // Whether a view saw the surface at a point: its depth there is within `reach`.
  bool sees(const Vector3f& p, float reach) const {
    for (size_t v = 0; v < cameras_.size(); ++v) {
      const Vector3d uvz = project(v, p);
      const float depth = depthAt(v, uvz);
      if (depth > 0 && std::abs(depth - float(uvz.z())) < reach) return true;
    }
    return false;
  }

  bool standsBefore(const Blob& b) const { return offenceOf(b).found; }

  // Cuts off what reaches before the discs, one side after the other, and moves away from the
  // cameras what does so with its centre; false where neither helps. Shrinking or dropping instead
  // leaves a black seam along the rim of what was seen.
  bool clip(Blob* b) const {
    const Vector3f away = (b->mean - eye_).normalized();
    int pushes = 0;
    for (int cuts = 0; cuts < kMostCuts;) {
      const Offence offence = offenceOf(*b);
      if (!offence.found) return true;
      if (offence.side.isZero()) {
        if (++pushes > kMostPushes) return false;
        b->mean += kPush * away;
      } else {
        ++cuts;
        b->mean -= (1 - kCut) * kFarSide * offence.side;
        b->covariance -= (1 - kCut * kCut) * offence.side * offence.side.transpose();
      }
    }
    return !offenceOf(*b).found;
  }

 private:
  // Where a view would see a Gaussian before the discs: at its centre, or to a side (that of one
  // sigma, from the centre).
  struct Offence {
    bool found = false;
    Vector3f side = Vector3f::Zero();
  };
  Offence offenceOf(const Blob& b) const {
    const Matrix3f inverse = (b.covariance + kLeastVariance * Matrix3f::Identity()).inverse();
    for (size_t v = 0; v < cameras_.size(); ++v) {
      const Matrix3f camera = cameras_[v].world_from_camera.linear().cast<float>();
      // Of one sigma along the view; less of it towards the sides.
      const float deep = 1 / std::sqrt(camera.col(2).dot(inverse * camera.col(2)));
      const Vector3d centre = project(v, b.mean);
      const auto before = [&](const Vector3d& uvz, float z) {
        const float depth = depthAt(v, uvz);
        return depth > 0 && z < depth - slack_;
      };
      if (before(centre, float(centre.z()) - deep)) return {true, Vector3f::Zero()};
      for (int k = 0; k < 2 * kSideDirections; ++k) {
        const float angle = float(M_PI) * float(k) / float(kSideDirections);
        const Vector3f to_side = std::cos(angle) * camera.col(0) + std::sin(angle) * camera.col(1);
        // To the ellipsoid's outermost point there.
        const Vector3f along = b.covariance * to_side;
        const Vector3f side = along / std::sqrt(to_side.dot(along) + kLeastVariance);
        const Vector3d inner = project(v, b.mean + kInner * side),
                       outer = project(v, b.mean + kOuter * side);
        // Gaussians are drawn in the order of their centres.
        const auto drawn_at = [&](const Vector3d& uvz, double depth) {
          return float(std::min(centre.z(), uvz.z() - depth * double(deep)));
        };
        if (before(inner, drawn_at(inner, .75)) || before(outer, drawn_at(outer, .5)))
          return {true, side};
      }
    }
    return {};
  }

  Vector3d project(size_t view, const Vector3f& p) const {
    return cameras_[view].project(p.cast<double>());
  }
  float depthAt(size_t view, const Vector3d& uvz) const {
    const int64_t pixel = cameras_[view].pixelAt(uvz);
    return pixel < 0 ? 0 : depths_[view][size_t(pixel)];
  }

  const std::vector<Camera>& cameras_;
  float slack_;
  Vector3f eye_ = Vector3f::Zero();
  std::vector<std::vector<float>> depths_;  // [H * W] each; 0 where nothing was seen
};

// --- planes -----------------------------------------------------------------------------------

// Discs of one plane and where on it they are.
struct SeenPlane {
  Vector3f point = Vector3f::Zero(), normal = Vector3f::Zero();
  Matrix3f axes = Matrix3f::Identity();  // columns: two in the plane, then the normal
  std::vector<size_t> discs;             // rows
  std::vector<Vector3f> places;          // of them, one in each cell of kPlaceCell

  float distance(const Vector3f& p) const { return normal.dot(p - point); }
};

struct DiscShape {
  Vector3f normal;
  float area;
};

bool liesOn(const SeenPlane& plane, const Vector3f& mean, const DiscShape& shape) {
  return std::abs(plane.distance(mean)) < kPlaneSlack &&
         std::abs(plane.normal.dot(shape.normal)) > kPlaneCosine;
}

std::vector<DiscShape> shapesOf(const Gaussians& discs) {
  std::vector<DiscShape> shapes;
  for (size_t i = 0; i < discs.mean.size(); ++i) {
    // The thinnest axis, which fitting may have made another one.
    Eigen::Index thin = 0;
    discs.log_scale[i].minCoeff(&thin);
    const Vector3f sigma = discs.log_scale[i].array().exp();
    shapes.push_back({axesOf(discs.rotation[i]).col(thin), 4 * sigma.prod() / sigma[thin]});
  }
  return shapes;
}

// The discs of `left` that lie on a plane, and the plane through them, towards the cameras.
void refit(const Gaussians& discs, const std::vector<DiscShape>& shapes,
           const std::vector<size_t>& left, const Vector3f& eye, SeenPlane* plane) {
  Vector3d mean = Vector3d::Zero();
  double mass = 0;
  plane->discs.clear();
  for (size_t i : left)
    if (liesOn(*plane, discs.mean[i], shapes[i])) {
      plane->discs.push_back(i);
      mean += double(shapes[i].area) * discs.mean[i].cast<double>();
      mass += double(shapes[i].area);
    }
  mean /= mass;
  Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
  for (size_t i : plane->discs) {
    const Vector3d d = discs.mean[i].cast<double>() - mean;
    spread += double(shapes[i].area) * d * d.transpose();
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(spread);
  plane->point = mean.cast<float>();
  plane->normal = solver.eigenvectors().col(0).cast<float>();
  if (plane->normal.dot(eye - plane->point) < 0) plane->normal *= -1;
  plane->axes << solver.eigenvectors().col(2).cast<float>(),
      solver.eigenvectors().col(1).cast<float>(), plane->normal;
}

// Of planes through some discs, drawn by their areas, the one with the largest area of discs on it.
SeenPlane consensus(const Gaussians& discs, const std::vector<DiscShape>& shapes,
                    const std::vector<size_t>& left, std::mt19937_64* random, float* area) {
  std::vector<double> sums;
  double sum = 0;
  for (size_t i : left) sums.push_back(sum += double(shapes[i].area));
  std::vector<SeenPlane> drawn(kPlaneDraws);
  for (SeenPlane& plane : drawn) {
    const double at = sum * uniform(*random);
    const size_t k = size_t(std::upper_bound(sums.begin(), sums.end(), at) - sums.begin());
    const size_t i = left[std::min(k, left.size() - 1)];
    plane.point = discs.mean[i], plane.normal = shapes[i].normal;
  }
  std::vector<float> areas(drawn.size(), 0.f);
  tbb::parallel_for(size_t(0), drawn.size(), [&](size_t k) {
    for (size_t i : left)
      if (liesOn(drawn[k], discs.mean[i], shapes[i])) areas[k] += shapes[i].area;
  });
  const auto best = std::max_element(areas.begin(), areas.end());
  *area = *best;
  return drawn[size_t(best - areas.begin())];
}

// Up to kMostPlanes, the largest first.
std::vector<SeenPlane> seenPlanes(const Gaussians& discs, const Vector3f& eye, uint64_t seed) {
  const std::vector<DiscShape> shapes = shapesOf(discs);
  std::vector<size_t> left(shapes.size());
  std::iota(left.begin(), left.end(), size_t(0));
  std::mt19937_64 random(seed);
  std::vector<SeenPlane> planes;
  while (planes.size() < kMostPlanes && !left.empty()) {
    float area = 0;
    SeenPlane plane = consensus(discs, shapes, left, &random, &area);
    if (area < kLeastPlane) break;
    for (int round = 0; round < kPlaneRounds; ++round) refit(discs, shapes, left, eye, &plane);
    if (plane.discs.empty()) break;
    std::vector<size_t> rest;
    std::set_difference(left.begin(), left.end(), plane.discs.begin(), plane.discs.end(),
                        std::back_inserter(rest));
    left = std::move(rest);
    std::unordered_set<uint64_t> taken;
    for (size_t i : plane.discs)
      if (taken.insert(cellOf(discs.mean[i], kPlaceCell)).second)
        plane.places.push_back(discs.mean[i]);
    planes.push_back(std::move(plane));
  }
  return planes;
}

// --- voxels -----------------------------------------------------------------------------------

// One Gaussian for what a voxel has.
struct Voxel {
  Blob blob;
  const SeenPlane* plane = nullptr;        // that it continues
  std::vector<size_t> neighbours;          // rows
  Vector3f difference = Vector3f::Zero();  // of the discs around it, in colour
  float pull = 0;                          // of that difference; 0 where no disc is near
  Matrix3f spread = Matrix3f::Zero();      // of its neighbours' means around it
};

// Of the decoded voxels what no view saw.
std::vector<Voxel> unseenVoxels(const Gaussians& decoded, const Provenance& provenance,
                                int per_voxel, const Bounds& bounds, const JoinSettings& s) {
  std::vector<Voxel> all(size_t(decoded.size() / per_voxel));
  std::vector<uint8_t> is_left(all.size());
  tbb::parallel_for(size_t(0), all.size(), [&](size_t v) {
    const size_t begin = v * size_t(per_voxel);
    std::vector<Blob> parts;
    for (size_t i = begin; i < begin + size_t(per_voxel); ++i) {
      if (!provenance.generated[i] && bounds.sees(decoded.mean[i], s.voxel_m)) continue;
      parts.push_back(blobOf(decoded, i));
      parts.back().probability = provenance.probability[i];
    }
    if (parts.empty()) return;
    all[v].blob = merged(parts);
    is_left[v] = 1;
  });
  std::vector<Voxel> left;
  for (size_t v = 0; v < all.size(); ++v)
    if (is_left[v]) left.push_back(std::move(all[v]));
  return left;
}

void linkNeighbours(float voxel_m, std::vector<Voxel>* voxels) {
  std::vector<Vector3f> means;
  for (const Voxel& v : *voxels) means.push_back(v.blob.mean);
  const PointCells cells(means, kTouching * voxel_m);
  tbb::parallel_for(size_t(0), voxels->size(), [&](size_t i) {
    cells.near(means[i], [&](size_t k, float) {
      if (k != i) (*voxels)[i].neighbours.push_back(k);
    });
  });
}

// How a voxel and its neighbours lie: the covariance of their means.
Matrix3f spreadAround(const Voxel& v, const std::vector<Voxel>& voxels) {
  const float n = float(v.neighbours.size() + 1);
  Vector3f mean = v.blob.mean / n;
  for (size_t k : v.neighbours) mean += voxels[k].blob.mean / n;
  const auto square = [&](const Vector3f& p) -> Matrix3f {
    return (p - mean) * (p - mean).transpose() / n;
  };
  Matrix3f spread = square(v.blob.mean);
  for (size_t k : v.neighbours) spread += square(voxels[k].blob.mean);
  return spread;
}

// Whether they lie in one sheet across a normal: a wall at the height of a table is no part of the
// table's plane.
bool liesAcross(const Vector3f& normal, const Matrix3f& spread) {
  const float along = normal.dot(spread * normal);
  return along <= kMostAcross * (spread.trace() - along) / 2;
}

// The nearest plane that goes on to a voxel; null where none does.
const SeenPlane* planeAt(const Voxel& v, const std::vector<SeenPlane>& planes,
                         const JoinSettings& s) {
  const SeenPlane* nearest = nullptr;
  float least = s.off_plane_m;
  for (const SeenPlane& plane : planes) {
    const float off = std::abs(plane.distance(v.blob.mean));
    const auto reaches = [&](const Vector3f& q) {
      return (q - v.blob.mean).squaredNorm() < s.reach_m * s.reach_m;
    };
    if (off < least && std::any_of(plane.places.begin(), plane.places.end(), reaches) &&
        liesAcross(plane.normal, v.spread))
      least = off, nearest = &plane;
  }
  return nearest;
}

// How the discs around a voxel differ from it in colour (those of its plane, where it continues
// one), and how much that tells of its own. A large difference is that of another thing.
void lookAtRim(const Gaussians& discs, const PointCells& disc_cells, float voxel_m, Voxel* v) {
  const float sigma = kRimSigma * voxel_m;
  Vector3f sum = Vector3f::Zero();
  float covered = 0;  // m^2
  disc_cells.near(v->blob.mean, [&](size_t d, float squared) {
    if (v->plane && std::abs(v->plane->distance(discs.mean[d])) > kPlaneSlack) return;
    const Vector3f sigmas = discs.log_scale[d].array().exp();
    const float area = sigmas.prod() / sigmas.minCoeff();
    const float w = area * std::exp(-squared / (2 * sigma * sigma));
    covered += w, sum += w * (Eigen::Map<const Vector3f>(&discs.sh[3 * d]) - v->blob.colour);
  });
  if (covered <= 0) return;
  v->difference = sum / covered;
  const float other = kSh0 * v->difference.norm() / kOtherThing;
  v->pull = kRimPull * std::min(1.f, covered / (kCovered * voxel_m * voxel_m)) *
            std::exp(-other * other / 2);
}

// Fits the colours of what was generated to those of the discs where both meet, and carries the
// difference on, fading: a screened Poisson equation over the voxels, by relaxation.
void fitColours(const Gaussians& discs, const PointCells& disc_cells, float voxel_m,
                std::vector<Voxel>* voxels) {
  const size_t n = voxels->size();
  std::vector<Vector3f> offset(n, Vector3f::Zero()), next(n);
  tbb::parallel_for(size_t(0), n,
                    [&](size_t i) { lookAtRim(discs, disc_cells, voxel_m, &(*voxels)[i]); });
  for (int round = 0; round < kRounds; ++round) {
    tbb::parallel_for(size_t(0), n, [&](size_t i) {
      const Voxel& v = (*voxels)[i];
      Vector3f sum = v.pull * v.difference;
      for (size_t k : v.neighbours) sum += offset[k];
      next[i] = sum / (v.pull + kLeak + float(v.neighbours.size()));
    });
    std::swap(offset, next);
  }
  for (size_t i = 0; i < n; ++i) (*voxels)[i].blob.colour += offset[i];
}

// As it is drawn: a flat disc a little behind what was seen of the plane that it continues, or else
// wider towards its neighbours: the decoder's Gaussians leave gaps between voxels.
Blob drawn(const Voxel& v, float voxel_m) {
  if (!v.plane) {
    Blob b = v.blob;
    b.covariance += kSpreadShare * v.spread;
    b.opacity = std::max(b.opacity, kLeastOpacity);
    return b;
  }
  Blob b = v.blob;
  b.mean -= (v.plane->distance(b.mean) + kBehind) * v.plane->normal;
  const float sigma = kPlaneSigma * voxel_m;
  const Vector3f sigmas(sigma, sigma, kPlaneThickness);
  const Matrix3f axes = v.plane->axes * sigmas.asDiagonal();
  b.covariance = axes * axes.transpose();
  b.opacity = kMostOpacity;
  return b;
}

// A flat disc that meets what was seen as smaller ones, which reach less far into it.
std::vector<Blob> rimParts(const Blob& disc, const Matrix3f& axes, float voxel_m) {
  std::vector<Blob> parts;
  const auto offset = [&](int i) { return (float(i) + .5f) / kRimParts - .5f; };
  for (int i = 0; i < kRimParts; ++i)
    for (int j = 0; j < kRimParts; ++j) {
      parts.push_back(scaled(disc, kRimOverlap / kRimParts));
      parts.back().mean += voxel_m * (offset(i) * axes.col(0) + offset(j) * axes.col(1));
    }
  return parts;
}

// What may be seen of a voxel.
struct Visible {
  std::vector<Blob> blobs;
  bool may_merge = false;  // it is whole and no disc is near
};
Visible visibleOf(const Voxel& voxel, const Bounds& bounds, float voxel_m) {
  const Blob whole = drawn(voxel, voxel_m);
  const bool at_rim = voxel.pull > 0;
  Visible v;
  for (Blob b : at_rim&& voxel.plane ? rimParts(whole, voxel.plane->axes, voxel_m)
                                     : std::vector<Blob>{whole}) {
    // What a view saw there is a disc already.
    if (bounds.sees(b.mean, voxel_m)) continue;
    const bool is_whole = !bounds.standsBefore(b);
    if (!is_whole && !bounds.clip(&b)) continue;
    v.blobs.push_back(b);
    v.may_merge = is_whole && !at_rim;
  }
  return v;
}

// What may be seen of all voxels, merged where neighbours agree.
std::vector<Blob> visibleBlobs(const std::vector<Voxel>& voxels, const Bounds& bounds,
                               float voxel_m) {
  std::vector<Visible> all(voxels.size());
  tbb::parallel_for(size_t(0), voxels.size(),
                    [&](size_t i) { all[i] = visibleOf(voxels[i], bounds, voxel_m); });
  // Gaussians that overlap have to be tiles before their moments add up to those of a larger tile.
  std::vector<Blob> tiles, visible;
  for (const Visible& v : all)
    for (const Blob& b : v.blobs)
      if (v.may_merge)
        tiles.push_back(scaled(b, 1 / kTileSigmas));
      else
        visible.push_back(b);
  MergeSettings merging;
  merging.cell_m = 2 * voxel_m;
  tiles = mergeAlike(tiles, merging, [&](const Blob& tile) {
    return !bounds.standsBefore(scaled(tile, kTileSigmas));
  });
  for (const Blob& tile : tiles) visible.push_back(scaled(tile, kTileSigmas));
  return visible;
}

}  // namespace

SplatScene join(const Gaussians& world_discs, const Gaussians& decoded,
                const Provenance& provenance, int per_voxel,
                const std::vector<Camera>& world_cameras, const JoinSettings& s) {
  // All from one origin, which is then that of the world.
  Gaussians discs = world_discs;
  std::vector<Camera> cameras;
  for (const Camera& c : world_cameras) cameras.push_back(cameraFrom(discs.origin, c));
  require(discs.sh_degree == 0 && decoded.sh_degree == 0 && discs.origin == decoded.origin &&
              provenance.size() == decoded.size() && per_voxel > 0 &&
              decoded.size() % per_voxel == 0,
          "join: expected Gaussians of SH degree 0 from one origin, whole voxels and their "
          "provenance");
  discs.origin.setZero();
  const Bounds bounds(discs, cameras, s.slack_m);
  const std::vector<SeenPlane> planes = seenPlanes(discs, bounds.eye(), s.seed);
  const PointCells disc_cells(discs.mean, kRim * s.voxel_m);
  std::vector<Voxel> voxels = unseenVoxels(decoded, provenance, per_voxel, bounds, s);
  linkNeighbours(s.voxel_m, &voxels);
  tbb::parallel_for(size_t(0), voxels.size(), [&](size_t i) {
    voxels[i].spread = spreadAround(voxels[i], voxels);
    voxels[i].plane = planeAt(voxels[i], planes, s);
  });
  fitColours(discs, disc_cells, s.voxel_m, &voxels);
  const std::vector<Blob> generated = visibleBlobs(voxels, bounds, s.voxel_m);
  SplatScene scene;
  scene.gaussians = std::move(discs);
  scene.gaussians.origin = decoded.origin;
  scene.provenance.generated.assign(scene.gaussians.mean.size(), 0);
  scene.provenance.probability.assign(scene.gaussians.mean.size(), 1.f);
  for (const Blob& b : generated) {
    appendBlob(b, &scene.gaussians);
    scene.provenance.generated.push_back(1);
    scene.provenance.probability.push_back(b.probability);
  }
  return scene;
}

}  // namespace vdbc
