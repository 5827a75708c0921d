// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Times products in every shape of blocks and split of the depth on the first GPU, one JSON object a line. Run by
// scripts/measure_gpu.sh. On the driver of tests the times say nothing.
//
// Operands are random: a card clocks higher on zeros. `us` is of matrices in turn that no cache holds together, as in
// an act, where each comes from memory; `warm_us` of one matrix again and again.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <random>
#include <span>
#include <utility>

#include "base/bf16.h"
#include "cuda/kernels/hopper_tma.h"
#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_int8.h"
#include "cuda/library/launch_timer.h"
#include "kernels/quantized.h"

namespace {

using namespace vla;
using namespace vla::cuda;
using test::cuda::LaunchTimer;
using Bytes = std::vector<std::byte>;

struct Size {
  int n_row, depth, n_column;
};
// Of a chunk's end, of steps of a few rows, of action experts, of language models and of vision towers.
constexpr Size kSizes[] = {{50, 720, 32},     {1, 2048, 2048},   {4, 960, 2560},     {50, 720, 2048},
                           {50, 1024, 4096},  {113, 960, 2560},  {642, 2560, 2560},  {642, 2560, 6912},
                           {642, 6912, 2560}, {512, 1152, 4304}, {560, 16384, 2048}, {968, 2048, 16384},
                           {2048, 768, 3072}};
constexpr int kSplits[] = {1, 2, 4, 8};
/// More than the largest cache of a GPU.
constexpr std::size_t kBeyondCaches = 200u << 20;

std::size_t bytes(std::int64_t n) { return static_cast<std::size_t>(n); }

/// Random numbers as operands are stored.
class Numbers {
 public:
  Bytes floats(std::int64_t n) {
    return made<float>(n, [&] { return normal_(random_); });
  }
  Bytes bf16(std::int64_t n) {
    return made<std::uint16_t>(n, [&] { return to_bf16(normal_(random_)); });
  }
  Bytes int8(std::int64_t n) {
    return made<std::uint8_t>(n, [&] { return static_cast<std::uint8_t>(random_()); });
  }
  /// Four codes a byte, each plus 1.
  Bytes ternary(std::int64_t n) {
    return made<std::uint8_t>(n, [&] {
      unsigned byte = 0;
      for (int i = 0; i < 4; ++i) byte = byte << 2 | static_cast<unsigned>(random_() % 3);
      return static_cast<std::uint8_t>(byte);
    });
  }
  /// Rows of codes with their scales, as kernels/quantized.h has them.
  Bytes quantized(std::int64_t n_row, std::int64_t depth) {
    const std::int64_t stride = kernels::quantized_stride(depth);
    Bytes rows = int8(n_row * stride);
    constexpr kernels::RowScale kScale = {100, 0};
    for (std::int64_t row = 0; row < n_row; ++row)
      std::memcpy(&rows[bytes(row * stride + kernels::quantized_depth(depth))], &kScale, sizeof(kScale));
    return rows;
  }

 private:
  template <class T, class Make>
  static Bytes made(std::int64_t n, Make make) {
    Bytes all(bytes(n) * sizeof(T));
    for (std::size_t i = 0; i < all.size(); i += sizeof(T)) {
      const T value = make();
      std::memcpy(&all[i], &value, sizeof(T));
    }
    return all;
  }
  std::mt19937 random_{7};
  std::normal_distribution<float> normal_{0, 0.1f};
};

class Bench {
 public:
  explicit Bench(LaunchTimer timer) : timer_(std::move(timer)) {}

  /// Every kind of matrix, shape and split of a size.
  Status run(const Size& size) {
    const std::int64_t rows = size.n_row, columns = size.n_column;
    VLA_TRY(const Buffer partial, timer_.gpu().allocate(bytes(4 * 8 * rows * columns), "partial sums"));
    VLA_TRY(const Buffer y, timer_.gpu().allocate(bytes(4 * rows * columns), "y"));
    Epilogue end = {};
    end.y = y.as<void>(), end.y_stride = columns;
    VLA_CHECK(run_bf16(size, partial, end));
    VLA_CHECK(run_codes("ternary", CodeKind::ternary, numbers_.ternary(kPattern), size, partial, end));
    VLA_CHECK(run_codes("int4", CodeKind::int4, numbers_.int8(kPattern), size, partial, end));
    return run_codes("int8", CodeKind::int8, numbers_.int8(kPattern), size, partial, end);
  }

