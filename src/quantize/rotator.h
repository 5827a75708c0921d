// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

namespace vla {

/// An orthogonal d x d matrix that spreads every channel over all: B S Bᵀ, with random signs S, and B the Kronecker
/// product of Hadamard's matrix, for the largest power of two that divides d, and the cosine transform (DCT-II) for the
/// rest. The first column of B is constant and its sign 1, so a vector of equal elements stays as it is. The matrix is
/// symmetric, so it is its own inverse. Equal d give equal matrices.
class Rotator {
 public:
  explicit Rotator(std::int64_t d);
  std::int64_t d() const { return n_power_ * n_rest_; }
  /// Rotates the columns of x [n, d] (fastest first) in place.
  void rotate(double* x, std::int64_t n);

 private:
  void hadamard(double* x, std::int64_t n) const;
  void cosines(double* x, std::int64_t n, bool is_inverse);

  std::int64_t n_power_ = 1, n_rest_;
  std::vector<double> cosines_;  // [n_rest_, n_rest_]: one cosine after the other
  std::vector<double> signs_;    // divided by n_power_
  std::vector<double> part_;
};

}  // namespace vla
