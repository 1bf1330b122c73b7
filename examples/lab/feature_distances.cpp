#include "examples/lab/feature_distances.h"

#include <Eigen/SVD>
#include <cmath>

#include "vdb/error.h"

namespace vdbc {
namespace {

void requireFeatures(const char* operation, const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  require(a.rows() > 1 && b.rows() > 1 && a.cols() > 0 && a.cols() == b.cols(), operation,
          ": expected at least 2 rows and as many columns in both, found ", a.rows(), " x ",
          a.cols(), " and ", b.rows(), " x ", b.cols());
}

}  // namespace

double frechetDistance(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  requireFeatures("frechetDistance", a, b);
  const Eigen::RowVectorXd mean_a = a.colwise().mean(), mean_b = b.colwise().mean();
  // cov_a = x' x and cov_b = y' y; the square root of cov_a cov_b has as its trace the sum of the
  // singular values of x y', which is small where images are few and features many.
  const Eigen::MatrixXd x = (a.rowwise() - mean_a) / std::sqrt(double(a.rows() - 1));
  const Eigen::MatrixXd y = (b.rowwise() - mean_b) / std::sqrt(double(b.rows() - 1));
  const double root = Eigen::BDCSVD<Eigen::MatrixXd>(x * y.transpose()).singularValues().sum();
  return (mean_a - mean_b).squaredNorm() + x.squaredNorm() + y.squaredNorm() - 2 * root;
}

double kernelDistance(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  requireFeatures("kernelDistance", a, b);
  const auto kernel = [](const Eigen::MatrixXd& x, const Eigen::MatrixXd& y) -> Eigen::ArrayXXd {
    return ((x * y.transpose()).array() / double(x.cols()) + 1).cube();
  };
  const auto within = [&](const Eigen::MatrixXd& x) {  // mean over pairs of different rows
    const Eigen::ArrayXXd k = kernel(x, x);
    return (k.sum() - k.matrix().trace()) / (double(x.rows()) * double(x.rows() - 1));
  };
  return within(a) + within(b) - 2 * kernel(a, b).mean();
}

}  // namespace vdbc