 private:
  Status run_bf16(const Size& size, const Buffer& partial, const Epilogue& end) {
    const std::int64_t stride = round_up(size.depth, 8);
    VLA_TRY(const Buffer x, timer_.upload(numbers_.bf16(size.n_row * stride)));
    VLA_TRY(const Buffer x_few, timer_.upload(numbers_.floats(size.n_row * stride)));
    VLA_TRY(const auto matrices, fill_matrices(bytes(2 * size.n_column * stride), numbers_.bf16(kPattern / 2)));
    for (const int n_split : kSplits)
      for (const auto& [name, shape] : {std::pair{"few", Bf16Shape::few},
                                        {"strip 16", Bf16Shape::strip16},
                                        {"strip 32", Bf16Shape::strip32},
                                        {"strip 64", Bf16Shape::strip64},
                                        {"strip 128", Bf16Shape::strip128},
                                        {"64", Bf16Shape::rows64},
                                        {"128", Bf16Shape::rows128}}) {
        if (shape == Bf16Shape::few && size.n_row > 4 * kBf16FewRows) continue;
        std::vector<LinearBf16Job> jobs;
        for (const Buffer& matrix : matrices)
          jobs.push_back({shape == Bf16Shape::few ? x_few.as<void>() : x.as<void>(), matrix.as<std::uint16_t>(), stride,
                          stride, size.n_row, size.n_column, size.depth, n_split, partial.as<float>(), end});
        std::vector<Launch> launches = {linear_bf16(shape, jobs[0])};
        if (n_split > 1) launches.push_back(finish_bf16_partial(jobs[0]));
        VLA_CHECK(tell("bf16", size, name, n_split, jobs, launches));
      }
    if (!timer_.gpu().is_hopper() || size.n_row <= 32) return {};
    VLA_CHECK(run_hopper(size, x, matrices, partial, end));
    return size.depth % 8 == 0 ? run_tma(size, x, matrices, end) : Status();
  }

  /// Tiles whose operands TMA fetches.
  Status run_tma(const Size& size, const Buffer& x, const std::vector<Buffer>& matrices, const Epilogue& end) {
    for (const HopperTmaTile& tile : kHopperTmaTiles) {
      if (tile.is_gated && size.n_column % 2 != 0) continue;
      std::vector<HopperTmaJob> jobs;
      for (const Buffer& matrix : matrices) {
        LinearBf16Job product = {.x = x.as<void>(), .weight = matrix.as<std::uint16_t>(), .end = end};
        product.x_stride = product.weight_stride = size.depth, product.depth = size.depth, product.n_split = 1;
        product.n_row = size.n_row, product.n_column = tile.is_gated ? size.n_column / 2 : size.n_column;
        if (tile.is_gated) product.gate_weight = product.weight + product.n_column * product.weight_stride;
        VLA_CHECK(add_maps(tile, product, jobs.emplace_back()));
      }
      const std::vector<Launch> launches = {hopper_tma_bf16(tile, jobs[0].product)};
      VLA_CHECK(tell(tile.is_gated ? "bf16 gated" : "bf16", size, tile.kernel, 1, jobs, launches));
    }
    return {};
  }
  Status add_maps(const HopperTmaTile& tile, const LinearBf16Job& product, HopperTmaJob& job) {
    job.product = product;
    VLA_CHECK(timer_.gpu().map_rows(mapped_x(tile, product), job.x));
    VLA_CHECK(timer_.gpu().map_rows(mapped_weight(tile, product, product.weight), job.weight));
    if (!tile.is_gated) return {};
    return timer_.gpu().map_rows(mapped_weight(tile, product, product.gate_weight), job.gate_weight);
  }

