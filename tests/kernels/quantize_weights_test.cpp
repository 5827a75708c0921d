// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/quantize_weights.h"

#include <doctest/doctest.h>

#include <cmath>
#include <random>
#include <vector>

#include "support/stored.h"

namespace quantize_weights_test {

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

namespace {

struct Int4 {
  std::vector<Int4Block> blocks;
  float scale = 0;
  float value(std::size_t k) const {
    return static_cast<float>(blocks[k / 64][static_cast<std::int64_t>(k % 64)]) * scale;
  }
};

Int4 int4_of(const std::vector<float>& row) {
  Int4 result = {std::vector<Int4Block>(static_cast<std::size_t>(Int4Block::n_of(std::ssize(row))))};
  std::vector<float> room(64 * result.blocks.size(), NAN);
  quantize_weights(DType::f32, reinterpret_cast<const std::byte*>(row.data()), static_cast<std::int64_t>(row.size()), 1,
                   result.blocks.data(), &result.scale, room.data());
  return result;
}

double missed(const std::vector<float>& row, const auto& value) {
  double sum = 0;
  for (std::size_t k = 0; k < row.size(); ++k) sum += std::pow(double{row[k]} - value(k), 2);
  return sum;
}

}  // namespace

TEST_CASE("int4: whole multiples of a block's step are exact, whatever the steps of a row") {
  std::vector<float> row(128);
  for (std::size_t k = 0; k < row.size(); ++k)
    row[k] = 0.25f * static_cast<float>((static_cast<int>(k % 15) - 7) * (k < 64 ? 17 : 3));
  const Int4 q = int4_of(row);
  CHECK(q.scale == 0.25f);
  CHECK(q.blocks[0].step == 17);
  CHECK(q.blocks[1].step == 3);
  for (std::size_t k = 0; k < row.size(); ++k) CHECK(q.value(k) == row[k]);
}

TEST_CASE("int4: of normal numbers it misses less than the nearest multiples of a seventh of each block's largest") {
  std::mt19937 random(5);
  std::normal_distribution<float> normal;
  std::vector<float> row(1024);
  for (std::size_t k = 0; k < row.size(); ++k) row[k] = normal(random) * (k / 64 % 3 == 1 ? 0.2f : 1.0f);
  const Int4 q = int4_of(row);
  const auto simple = [&](std::size_t k) {
    float most = 0;
    for (std::size_t i = k / 64 * 64; i < k / 64 * 64 + 64; ++i) most = std::max(most, std::abs(row[i]));
    return std::nearbyint(row[k] / (most / 7)) * (most / 7);
  };
  CHECK(missed(row, [&](std::size_t k) { return q.value(k); }) < missed(row, simple));
  for (const Int4Block& block : q.blocks) {
    CHECK(block.step <= Int4Block::kMaxStep);
    for (const int two : block.codes) CHECK(((two & 15) != 0 && two >> 4 != 0));
  }
}

TEST_CASE("int4: a row that ends within a block is one with zeros behind it") {
  std::vector<float> row(80);
  for (std::size_t k = 0; k < row.size(); ++k) row[k] = std::sin(static_cast<float>(k));
  const Int4 q = int4_of(row);
  row.resize(128);
  const Int4 padded = int4_of(row);
  REQUIRE(q.blocks.size() == 2);
  CHECK(q.scale == padded.scale);
  for (std::size_t i = 0; i < 2; ++i) {
    CHECK(q.blocks[i].step == padded.blocks[i].step);
    CHECK(q.blocks[i].codes == padded.blocks[i].codes);
  }
}

TEST_CASE("int4: rows of zeros, of tiny weights and of weights that are not finite") {
  std::vector<float> row(64);
  CHECK(int4_of(row).scale == 0);
  row[3] = 1e-38f;
  CHECK(int4_of(row).scale == 0);
  for (const float bad : {std::numeric_limits<float>::infinity(), std::numeric_limits<float>::quiet_NaN()}) {
    row[3] = bad;
    CHECK(std::isnan(int4_of(row).scale));
    CHECK(int4_of(row).blocks[0][3] == 0);
  }
}

namespace {

/// A random matrix as int4 with this feedback.
std::vector<Int4> int4_of(const std::vector<float>& rows, std::int64_t d_in, const std::vector<float>& feedback) {
  const std::int64_t d_out = static_cast<std::int64_t>(rows.size()) / d_in, n_block = Int4Block::n_of(d_in);
  std::vector<Int4Block> blocks(static_cast<std::size_t>(d_out * n_block));
  std::vector<float> scales(static_cast<std::size_t>(d_out)), room(rows.size());
  quantize_weights(DType::f32, reinterpret_cast<const std::byte*>(rows.data()), d_in, d_out, feedback.data(),
                   blocks.data(), scales.data(), room.data());
  std::vector<Int4> result;
  for (std::int64_t n = 0; n < d_out; ++n)
    result.push_back(
        {{blocks.begin() + n * n_block, blocks.begin() + (n + 1) * n_block}, scales[static_cast<std::size_t>(n)]});
  return result;
}

}  // namespace

TEST_CASE("int4 with feedback: columns that are always equal share what they miss") {
  constexpr std::size_t kWidth = 128;
  std::mt19937 random(6);
  std::normal_distribution<float> normal;
  std::vector<float> rows(4 * kWidth), feedback(kWidth * kWidth);
  for (float& value : rows) value = normal(random);
  for (std::size_t j = 0; j < kWidth; ++j)
    for (std::size_t k = j + 1; k < kWidth; ++k) feedback[j * kWidth + k] = 1;
  const std::vector<Int4> with = int4_of(rows, kWidth, feedback);
  for (std::size_t r = 0; r < with.size(); ++r) {
    const std::vector<float> row(rows.begin() + static_cast<std::ptrdiff_t>(r * kWidth),
                                 rows.begin() + static_cast<std::ptrdiff_t>((r + 1) * kWidth));
    const Int4 without = int4_of(row);
    double sum = 0, sum_with = 0, sum_without = 0;
    for (std::size_t k = 0; k < kWidth; ++k)
      sum += row[k], sum_with += with[r].value(k), sum_without += without.value(k);
    CHECK(std::abs(sum_with - sum) < 0.5 * with[r].scale * 17);  // no more than the last column misses
    CHECK(missed(row, [&](std::size_t k) { return with[r].value(k); }) <
          4 * missed(row, [&](std::size_t k) { return without.value(k); }));
  }
}

TEST_CASE("int4 without feedback in any column are the codes that it has without") {
  constexpr std::size_t kWidth = 1024 + 80;
  std::vector<float> row(kWidth), none(1024 * 1024 + 80 * 80);
  std::mt19937 random(7);
  std::normal_distribution<float> normal;
  for (float& value : row) value = normal(random);
  const Int4 with = int4_of(row, kWidth, none).front(), without = int4_of(row);
  for (std::size_t i = 0; i < with.blocks.size(); ++i) {
    CHECK(with.blocks[i].step == without.blocks[i].step);
    CHECK(with.blocks[i].codes == without.blocks[i].codes);
  }
}

TEST_CASE("int4 with feedback: rows of zeros and of weights that are not finite") {
  std::vector<float> rows(128), feedback(64 * 64, 1.0f);
  rows[70] = std::numeric_limits<float>::infinity();
  const std::vector<Int4> got = int4_of(rows, 64, feedback);
  CHECK(got[0].scale == 0);
  CHECK(std::isnan(got[1].scale));
  for (const Int4& row : got)
    for (std::size_t k = 0; k < 64; ++k) CHECK(row.blocks[0][static_cast<std::int64_t>(k)] == 0);
}

}  // namespace quantize_weights_test
