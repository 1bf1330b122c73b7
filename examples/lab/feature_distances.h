#pragma once
// How far two sets of pictures are from each other by the features of a network.
#include <Eigen/Core>

namespace vdbc {

/// Between the features of two sets of images, one row an image, at least two rows each: of
/// Gaussians fitted to them (FID if the network is its Inception, Heusel et al. 2017), |mean_a -
/// mean_b|^2 + tr(cov_a + cov_b - 2 (cov_a cov_b)^(1/2)). Biased upwards for few images.
double frechetDistance(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b);
/// The same by the unbiased squared maximum mean discrepancy with the kernel (x y / columns + 1)^3
/// (KID, Binkowski et al. 2018). May be below 0 for sets alike.
double kernelDistance(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b);

}  // namespace vdbc