  Status run_hopper(const Size& size, const Buffer& x, const std::vector<Buffer>& matrices, const Buffer& partial,
                    const Epilogue& end) {
    const std::int64_t stride = round_up(size.depth, 8);
    const std::int64_t stride_of_rows = round_up(size.n_column, 2);
    VLA_TRY(const Buffer bias, timer_.upload(numbers_.floats(size.n_column)));
    VLA_TRY(const Buffer rows, timer_.gpu().allocate(bytes(2 * size.n_row * stride_of_rows), "rows of a norm"));
    VLA_TRY(const Buffer squares, timer_.gpu().allocate(bytes(4 * size.n_row * blocks(size.n_column, 64)), "squares"));
    for (const HopperTile& tile : kHopperTiles)
      for (const auto& [n_split, in_cluster] : kHopperSplits) {
        // Both matrices of a gated product, each of half of the columns, are as much work.
        if (!is_worth(size, tile.columns, tile.rows, n_split) || (tile.is_gated && size.n_column % 2 != 0)) continue;
        std::vector<LinearBf16Job> jobs;
        for (const Buffer& matrix : matrices) {
          const int n_column = tile.is_gated ? size.n_column / 2 : size.n_column;
          const auto* weight = matrix.as<std::uint16_t>();
          jobs.push_back({x.as<void>(), weight, stride, stride, size.n_row, n_column, size.depth, n_split,
                          n_split > 1 && !in_cluster ? partial.as<float>() : nullptr, end});
          if (tile.is_gated) jobs.back().gate_weight = weight + n_column * stride;
        }
        std::vector<Launch> launches = {hopper_linear_bf16(tile, jobs[0])};
        if (jobs[0].partial != nullptr) launches.push_back(finish_bf16_partial(jobs[0]));
        const std::string name = shape_name(tile.kernel, in_cluster);
        VLA_CHECK(tell(tile.is_gated ? "bf16 gated" : "bf16", size, name.c_str(), n_split, jobs, launches));
        if (tile.begins != nullptr && jobs[0].partial == nullptr) {
          for (LinearBf16Job& job : jobs)
            job.norm_begin = {.rows = rows.as<std::uint16_t>(),
                              .stride = stride_of_rows,
                              .weight = bias.as<float>(),
                              .moments = {.squares = squares.as<float>()}};
          launches = {hopper_linear_bf16(tile, jobs[0])};
          VLA_CHECK(tell("bf16, begins norm", size, name.c_str(), n_split, jobs, launches));
          for (LinearBf16Job& job : jobs) job.norm_begin = {};
        }
        if (tile.is_gated || n_split > 1 || size.n_row <= 64) continue;
        // What a vision tower's first product of an MLP ends in.
        for (LinearBf16Job& job : jobs)
          job.end.bias = bias.as<float>(), job.end.activation = Activation::gelu_tanh, job.end.is_bf16 = true;
        VLA_CHECK(tell("bf16, GELU", size, tile.kernel, n_split, jobs, launches));
      }
    return {};
  }

