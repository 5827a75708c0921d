// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace vla {

/// How an error in one column of a matrix is made good by those behind it, from the rows x that the matrix multiplies.
/// A row of the matrix that misses e moves its products by e H e, where H = Σ x xᵀ is the Hessian, in squares. With
/// H = M Mᵀ and M upper triangular that is Σ_k M_kk² (e_k + Σ_{j<k} e_j M_jk / M_kk)², so what was missed in column j
/// asks of column k for M_jk / M_kk more. Sources: GPTQ (arXiv 2210.17323), in the form that QuIP (arXiv 2307.13304)
/// gives it.
class Hessian {
 public:
  /// Of rows with `d` elements.
  explicit Hessian(std::int64_t d);

  /// Rows one after the other. Of many, some that are evenly spread.
  void add(std::span<const float> rows);
  /// What kernels::quantize_weights takes.
  std::vector<float> feedback() &&;

  /// Bytes of one.
  static std::size_t size(std::int64_t d);

 private:
  std::int64_t d_;
  std::vector<float> sums_;  // of stretches of columns (kernels::kStretch), one after the other
};

}  // namespace vla
