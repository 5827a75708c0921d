// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "cuda/kernels/linear_bf16.h"
#include "cuda/products.h"

namespace vla::test::cuda {

/// A bf16 product for tiles of Hopper, which compute its gate too, if it has one: that is the product of the same rows
/// with another matrix.
class GatedProduct {
 public:
  GatedProduct(const ProductCase& c, bool is_gated)
      : of_(c, true),
        gate_({c.n_row, c.depth, c.n_column, 1, Activation::none, c.has_bias}, true),
        is_gated_(is_gated) {
    if (!is_gated) return;
    std::reverse_copy(of_.weight.begin(), of_.weight.end(), gate_.weight.begin());
    const std::vector<double> made = gate_.expected();
    std::copy(made.begin(), made.end(), of_.gate.begin()), of_.c.has_gate = true;
  }
  std::vector<double> expected() const { return of_.expected(); }
  /// The largest error of y, as a share of its largest number.
  double most() const { return of_.c.is_bf16 ? 4e-3 : (is_gated_ ? 2 : 1) * (1e-6 + bf16_sum_error(of_.c.depth)); }
  /// y of run_one(job), which launches kernels; the job has no partial sums.
  template <class RunOne>
  std::vector<float> run(RunOne run_one) const {
    const ProductCase& c = of_.c;
    const std::int64_t stride = vla::cuda::round_up(c.depth, 8) + 8;
    return run_product(of_, [&](Epilogue end) {
      if (is_gated_) end.gate = nullptr;
      const Device<float> bias(gate_.bias);
      const Device<std::uint16_t> x(bf16_rows(of_.x, c.depth, stride)), weight(bf16_rows(of_.weight, c.depth, stride)),
          gate_weight(bf16_rows(gate_.weight, c.depth, stride));
      vla::cuda::LinearBf16Job job = {
          .x = x.get(), .weight = weight.get(), .x_stride = stride, .weight_stride = stride};
      job.n_row = c.n_row, job.n_column = c.n_column, job.depth = c.depth, job.n_split = c.n_split, job.end = end;
      if (is_gated_) job.gate_weight = gate_weight.get(), job.gate_bias = c.has_bias ? bias.get() : nullptr;
      run_one(job);
    });
  }

 private:
  Operands of_, gate_;
  bool is_gated_;
};

}  // namespace vla::test::cuda