  Status run_codes(const char* kind, CodeKind code, const Bytes& pattern, const Size& size, const Buffer& partial,
                   const Epilogue& end) {
    const std::int64_t stride = kernels::quantized_stride(size.depth);
    VLA_TRY(const Buffer x, timer_.upload(numbers_.quantized(size.n_row, size.depth)));
    VLA_TRY(const Buffer scale, timer_.upload(numbers_.floats(size.n_column)));
    VLA_TRY(const auto matrices, fill_matrices(packed_int8_size(code, size.depth, size.n_column), pattern));
    for (const int n_split : kSplits)
      for (const auto& [name, shape] :
           {std::pair{"few", Int8Shape::few}, {"64", Int8Shape::rows64}, {"128", Int8Shape::rows128}}) {
        if (shape == Int8Shape::few && size.n_row > 16) continue;
        std::vector<LinearInt8Job> jobs;
        for (const Buffer& matrix : matrices)
          jobs.push_back({x.as<std::byte>(), matrix.as<std::byte>(), scale.as<float>(), stride, size.n_row,
                          size.n_column, static_cast<int>(kernels::quantized_depth(size.depth)), n_split,
                          partial.as<int>(), end});
        std::vector<Launch> launches = {linear_int8(code, shape, jobs[0])};
        if (n_split > 1) launches.push_back(finish_int8_partial(jobs[0]));
        VLA_CHECK(tell(kind, size, name, n_split, jobs, launches));
      }
    if (!timer_.gpu().is_hopper() || size.n_row <= 32) return {};
    for (const HopperInt8Tile& tile : kHopperInt8Tiles)
      for (const auto& [n_split, in_cluster] : kHopperSplits) {
        if (tile.kind != code || !is_worth(size, tile.columns, tile.rows, n_split)) continue;
        std::vector<LinearInt8Job> jobs;
        for (const Buffer& matrix : matrices)
          jobs.push_back({x.as<std::byte>(), matrix.as<std::byte>(), scale.as<float>(), stride, size.n_row,
                          size.n_column, static_cast<int>(kernels::quantized_depth(size.depth)), n_split,
                          n_split > 1 && !in_cluster ? partial.as<int>() : nullptr, end});
        std::vector<Launch> launches = {hopper_linear_int8(tile, jobs[0])};
        if (jobs[0].partial != nullptr) launches.push_back(finish_int8_partial(jobs[0]));
        const std::string name = shape_name(tile.kernel, in_cluster);
        VLA_CHECK(tell(kind, size, name.c_str(), n_split, jobs, launches));
      }
    return {};
  }
  static std::string shape_name(const char* kernel, bool in_cluster) {
    return std::string(kernel) + (in_cluster ? " in clusters" : "");
  }
  /// Whether SMs that would have nothing to do take part in a split, and each share has a step.
  bool is_worth(const Size& size, int columns, int rows, int n_split) {
    const auto n_sm = static_cast<unsigned>(timer_.gpu().n_sm()), before = static_cast<unsigned>(n_split - 1);
    const unsigned n_block = blocks(size.n_row, rows) * blocks(size.n_column, columns);
    return n_split == 1 || (n_block * before <= 2 * n_sm && size.depth >= n_split * 128);
  }

  /// As many matrices as no cache holds together, but no more than there are launches, of the pattern again and again.
  Result<std::vector<Buffer>> fill_matrices(std::size_t size, const Bytes& pattern) {
    const std::size_t n = std::clamp<std::size_t>(kBeyondCaches / size + 1, 1, bytes(timer_.repeats().n_launch));
    std::vector<Buffer> matrices;
    while (matrices.size() < n) {
      VLA_TRY(Buffer matrix, timer_.gpu().allocate(size, "matrices"));
      for (std::size_t at = 0; at < size; at += pattern.size())
        VLA_CHECK(timer_.stream().upload(matrix.address() + at, pattern.data(), std::min(pattern.size(), size - at)));
      matrices.push_back(std::move(matrix));
    }
    VLA_CHECK(timer_.stream().wait());
    return matrices;
  }

  template <class Job>
  Status tell(const char* kind, const Size& size, const char* shape, int n_split, const std::vector<Job>& jobs,
              const std::vector<Launch>& launches) {
    VLA_TRY(const float us, timer_.time(std::span<const Job>(jobs), launches));
    VLA_TRY(const float warm, timer_.time(std::span<const Job>(jobs).first(1), launches));
    const double flop = 2.0 * size.n_row * size.depth * size.n_column;
    fmt::print(
        R"({{"kind": "{}", "rows": {}, "depth": {}, "columns": {}, "shape": "{}", "splits": {}, "us": {:.2f}, "warm_us": {:.2f}, "tera": {:.3f}}})"
        "\n",
        kind, size.n_row, size.depth, size.n_column, shape, n_split, us, warm, 1e-6 * flop / us);
    return {};
  }

  static constexpr std::int64_t kPattern = 4 << 20;  // bytes
  LaunchTimer timer_;
  Numbers numbers_;
};

}  // namespace

int main(int n_argument, char** arguments) { return vla::test::cuda::run_bench<Bench>(kSizes, n_argument, arguments); }
