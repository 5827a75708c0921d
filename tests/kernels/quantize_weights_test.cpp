// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/quantize_weights.h"

#include <doctest/doctest.h>

#include <vector>

#include "support/stored.h"

using namespace vla;
using namespace vla::kernels;

namespace {

struct Quantized {
  std::vector<int> codes;
  std::vector<float> scales;
};

Quantized quantized(std::vector<float> rows, std::int64_t d_in, DType type = DType::f32) {
  const auto stored = test::store_as(type, rows);
  const std::int64_t d_out = static_cast<std::int64_t>(rows.size()) / d_in;
  std::vector<std::byte> codes(rows.size());
  Quantized result = {{}, std::vector<float>(static_cast<std::size_t>(d_out))};
  std::vector<float> row(static_cast<std::size_t>(d_in));
  quantize_weights(type, stored.data(), d_in, d_out, codes.data(), result.scales.data(), row.data());
  for (const std::byte code : codes) result.codes.push_back(static_cast<signed char>(code));
  return result;
}

}  // namespace

TEST_CASE("the greatest weight of a row becomes 127, and halves of a code the even one") {
  for (const DType type : {DType::f32, DType::bf16, DType::f16}) {
    const Quantized q = quantized({0, 1, -2, 0.5f, 254, 3, -5, 1}, 4, type);
    CHECK(q.codes == std::vector<int>{0, 64, -127, 32, 127, 2, -2, 0});
    CHECK(q.scales == std::vector<float>{2.0f / 127, 2});
  }
}

TEST_CASE("rows of zeros, of tiny weights and of weights that are not finite") {
  const float infinity = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  const Quantized q = quantized({0, 0, 1e-38f, -1e-39f, infinity, 1, 1, nan}, 2);
  CHECK(q.codes == std::vector<int>(8, 0));
  CHECK(q.scales[0] == 0);
  CHECK(q.scales[1] == 0);
  CHECK(std::isnan(q.scales[2]));
  CHECK(std::isnan(q.scales[3]));
}
