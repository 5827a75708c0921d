// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdlib>
#include <string>

#include "kernels/kernel_set.h"
#include "nn/attention.h"
#include "nn/tokens.h"
#include "support/graph_runner.h"
#include "support/param_set.h"

namespace vla::test {

/// The instruction sets of this machine that graphs are lowered for; ggml is what they are compared with.
inline std::vector<KernelSet> lowered_kernels() {
  std::vector<KernelSet> sets = usable_kernels();
  std::erase(sets, kernel_set::ggml);
  return sets;
}

/// How many of `all` random graphs a test makes: a tenth under a sanitizer or on an emulated processor, where each
/// takes long. The plain build makes all.
inline unsigned some_random(unsigned all) {
#ifdef __SANITIZE_ADDRESS__
  return (all + 9) / 10;
#else
  return std::getenv("VLA_EMULATED") == nullptr ? all : (all + 9) / 10;
#endif
}

/// The same numbers but for rounding: `tolerance` of the largest.
inline void check_close(const std::vector<float>& got, const std::vector<float>& expected, double tolerance = 2e-6) {
  REQUIRE(got.size() == expected.size());
  double largest = 0, difference = 0;
  for (std::size_t i = 0; i < got.size(); ++i) {
    largest = std::max(largest, std::abs(double{expected[i]}));
    const double error = std::abs(double{got[i]} - expected[i]);
    difference = error <= difference ? difference : error;  // a NaN is larger than anything
  }
  CAPTURE(largest);
  CHECK(difference <= tolerance * largest);
}

/// Parameters of the graphs here. A name says the sizes: matrices `w_35_67` with biases `b_67`, vectors `v_35`.
class LowerParams {
 public:
  explicit LowerParams(DType type = DType::f32) : set_(pieces(type)) {
    const Scope s = set_.scope();
    for (const auto& [d_in, d_out] : kMatrices) matrices_.push_back(s.matrix(matrix_name(d_in, d_out), d_in, d_out));
    for (const int d : kVectors) vectors_.push_back(s.vector(vector_name(d), d));
    table_ = s.table("table", kTableWidth, kTableRows);
  }
  const ParamList& list() const { return set_.list(); }

  Tensor linear(Graph& g, Tensor x, int d_out, bool bias = true, int which = 0) const {
    for (std::size_t i = 0; i < std::size(kMatrices); ++i)
      if (kMatrices[i].first == x.dim(0) && kMatrices[i].second == d_out && which-- == 0)
        return g.add(op::Linear{matrices_[i], bias ? vector(d_out) : nullptr}, {x});
    FAIL("no matrix " << x.dim(0) << " to " << d_out);
    return {};
  }
  const Param* vector(int d) const {
    for (std::size_t i = 0; i < std::size(kVectors); ++i)
      if (kVectors[i] == d) return vectors_[i];
    FAIL("no vector " << d);
    return nullptr;
  }
  Tensor parameter(Graph& g, int d) const { return g.parameter(vector(d)); }
  const Param* table() const { return table_; }

  static constexpr int kTableWidth = 35, kTableRows = 9;

 private:
  static constexpr std::pair<int, int> kMatrices[] = {{35, 67}, {35, 67}, {67, 35}, {35, 35}, {24, 24}, {24, 24},
                                                      {24, 48}, {48, 24}, {8, 24},  {32, 24}, {32, 24}};
  static constexpr int kVectors[] = {35, 67, 24, 48, 8};

  static std::string matrix_name(int d_in, int d_out) {
    static int n = 0;  // matrices of the same sizes
    return "w_" + std::to_string(d_in) + "_" + std::to_string(d_out) + "_" +
           std::to_string(n++ % static_cast<int>(std::size(kMatrices)));
  }
  static std::string vector_name(int d) { return "v_" + std::to_string(d); }
  static std::vector<ParamSet::Piece> pieces(DType type) {
    std::vector<ParamSet::Piece> all;
    float range = 0.1f;
    for (const auto& [d_in, d_out] : kMatrices)
      all.push_back({matrix_name(d_in, d_out),
                     {d_in, d_out},
                     ramp(static_cast<std::size_t>(d_in * d_out), range += 0.02f),
                     type});
    for (const int d : kVectors) all.push_back({vector_name(d), {d}, ramp(static_cast<std::size_t>(d), 1)});
    all.push_back({"table", {kTableWidth, kTableRows}, ramp(kTableWidth * kTableRows, 1), type});
    return all;
  }

  ParamSet set_;
  std::vector<const Param*> matrices_, vectors_;
  const Param* table_;
};

/// A slot with values that differ from seed to seed.
inline Tensor input(GraphRunner& r, const Shape& shape, float range = 1) {
  std::vector<float> values = ramp(static_cast<std::size_t>(count(shape)) + 1000, range);
  const auto first = static_cast<std::ptrdiff_t>(r.graph.nodes().size() * 37 % 1000);
  return r.graph.input(r.slot({values.begin() + first, values.begin() + first + count(shape)}, shape));
}

/// x as a part of something wider, whose rows, tokens and batches lie apart.
inline Tensor strided(GraphRunner& r, const Shape& shape, float range = 1) {
  Shape wide = shape;
  wide[0] += 3, wide[1] += 2, wide[2] += 1;
  Tensor x = input(r, wide, range);
  for (int dim = 0; dim < 3; ++dim)
    x = slice(r.graph, x, dim, dim == 0 ? 2 : 1, static_cast<int>(shape[static_cast<std::size_t>(dim)]));
  return x;
}

using Build = std::function<Tensor(GraphRunner&, const LowerParams&)>;

inline std::vector<float> result_of(const std::string& kernels, const LowerParams& params, const Build& build) {
  GraphRunner runner(params.list(), kernels, GraphRunner::is_result, 3);
  runner.graph.name("result", build(runner, params));
  runner.lower();
  runner.run();
  return runner.tap("result");
}

/// Lowered for every instruction set, a graph gives what it gives as plain ggml operations.
inline void check_like_ggml(const Build& build, double tolerance = 2e-6) {
  const LowerParams params;
  const std::vector<float> expected = result_of("ggml", params, build);
  for (const KernelSet& set : lowered_kernels()) {
    CAPTURE(name_of(set));
    check_close(result_of(name_of(set), params, build), expected, tolerance);
  }
}

}  // namespace vla::test
