#pragma once
// Private: few Gaussians for many, by their moments. See docs/method.md, section 6.4.
#include <functional>
#include <vector>

#include "splat/gaussians.h"

namespace vdbc {

constexpr float kMostOpacity = .99f;

/// A Gaussian in the terms that merging takes.
struct Blob {
  Eigen::Vector3f mean = Eigen::Vector3f::Zero();
  Eigen::Vector3f colour = Eigen::Vector3f::Zero();  // SH of degree 0
  Eigen::Matrix3f covariance = Eigen::Matrix3f::Zero();
  float opacity = 0, probability = 1;
};

Blob blobOf(const Gaussians& gaussians, size_t row);
/// As another row of Gaussians of SH degree 0; the largest axis comes first.
void appendBlob(const Blob& blob, Gaussians* gaussians);

/// One blob with the moments of several (at least one), the light that they take together, averaged
/// over directions, and the lowest of their probabilities.
Blob merged(const std::vector<Blob>& parts);

struct MergeSettings {
  float cell_m = .2f;         // edge of the cells within which blobs are merged
  float colour = .06f;        // display sRGB; parts may be as far from their mean
  float thickness_m = .001f;  // a merged blob may be as much thicker than its thickest part
  float least_fill = .5f;     // of its area by its parts: what lies apart stays apart
};

/// Blobs of a cell that agree in colour and lie in one sheet as one, where `may` says yes to it.
/// Parallel; the same for any number of threads.
std::vector<Blob> mergeAlike(const std::vector<Blob>& blobs, const MergeSettings& settings,
                             const std::function<bool(const Blob&)>& may);

}  // namespace vdbc
