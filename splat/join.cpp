#include "splat/join.h"

#include <tbb/parallel_for.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <numeric>
#include <random>

#include "splat/rasterize.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector3d;
using Eigen::Vector3f;

constexpr int kMostPlanes = 16, kPlaneDraws = 48;
constexpr float kPlaneSlack = .03f;       // metres; discs within are of a plane
constexpr float kPlaneCosine = .9f;       // of their normals
constexpr float kLeastPlane = .1f;        // m^2 of discs
constexpr float kPlaneSigma = .75f;       // of a disc that continues a plane, voxels
constexpr float kPlaneThickness = .003f;  // metres
constexpr float kBehind = .03f;   // metres; what continues a plane lies behind what was seen of it
constexpr float kSideSigmas = 3;  // how far to the sides a Gaussian is looked at
constexpr float kLeastShrink = .3f;  // smaller ones are dropped
constexpr float kMostOpacity = .99f;
constexpr float kWiden = 1.4f, kLeastOpacity = .9f;  // of a voxel's Gaussian
constexpr int kNearDiscs = 8;

float opacityOf(float logit) { return 1 / (1 + std::exp(-logit)); }
float logitOf(float opacity) {
  const float o = std::clamp(opacity, 1e-4f, kMostOpacity);
  return std::log(o / (1 - o));
}

Matrix3f axesOf(const Eigen::Vector4f& q) {
  return Eigen::Quaternionf(q[0], q[1], q[2], q[3]).normalized().toRotationMatrix();
}
Matrix3f covarianceOf(const Gaussians& g, size_t i) {
  const Matrix3f axes = axesOf(g.rotation[i]) * g.log_scale[i].array().exp().matrix().asDiagonal();
  return axes * axes.transpose();
}

// A Gaussian in the terms that merging takes.
struct Blob {
  Vector3f mean = Vector3f::Zero(), colour = Vector3f::Zero();  // colour: SH of degree 0
  Matrix3f covariance = Matrix3f::Zero();
  float opacity = 0, probability = 1;
  bool generated = true;
};

void appendBlob(const Blob& b, SplatScene* to) {
  const Eigen::SelfAdjointEigenSolver<Matrix3f> solver(b.covariance);
  Matrix3f axes = solver.eigenvectors().rowwise().reverse();  // the largest first
  if (axes.determinant() < 0) axes.col(2) *= -1;
  const Eigen::Quaternionf q(axes);
  Gaussians& g = to->gaussians;
  g.mean.push_back(b.mean);
  g.log_scale.push_back(solver.eigenvalues().reverse().cwiseMax(1e-8f).array().log().matrix() / 2);
  g.rotation.emplace_back(q.w(), q.x(), q.y(), q.z());
  g.opacity_logit.push_back(logitOf(b.opacity));
  g.sh.insert(g.sh.end(), b.colour.data(), b.colour.data() + 3);
  to->provenance.generated.push_back(b.generated);
  to->provenance.probability.push_back(b.probability);
}

// What light a Gaussian takes on average over directions.
float areaOf(const Matrix3f& covariance) {
  const Vector3f v = Eigen::SelfAdjointEigenSolver<Matrix3f>(covariance, Eigen::EigenvaluesOnly)
                         .eigenvalues()
                         .cwiseMax(0.f)
                         .cwiseSqrt();
  return v[0] * v[1] + v[1] * v[2] + v[0] * v[2];
}

