// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/recode.h"

#include <doctest/doctest.h>

#include "support/stored.h"

namespace recode_test {

using namespace vla;
using lower::Recode;

namespace {

struct Recoded {
  std::vector<std::byte> bytes;
  std::vector<float> scales;
};

Recoded recoded(std::vector<float> values, DType stored, Encoding wanted) {
  const std::vector<std::byte> from = test::store_as(stored, values);
  const auto count = static_cast<std::int64_t>(values.size());
  Recoded result = {{}, std::vector<float>(static_cast<std::size_t>(wanted.n_scale(count)))};
  ReadBuffer buffer;
  const std::byte* to = Recode{{stored}, wanted}(from.data(), nullptr, count, buffer, result.scales.data());
  result.bytes.assign(to, to + dtype_size(wanted.type, count));
  return result;
}

std::vector<int> codes(const Recoded& recoded) {
  std::vector<int> codes;
  for (const std::byte code : recoded.bytes) codes.push_back(static_cast<signed char>(code));
  return codes;
}

}  // namespace

TEST_CASE("int8 codes have a scale for every group: for each row, or several in a row") {
  const std::vector<float> rows = {0, 1, -2, 0.5f, 254, 127, -5, 1};  // 4 to a row
  for (const DType stored : {DType::f32, DType::bf16, DType::f16}) {
    const Recoded by_row = recoded(rows, stored, {DType::i8, 4}), by_half = recoded(rows, stored, {DType::i8, 2});
    CHECK(codes(by_row) == std::vector<int>{0, 64, -127, 32, 127, 64, -2, 0});
    CHECK(by_row.scales == std::vector<float>{2.0f / 127, 2});
    CHECK(codes(by_half) == std::vector<int>{0, 127, -127, 32, 127, 64, -127, 25});
    CHECK(by_half.scales == std::vector<float>{1.0f / 127, 2.0f / 127, 2, 5.0f / 127});
  }
}

TEST_CASE("what is stored as it is wanted stays where it is, codes too") {
  const std::vector<std::byte> stored(8, std::byte{0x15});
  ReadBuffer buffer;
  for (const Encoding same : {Encoding{DType::f32}, Encoding{DType::bf16}, Encoding{DType::ternary, 8}}) {
    const Recode recode = {same, same};
    CHECK_FALSE(recode.changes());
    CHECK(recode(stored.data(), nullptr, 2, buffer, nullptr) == stored.data());
  }
}

TEST_CASE("bf16 is the nearest one, ties to even") {
  std::vector<float> expected = {1, -1 - 0x1p-7f, 0x1p-130f, 3.0e38f};
  const Recoded rounded = recoded({1 + 0x1p-8f, -1 - 0x1.8p-8f, 0x1p-130f, 3.0e38f}, DType::f32, {DType::bf16});
  CHECK(rounded.bytes == test::store_as(DType::bf16, expected));
  CHECK(rounded.scales.empty());
}

TEST_CASE("floats become float32 without a change") {
  for (const DType stored : {DType::f16, DType::bf16}) {
    std::vector<float> values = {1, -0.3f, 1000, 0};
    const Recoded wide = recoded(values, stored, {DType::f32});
    test::store_as(stored, values);
    CHECK(wide.bytes == test::store_as(DType::f32, values));
  }
}

TEST_CASE("codes become float32 by the scale of their group") {
  const std::vector<std::byte> codes = {std::byte{127}, std::byte{0x81}, std::byte{3}, std::byte{0}};
  const std::vector<float> scales = {0.1f, 2};
  ReadBuffer buffer;
  const std::byte* to = Recode{{DType::i8, 2}, {DType::f32}}(codes.data(), scales.data(), 4, buffer, nullptr);
  const auto* values = reinterpret_cast<const float*>(to);
  CHECK(std::vector<float>(values, values + 4) == std::vector<float>{127 * 0.1f, -127 * 0.1f, 6, 0});
}

TEST_CASE("int4 codes become float32 by their step and the scale of their row") {
  constexpr int kWidth = 70;  // two blocks
  std::vector<int> codes(2 * kWidth);
  codes[0] = -7, codes[1] = 5, codes[64] = 2, codes[kWidth + 69] = 3;
  const std::vector<std::byte> stored = test::store_int4(codes, kWidth, {17, 3, 1, 2});
  const std::vector<float> scales = {0.1f, 0.5f};
  ReadBuffer buffer;
  const std::byte* to = Recode{{DType::int4, kWidth}, {DType::f32}}(stored.data(), scales.data(), 140, buffer, nullptr);
  const auto* values = reinterpret_cast<const float*>(to);
  CHECK(values[0] == -119 * 0.1f);
  CHECK(values[1] == 85 * 0.1f);
  CHECK(values[64] == 6 * 0.1f);
  CHECK(values[kWidth + 69] == 6 * 0.5f);
  CHECK(values[2] == 0);
}

}  // namespace recode_test
