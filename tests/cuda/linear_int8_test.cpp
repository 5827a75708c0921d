// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/kernels/linear_int8.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <random>
#include <type_traits>

#include "bundle/encoding.h"
#include "cuda/machine.h"

namespace linear_int8_test {

using namespace vla;
using namespace vla::cuda;
using namespace vla::test::cuda;

namespace {

struct Case {
  int n_row, d_in, d_out, n_split;
  bool has_bias = false, has_residual = false;
};
// Fewer rows, columns and depth than a tile, and a little more; odd rows of y; more stages than there is depth.
constexpr Case kCases[] = {{1, 48, 32, 1},          {3, 100, 80, 1, true},           {129, 144, 131, 1, true, true},
                           {67, 430, 128, 1, true}, {130, 368, 146, 1, false, true}, {33, 700, 97, 3, true, true}};

// For tiles of up to 192 columns and 256 rows: less than a tile, and more; halves of steps; more steps than stages;
// splits of one step and of more; columns that four at a time divide, and do not; blocks of a cluster without rows.
constexpr Case kHopperCases[] = {{5, 48, 33, 1},
                                 {260, 100, 200, 1, true, true},
                                 {65, 700, 70, 1, true},
                                 {67, 430, 128, 3, true},
                                 {96, 290, 136, 3, false, true},
                                 {130, 1100, 97, 2, true, true},
                                 {20, 1030, 132, 8, true, true}};

class Trial {
 public:
  Trial(CodeKind kind, const Case& c) : kind_(kind), c_(c) {
    const int most = kind == CodeKind::ternary ? 1 : kind == CodeKind::int4 ? Int4Block::kMost : 127;
    std::uniform_int_distribution<int> code(-most, most), step(0, Int4Block::kMaxStep);
    std::uniform_int_distribution<int> any(-127, 127);
    std::uniform_real_distribution<float> real(-2, 2);
    const auto fill = [&](std::size_t n) {
      std::vector<float> values(n);
      for (float& v : values) v = real(random_);
      return values;
    };
    codes_.resize(size(c.n_row, depth()));
    row_scale_ = fill(size(c.n_row, 1)), bias_ = fill(size(c.d_out, 1)), scale_ = fill(size(c.d_out, 1));
    residual_ = fill(size(c.n_row, c.d_out));
    // Scales near the ends of the exponents, and that of a row that is not finite.
    for (std::size_t r = 5; r < row_scale_.size(); r += 11) row_scale_[r] = r % 2 == 0 ? 1e-30f : 0;
    for (std::size_t n = 4; n < scale_.size(); n += 13) scale_[n] = n % 2 == 0 ? 3e-39f : 0;
    weight_.resize(size(c.d_out, c.d_in));
    for (auto& v : weight_) v = static_cast<std::int8_t>(code(random_));
    steps_.assign(size(c.d_out, Int4Block::n_of(c.d_in)), 1);
    for (int& v : steps_) v = kind == CodeKind::int4 ? step(random_) : 1;
    x_.resize(size(c.n_row, depth() + 64));
    for (int r = 0; r < c.n_row; ++r) {
      int sum = 0;
      for (int k = 0; k < c.d_in; ++k) {
        codes_[size(r, depth()) + static_cast<std::size_t>(k)] = static_cast<std::int8_t>(any(random_));
        sum += codes_[size(r, depth()) + static_cast<std::size_t>(k)];
      }
      std::byte* row = &x_[size(r, depth() + 64)];
      std::memcpy(row, &codes_[size(r, depth())], static_cast<std::size_t>(depth()));
      std::memcpy(row + depth(), &row_scale_[static_cast<std::size_t>(r)], 4);
      std::memcpy(row + depth() + 4, &sum, 4);
    }
    packed_.resize(packed_int8_size(kind, c.d_in, c.d_out));
    pack_int8(kind, stored().data(), c.d_in, c.d_out, packed_.data());
  }

  /// y of the kernel that `shape` names.
  std::vector<float> run(Int8Shape shape) const {
    return run([&](const LinearInt8Job& job) { return linear_int8(kind_, shape, job); });
  }
  /// in_cluster: a cluster's blocks add the shares, not another kernel.
  std::vector<float> run(const HopperInt8Tile& tile, bool in_cluster) const {
    return run([&](LinearInt8Job& job) {
      if (in_cluster || job.n_split == 1) job.partial = nullptr;
      return hopper_linear_int8(tile, job);
    });
  }

  template <class Made>
  requires std::is_invocable_v<Made, LinearInt8Job&> std::vector<float> run(Made made)
  const {
    const Device<std::byte> x(x_), packed(packed_);
    const Device<float> scale(scale_), bias(bias_), residual(residual_), y(residual_.size());
    const Device<int> partial(residual_.size() * static_cast<std::size_t>(c_.n_split));
    LinearInt8Job job = {x.get(),  packed.get(), scale.get(), depth() + 64, c_.n_row,
                         c_.d_out, depth(),      c_.n_split,  partial.get()};
    job.end = {c_.has_bias ? bias.get() : nullptr,
               nullptr,
               nullptr,
               c_.has_residual ? residual.get() : nullptr,
               y.get(),
               c_.d_out,
               Activation::none,
               false,
               false};
    launch(made(job), job);
    if (c_.n_split > 1 && job.partial != nullptr) launch(finish_int8_partial(job), job);
    return y.host();
  }