// One Gaussian with the moments of several and the light that they take together.
Blob merged(const std::vector<Blob>& parts) {
  Blob b;
  float mass = 0;
  std::vector<float> weights;
  b.probability = parts[0].probability, b.generated = parts[0].generated;
  for (const Blob& p : parts) {
    const float w = p.opacity * areaOf(p.covariance) + 1e-12f;
    weights.push_back(w);
    mass += w, b.mean += w * p.mean, b.colour += w * p.colour;
    b.probability = std::min(b.probability, p.probability);
  }
  b.mean /= mass, b.colour /= mass;
  for (size_t i = 0; i < parts.size(); ++i) {
    const Vector3f d = parts[i].mean - b.mean;
    b.covariance += weights[i] / mass * (parts[i].covariance + d * d.transpose());
  }
  b.opacity = std::min(kMostOpacity, mass / areaOf(b.covariance));
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
    for (const Camera& c : cameras_)
      depths_.push_back(rasterize(discs, c, raster).median_depth.data);
  }

  // Whether a view saw the surface at a point: its depth there is within `reach`.
  bool sees(const Vector3f& p, float reach) const {
    for (size_t v = 0; v < cameras_.size(); ++v) {
      const Vector3d uvz = project(v, p);
      const float depth = depthAt(v, uvz);
      if (depth > 0 && std::abs(depth - float(uvz.z())) < reach) return true;
    }
    return false;
  }

  // Shrinks what reaches before a measured depth; false where its centre does.
  bool clip(Blob* b) const {
    const Matrix3f whole = b->covariance;
    for (float shrink = 1; shrink >= kLeastShrink; shrink *= .7f) {
      b->covariance = shrink * shrink * whole;
      if (!standsBefore(*b)) return true;
    }
    return false;
  }

  // The mean camera, from the origin.
  Vector3f meanEye() const {
    Vector3d sum = Vector3d::Zero();
    for (const Camera& c : cameras_) sum += c.world_from_camera.translation();
    return (sum / double(std::max(size_t(1), cameras_.size()))).cast<float>();
  }

 private:
  Vector3d project(size_t view, const Vector3f& p) const {
    return cameras_[view].project(p.cast<double>());
  }
  float depthAt(size_t view, const Vector3d& uvz) const {
    const Camera& c = cameras_[view];
    if (!(uvz.z() > 0) || !(uvz.x() >= 0) || !(uvz.y() >= 0) || !(uvz.x() < c.width) ||
        !(uvz.y() < c.height))
      return 0;
    return depths_[view][size_t(uvz.y()) * size_t(c.width) + size_t(uvz.x())];
  }

  bool standsBefore(const Blob& b) const {
    for (size_t v = 0; v < cameras_.size(); ++v) {
      const Matrix3f camera = cameras_[v].world_from_camera.linear().cast<float>();
      const float deep = std::sqrt(camera.col(2).dot(b.covariance * camera.col(2)));
      const auto before = [&](const Vector3f& p, float towards) {
        const Vector3d uvz = project(v, p);
        const float depth = depthAt(v, uvz);
        return depth > 0 && float(uvz.z()) - towards < depth - slack_;
      };
      if (before(b.mean, deep)) return true;
      for (int axis = 0; axis < 2; ++axis) {
        // The ellipsoid's outermost point to that side.
        const Vector3f along = b.covariance * camera.col(axis);
        const Vector3f side = kSideSigmas / std::sqrt(camera.col(axis).dot(along) + 1e-12f) * along;
        // Only half as deep there.
        const float rest = .5f * std::min(deep, .05f);
        if (before(b.mean + side, rest) || before(b.mean - side, rest)) return true;
      }
    }
    return false;
  }

  const std::vector<Camera>& cameras_;
  float slack_;
  std::vector<std::vector<float>> depths_;  // [H * W] each; 0 where nothing was seen
};

// --- planes -----------------------------------------------------------------------------------

// Discs of one plane and where on it they are.
struct SeenPlane {
  Vector3f point, normal;
  Matrix3f axes;              // columns: two in the plane, then the normal
  std::vector<size_t> discs;  // rows

  float distance(const Vector3f& p) const { return normal.dot(p - point); }
};

struct DiscShape {
  Vector3f normal;
  float area;
};

