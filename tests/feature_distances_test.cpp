#include "examples/lab/feature_distances.h"

#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <cmath>

#include "vdb/error.h"

namespace vdbc {
namespace {

Eigen::MatrixXd someFeatures(Eigen::Index rows, Eigen::Index columns, int seed) {
  Eigen::MatrixXd m(rows, columns);
  for (Eigen::Index i = 0; i < rows; ++i)
    for (Eigen::Index j = 0; j < columns; ++j)
      m(i, j) = double((i * 7919 + j * 104729 + seed * 31337 + i * j * 17) % 1009) / 1009. - .5;
  return m;
}

TEST(FeatureDistances, FrechetEqualsTheFormulaWithMatrixRoots) {
  for (const Eigen::Index rows : {5, 40}) {
    const Eigen::MatrixXd a = someFeatures(rows, 6, 1), b = 2 * someFeatures(rows + 3, 6, 2);
    const auto covariance = [](const Eigen::MatrixXd& m) -> Eigen::MatrixXd {
      const Eigen::MatrixXd c = m.rowwise() - m.colwise().mean();
      return c.transpose() * c / double(m.rows() - 1);
    };
    // tr (A B)^(1/2) = tr (A^(1/2) B A^(1/2))^(1/2)
    const Eigen::MatrixXd ca = covariance(a), cb = covariance(b);
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> solver(ca);
    const Eigen::MatrixXd root = solver.eigenvectors() *
                                 solver.eigenvalues().cwiseMax(0).cwiseSqrt().asDiagonal() *
                                 solver.eigenvectors().transpose();
    const double cross = Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(root * cb * root)
                             .eigenvalues()
                             .cwiseMax(0)
                             .cwiseSqrt()
                             .sum();
    const double expected = (a.colwise().mean() - b.colwise().mean()).squaredNorm() + ca.trace() +
                            cb.trace() - 2 * cross;
    EXPECT_NEAR(frechetDistance(a, b), expected, 1e-6);
    EXPECT_NEAR(frechetDistance(b, a), expected, 1e-6);
    EXPECT_NEAR(frechetDistance(a, a), 0, 1e-9);
    Eigen::MatrixXd moved = a;
    moved.col(2).array() += 3;
    EXPECT_NEAR(frechetDistance(a, moved), 9, 1e-9);
  }
}

TEST(FeatureDistances, KernelEqualsTheSumOverPairs) {
  const Eigen::MatrixXd a = someFeatures(7, 5, 1), b = 3 * someFeatures(4, 5, 2);
  const auto k = [](const auto& x, const auto& y) { return std::pow(x.dot(y) / 5 + 1, 3); };
  double aa = 0, bb = 0, ab = 0;
  for (int i = 0; i < 7; ++i)
    for (int j = 0; j < 7; ++j) aa += i == j ? 0 : k(a.row(i), a.row(j)) / (7 * 6);
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) bb += i == j ? 0 : k(b.row(i), b.row(j)) / (4 * 3);
  for (int i = 0; i < 7; ++i)
    for (int j = 0; j < 4; ++j) ab += k(a.row(i), b.row(j)) / (7 * 4);
  EXPECT_NEAR(kernelDistance(a, b), aa + bb - 2 * ab, 1e-9);
}

TEST(FeatureDistances, RefuseSetsThatDoNotFit) {
  const Eigen::MatrixXd a = someFeatures(3, 4, 1);
  EXPECT_THROW(frechetDistance(a, someFeatures(3, 5, 1)), Error);
  EXPECT_THROW(frechetDistance(a, someFeatures(1, 4, 1)), Error);
  EXPECT_THROW(kernelDistance(Eigen::MatrixXd(), a), Error);
}

}  // namespace
}  // namespace vdbc
