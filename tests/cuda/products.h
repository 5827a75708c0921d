// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include "cuda/kernels/epilogue.h"
#include "cuda/machine.h"
#include "cuda/numbers.h"

/// Products of floats for tests of kernels.
namespace vla::test::cuda {

using vla::cuda::Epilogue;

struct ProductCase {
  int n_row, depth, n_column, n_split;
  Activation activation = Activation::none;
  bool has_bias = false, has_factor = false, has_gate = false, has_residual = false, is_bf16 = false,
       ends_in_relu = false;
};

struct Operands {
  Operands(const ProductCase& of, bool rounds_x) : c(of) {
    Numbers numbers;
    x = numbers.floats(c.n_row * c.depth);
    if (rounds_x) x = rounded_to_bf16(x);
    weight = rounded_to_bf16(numbers.floats(c.n_column * c.depth, 1 / std::sqrt(static_cast<float>(c.depth))));
    bias = numbers.floats(c.n_column), factor = numbers.floats(c.n_column);
    gate = numbers.floats(c.n_row * c.n_column), residual = numbers.floats(c.n_row * c.n_column);
  }

  std::vector<double> expected() const {
    std::vector<double> y;
    for (int r = 0; r < c.n_row; ++r)
      for (int n = 0; n < c.n_column; ++n) {
        const auto column = static_cast<std::size_t>(n), at = static_cast<std::size_t>(r * c.n_column + n);
        double sum = c.has_bias ? static_cast<double>(bias[column]) : 0;
        for (int k = 0; k < c.depth; ++k)
          sum += static_cast<double>(x[static_cast<std::size_t>(r * c.depth + k)]) *
                 static_cast<double>(weight[static_cast<std::size_t>(n * c.depth + k)]);
        sum = c.has_gate ? activated(c.activation, static_cast<double>(gate[at])) * sum : activated(c.activation, sum);
        if (c.has_factor) sum *= static_cast<double>(factor[column]);
        if (c.has_residual) sum += static_cast<double>(residual[at]);
        y.push_back(c.ends_in_relu ? activated(Activation::relu, sum) : sum);
      }
    return y;
  }

  ProductCase c;
  std::vector<float> x, weight, bias, factor, gate, residual;
};

/// Launches with the operands' epilogue; `multiply` gets it, and y's rows are two elements longer than they need be.
template <class Multiply>
std::vector<float> run_product(const Operands& of, Multiply multiply) {
  const ProductCase& c = of.c;
  const Device<float> bias(of.bias), factor(of.factor), gate(of.gate), residual(of.residual);
  const std::int64_t stride = c.n_column + (c.n_column % 4 == 0 ? 4 : 2);
  const Device<float> y(static_cast<std::size_t>(c.n_row * stride));
  const Device<std::uint16_t> half(static_cast<std::size_t>(c.n_row * stride));
  multiply(Epilogue{c.has_bias ? bias.get() : nullptr, c.has_factor ? factor.get() : nullptr,
                    c.has_gate ? gate.get() : nullptr, c.has_residual ? residual.get() : nullptr,
                    c.is_bf16 ? static_cast<void*>(half.get()) : y.get(), stride, c.activation, c.is_bf16,
                    c.ends_in_relu});
  const std::vector<float> rows = c.is_bf16 ? widened(half.host()) : y.host();
  std::vector<float> out;
  for (int r = 0; r < c.n_row; ++r) {
    const auto first = rows.begin() + r * stride;
    out.insert(out.end(), first, first + c.n_column);
    CHECK(std::isnan(first[c.n_column]));  // nothing is written behind a row
  }
  return out;
}

}  // namespace vla::test::cuda