// Up to kMostPlanes by consensus, the largest first.
std::vector<SeenPlane> seenPlanes(const Gaussians& discs, const Vector3f& eye, uint64_t seed) {
  const size_t n = discs.mean.size();
  std::vector<DiscShape> shapes(n);
  for (size_t i = 0; i < n; ++i) {
    // The thinnest axis, which fitting may have made another one.
    Eigen::Index thin = 0;
    discs.log_scale[i].minCoeff(&thin);
    const Vector3f sigma = discs.log_scale[i].array().exp();
    shapes[i] = {axesOf(discs.rotation[i]).col(thin), 4 * sigma.prod() / sigma[thin]};
  }
  std::vector<size_t> left(n);
  std::iota(left.begin(), left.end(), size_t(0));
  std::mt19937_64 random(seed);
  std::vector<SeenPlane> planes;
  const auto belongs = [&](size_t i, const Vector3f& p, const Vector3f& normal) {
    return std::abs(normal.dot(discs.mean[i] - p)) < kPlaneSlack &&
           std::abs(normal.dot(shapes[i].normal)) > kPlaneCosine;
  };
  while (planes.size() < kMostPlanes && !left.empty()) {
    std::vector<double> sums;
    double sum = 0;
    for (size_t i : left) sums.push_back(sum += double(shapes[i].area));
    std::vector<size_t> draws;
    for (int k = 0; k < kPlaneDraws; ++k) {
      const double at = sum * double(random() >> 11) * 0x1p-53;
      const size_t i = size_t(std::upper_bound(sums.begin(), sums.end(), at) - sums.begin());
      draws.push_back(left[std::min(i, left.size() - 1)]);
    }
    std::vector<float> areas(draws.size(), 0.f);
    tbb::parallel_for(size_t(0), draws.size(), [&](size_t k) {
      for (size_t i : left)
        if (belongs(i, discs.mean[draws[k]], shapes[draws[k]].normal)) areas[k] += shapes[i].area;
    });
    const size_t best = size_t(std::max_element(areas.begin(), areas.end()) - areas.begin());
    if (areas[best] < kLeastPlane) break;
    SeenPlane plane;
    plane.point = discs.mean[draws[best]], plane.normal = shapes[draws[best]].normal;
    for (int round = 0; round < 3; ++round) {
      Vector3d mean = Vector3d::Zero();
      double mass = 0;
      plane.discs.clear();
      for (size_t i : left)
        if (belongs(i, plane.point, plane.normal)) {
          plane.discs.push_back(i);
          mean += double(shapes[i].area) * discs.mean[i].cast<double>();
          mass += double(shapes[i].area);
        }
      mean /= mass;
      Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
      for (size_t i : plane.discs) {
        const Vector3d d = discs.mean[i].cast<double>() - mean;
        spread += double(shapes[i].area) * d * d.transpose();
      }
      const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solver(spread);
      plane.point = mean.cast<float>();
      plane.normal = solver.eigenvectors().col(0).cast<float>();
      if (plane.normal.dot(eye - plane.point) < 0) plane.normal *= -1;
      plane.axes << solver.eigenvectors().col(2).cast<float>(),
          solver.eigenvectors().col(1).cast<float>(), plane.normal;
    }
    std::vector<size_t> rest;
    std::set_difference(left.begin(), left.end(), plane.discs.begin(), plane.discs.end(),
                        std::back_inserter(rest));
    if (rest.size() == left.size()) break;
    left = std::move(rest);
    planes.push_back(std::move(plane));
  }
  return planes;
}

// The plane that a generated voxel continues; with the squared distances to its nearest discs.
struct Continued {
  const SeenPlane* plane = nullptr;
  std::vector<std::pair<float, size_t>> near;
};
Continued continuedBy(const Blob& voxel, const std::vector<SeenPlane>& planes,
                      const Gaussians& discs, const JoinSettings& s) {
  Continued best;
  float least = s.off_plane_m;
  for (const SeenPlane& plane : planes) {
    const float off = std::abs(plane.distance(voxel.mean));
    if (off >= least) continue;
    std::vector<std::pair<float, size_t>> near;
    for (size_t i : plane.discs) {
      const float d = (discs.mean[i] - voxel.mean).squaredNorm();
      if (d < s.reach_m * s.reach_m) near.emplace_back(d, i);
    }
    if (near.empty()) continue;
    const size_t keep = std::min(near.size(), size_t(kNearDiscs));
    std::partial_sort(near.begin(), near.begin() + std::ptrdiff_t(keep), near.end());
    near.resize(keep);
    least = off, best = {&plane, std::move(near)};
  }
  return best;
}

