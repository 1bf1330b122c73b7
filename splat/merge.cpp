#include "splat/merge.h"

#include <tbb/parallel_for.h>

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <map>

#include "splat/cells.h"

namespace vdbc {
namespace {

using Eigen::Matrix3f;
using Eigen::Vector3f;

// Of the three axes, the smallest first.
Vector3f sigmasOf(const Matrix3f& covariance) {
  return Eigen::SelfAdjointEigenSolver<Matrix3f>(covariance, Eigen::EigenvaluesOnly)
      .eigenvalues()
      .cwiseMax(0.f)
      .cwiseSqrt();
}

// What light a blob takes on average over directions.
float areaOf(const Vector3f& sigmas) {
  return sigmas[0] * sigmas[1] + sigmas[1] * sigmas[2] + sigmas[0] * sigmas[2];
}

// Blobs that become one.
struct Cluster {
  std::vector<Blob> parts;
  Blob whole;
};

// The parts as one, if they agree. Parts tile a sheet, so the whole is as opaque as they are.
bool unite(const std::vector<Blob>& parts, const MergeSettings& s, Blob* whole) {
  *whole = merged(parts);
  float thickest = 0, area = 0, light = 0;
  for (const Blob& part : parts) {
    if (kSh0 * (part.colour - whole->colour).cwiseAbs().maxCoeff() > s.colour) return false;
    const Vector3f sigmas = sigmasOf(part.covariance);
    thickest = std::max(thickest, sigmas[0]);
    area += areaOf(sigmas), light += part.opacity * areaOf(sigmas);
  }
  const Vector3f sigmas = sigmasOf(whole->covariance);
  whole->opacity = light / area;
  return sigmas[0] < thickest + s.thickness_m && area > s.least_fill * areaOf(sigmas);
}

// Each blob joins the first cluster that agrees with it.
std::vector<Blob> mergeCell(const std::vector<Blob>& blobs, const MergeSettings& s,
                            const std::function<bool(const Blob&)>& may) {
  std::vector<Cluster> clusters;
  for (const Blob& b : blobs) {
    const auto takes = [&](Cluster& c) {
      Cluster more{c.parts, {}};
      more.parts.push_back(b);
      if (!unite(more.parts, s, &more.whole) || !may(more.whole)) return false;
      c = std::move(more);
      return true;
    };
    if (std::none_of(clusters.begin(), clusters.end(), takes)) clusters.push_back({{b}, b});
  }
  std::vector<Blob> result;
  for (const Cluster& c : clusters) result.push_back(c.whole);
  return result;
}

}  // namespace

Blob blobOf(const Gaussians& g, size_t i) {
  Blob b;
  b.mean = g.mean[i], b.colour = Eigen::Map<const Vector3f>(&g.sh[3 * i]);
  const Eigen::Vector4f& q = g.rotation[i];
  const Matrix3f axes = Eigen::Quaternionf(q[0], q[1], q[2], q[3]).normalized().toRotationMatrix() *
                        g.log_scale[i].array().exp().matrix().asDiagonal();
  b.covariance = axes * axes.transpose();
  b.opacity = 1 / (1 + std::exp(-g.opacity_logit[i]));
  return b;
}

void appendBlob(const Blob& b, Gaussians* g) {
  const Eigen::SelfAdjointEigenSolver<Matrix3f> solver(b.covariance);
  Matrix3f axes = solver.eigenvectors().rowwise().reverse();  // the largest first
  if (axes.determinant() < 0) axes.col(2) *= -1;
  const Eigen::Quaternionf q(axes);
  g->mean.push_back(b.mean);
  g->log_scale.push_back(solver.eigenvalues().reverse().cwiseMax(1e-8f).array().log().matrix() / 2);
  g->rotation.emplace_back(q.w(), q.x(), q.y(), q.z());
  const float opacity = std::clamp(b.opacity, 1e-4f, kMostOpacity);
  g->opacity_logit.push_back(std::log(opacity / (1 - opacity)));
  g->sh.insert(g->sh.end(), b.colour.data(), b.colour.data() + 3);
}

Blob merged(const std::vector<Blob>& parts) {
  Blob b;
  float mass = 0;
  std::vector<float> weights;
  for (const Blob& p : parts) {
    const float w = p.opacity * areaOf(sigmasOf(p.covariance)) + 1e-12f;
    weights.push_back(w);
    mass += w, b.mean += w * p.mean, b.colour += w * p.colour;
    b.probability = std::min(b.probability, p.probability);
  }
  b.mean /= mass, b.colour /= mass;
  for (size_t i = 0; i < parts.size(); ++i) {
    const Vector3f d = parts[i].mean - b.mean;
    b.covariance += weights[i] / mass * (parts[i].covariance + d * d.transpose());
  }
  b.opacity = std::min(kMostOpacity, mass / areaOf(sigmasOf(b.covariance)));
  return b;
}

std::vector<Blob> mergeAlike(const std::vector<Blob>& blobs, const MergeSettings& s,
                             const std::function<bool(const Blob&)>& may) {
  std::map<uint64_t, std::vector<Blob>> by_cell;
  for (const Blob& b : blobs) by_cell[cellOf(b.mean, s.cell_m)].push_back(b);
  std::vector<std::vector<Blob>> cells;
  for (auto& cell : by_cell) cells.push_back(std::move(cell.second));
  tbb::parallel_for(size_t(0), cells.size(),
                    [&](size_t i) { cells[i] = mergeCell(cells[i], s, may); });
  std::vector<Blob> result;
  for (const std::vector<Blob>& cell : cells) result.insert(result.end(), cell.begin(), cell.end());
  return result;
}

}  // namespace vdbc
