// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace vla {

/// How later columns of a matrix can compensate an error in an earlier one, given the rows x that the matrix
/// multiplies. An error e of a matrix row changes its products by e H e in squares, where H = Σ x xᵀ is the Hessian.
/// With H = M Mᵀ and M upper triangular this is Σ_k M_kk² (e_k + Σ_{j<k} e_j M_jk / M_kk)², so column k compensates an
/// error in column j with weight M_jk / M_kk. Sources: GPTQ (arXiv 2210.17323), in the form of QuIP (arXiv 2307.13304).
class Hessian {
 public:
  /// For rows of `d` elements.
  explicit Hessian(std::int64_t d);

  /// Adds rows; if there are many, only evenly spaced ones.
  void add(std::span<const float> rows);
  /// The weights that kernels::quantize_weights takes.
  std::vector<float> feedback() &&;

  /// Bytes of a Hessian for rows of `d` elements.
  static std::size_t size(std::int64_t d);

 private:
  std::int64_t d_;
  std::vector<float> sums_;  // a matrix for each stretch of columns (kernels::kStretch)
};

}  // namespace vla