Blob continuedPlane(const Blob& voxel, const Continued& c, const Gaussians& discs,
                    const JoinSettings& s) {
  Blob b = voxel;
  b.mean -= (c.plane->distance(voxel.mean) + kBehind) * c.plane->normal;
  const float sigma = kPlaneSigma * s.voxel_m;
  const Vector3f v(sigma * sigma, sigma * sigma, kPlaneThickness * kPlaneThickness);
  b.covariance = c.plane->axes * v.asDiagonal() * c.plane->axes.transpose();
  b.opacity = kMostOpacity;
  Vector3f colour = Vector3f::Zero();
  for (const auto& near : c.near) colour += Eigen::Map<const Vector3f>(&discs.sh[3 * near.second]);
  b.colour += s.plane_colour * (colour / float(c.near.size()) - b.colour);
  return b;
}

// --- voxels -----------------------------------------------------------------------------------

std::vector<Blob> voxelBlobs(const Gaussians& g, const Provenance& p, size_t begin, size_t end) {
  std::vector<Blob> blobs;
  for (size_t i = begin; i < end; ++i) {
    Blob b;
    b.mean = g.mean[i], b.colour = Eigen::Map<const Vector3f>(&g.sh[3 * i]);
    b.covariance = covarianceOf(g, i);
    b.opacity = opacityOf(g.opacity_logit[i]);
    b.probability = p.probability[i], b.generated = p.generated[i];
    blobs.push_back(b);
  }
  return blobs;
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
  const std::vector<SeenPlane> planes = seenPlanes(discs, bounds.meanEye(), s.seed);
  const size_t voxels = size_t(decoded.size() / per_voxel);
  std::vector<std::vector<Blob>> kept(voxels);
  tbb::parallel_for(size_t(0), voxels, [&](size_t v) {
    const size_t begin = v * size_t(per_voxel), end = begin + size_t(per_voxel);
    std::vector<Blob> parts = voxelBlobs(decoded, provenance, begin, end);
    if (!parts[0].generated) {
      parts.erase(std::remove_if(parts.begin(), parts.end(),
                                 [&](const Blob& b) { return bounds.sees(b.mean, s.voxel_m); }),
                  parts.end());
      for (Blob& b : parts) b.generated = true;
    } else {
      Blob whole = merged(parts);
      const Continued continued = continuedBy(whole, planes, discs, s);
      if (!continued.plane) {
        // The decoder's Gaussians leave gaps between voxels; one that is wider does not.
        whole.covariance *= kWiden * kWiden, whole.opacity = std::max(whole.opacity, kLeastOpacity);
        parts = {whole};
      } else {
        parts = {continuedPlane(whole, continued, discs, s)};
        // What a view saw there is a disc already.
        if (bounds.sees(parts[0].mean, s.voxel_m)) parts.clear();
      }
    }
    for (Blob& b : parts)
      if (!(b.generated && bounds.sees(b.mean, s.voxel_m)) && bounds.clip(&b)) kept[v].push_back(b);
  });
  SplatScene scene;
  scene.gaussians = std::move(discs);
  scene.gaussians.origin = decoded.origin;
  scene.provenance.generated.assign(scene.gaussians.mean.size(), 0);
  scene.provenance.probability.assign(scene.gaussians.mean.size(), 1.f);
  for (const auto& blobs : kept)
    for (const Blob& b : blobs) appendBlob(b, &scene);
  return scene;
}

}  // namespace vdbc