  /// The matrix as a bundle has it: int8, two bits in rows of whole bytes, or blocks of four bits.
  std::vector<std::byte> stored() const {
    if (kind_ == CodeKind::int4) return stored_blocks();
    const std::int64_t per_byte = kind_ == CodeKind::ternary ? 4 : 1, row = (c_.d_in + per_byte - 1) / per_byte;
    std::vector<std::byte> bytes(size(c_.d_out, row));
    for (std::int64_t n = 0; n < c_.d_out; ++n)
      for (std::int64_t k = 0; k < c_.d_in; ++k)
        bytes[size(n, row) + static_cast<std::size_t>(k / per_byte)] |=
            static_cast<std::byte>(kind_ == CodeKind::ternary ? (code(n, k) + 1) << 2 * (k % 4) : code(n, k));
    return bytes;
  }

  /// The same a rounding at a time.
  std::vector<float> expected() const {
    std::vector<float> y;
    for (int r = 0; r < c_.n_row; ++r)
      for (int n = 0; n < c_.d_out; ++n) {
        int sum = 0;
        for (int k = 0; k < c_.d_in; ++k)
          sum += codes_[size(r, depth()) + static_cast<std::size_t>(k)] * code(n, k) * step(n, k);
        const float step = scale_[static_cast<std::size_t>(n)] / row_scale_[static_cast<std::size_t>(r)];
        float value = static_cast<float>(sum) * step;
        if (c_.has_bias) value += bias_[static_cast<std::size_t>(n)];
        if (c_.has_residual) value += residual_[size(r, c_.d_out) + static_cast<std::size_t>(n)];
        y.push_back(value);
      }
    return y;
  }

 private:
  static std::size_t size(std::int64_t rows, std::int64_t columns) { return static_cast<std::size_t>(rows * columns); }
  int code(std::int64_t n, std::int64_t k) const { return weight_[size(n, c_.d_in) + static_cast<std::size_t>(k)]; }
  int step(std::int64_t n, std::int64_t k) const {
    return steps_[size(n, Int4Block::n_of(c_.d_in)) + static_cast<std::size_t>(k / 64)];
  }
  std::vector<std::byte> stored_blocks() const {
    std::vector<std::byte> bytes(steps_.size() * sizeof(Int4Block));
    auto* block = reinterpret_cast<Int4Block*>(bytes.data());
    for (std::int64_t n = 0; n < c_.d_out; ++n)
      for (std::int64_t first = 0; first < c_.d_in; first += Int4Block::kElements, ++block) {
        block->step = static_cast<std::uint8_t>(step(n, first));
        for (std::int64_t k = first; k < std::min<std::int64_t>(first + Int4Block::kElements, c_.d_in); ++k)
          block->codes[static_cast<std::size_t>((k - first) / 2)] |=
              static_cast<std::uint8_t>(code(n, k) + Int4Block::kZero) << k % 2 * 4;
      }
    return bytes;
  }
  int depth() const { return static_cast<int>(round_up(c_.d_in, Int8Tile::kDepth)); }

  std::mt19937 random_{3};
  CodeKind kind_;
  Case c_;
  std::vector<std::int8_t> codes_, weight_;
  std::vector<int> steps_;  // of int4's blocks; 1 for others
  std::vector<std::byte> x_, packed_;
  std::vector<float> row_scale_, scale_, bias_, residual_;
};

bool same(const std::vector<float>& a, const std::vector<float>& b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(),
                    [](float x, float y) { return x == y || (std::isnan(x) && std::isnan(y)); });
}

}  // namespace

TEST_CASE("int8 products of every shape are equal to whole numbers and single roundings, bit for bit") {
  counts = {};
  for (CodeKind kind : {CodeKind::ternary, CodeKind::int4, CodeKind::int8})
    for (const Case& c : kCases) {
      const Trial trial(kind, c);
      const std::vector<float> expected = trial.expected();
      for (Int8Shape shape : {Int8Shape::few, Int8Shape::rows64, Int8Shape::rows128}) {
        INFO("kind ", static_cast<int>(kind), ", shape ", static_cast<int>(shape), ", ", c.n_row, " x ", c.d_in, " x ",
             c.d_out);
        in_every_schedule([&] { CHECK(same(trial.run(shape), expected)); });
      }
    }
  CHECK(counts.bank_conflicts == 0);
}

TEST_CASE("int8 products in tiles for Hopper are equal to the same bits") {
  if (!is_hopper()) {
    MESSAGE("skipped: no device of compute capability 9.0");
    return;
  }
  counts = {};
  for (CodeKind kind : {CodeKind::ternary, CodeKind::int8})
    for (const Case& c : kHopperCases) {
      const Trial trial(kind, c);
      const std::vector<float> expected = trial.expected();
      for (const HopperInt8Tile& tile : kHopperInt8Tiles) {
        if (tile.kind != kind) continue;
        INFO(tile.kernel, ", ", c.n_row, " x ", c.d_in, " x ", c.d_out);
        in_two_schedules(static_cast<std::size_t>((&c - kHopperCases) + (&tile - kHopperInt8Tiles)),
                         [&] { CHECK(same(trial.run(tile, true), expected)); });
        if (c.n_split == 1) continue;
        schedule = {7, false};
        CHECK(same(trial.run(tile, false), expected));
        schedule = {};
      }
    }
  CHECK(counts.bank_conflicts == 0);
}

}  // namespace linear_int8_test
