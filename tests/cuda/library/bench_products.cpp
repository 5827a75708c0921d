// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// Times products in every shape of blocks and split of the depth on the first GPU, one JSON object a line. Run by
// scripts/measure_gpu.sh. On the driver of tests the times say nothing.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <utility>

#include "cuda/driver/gpu.h"
#include "cuda/driver/modules.h"
#include "cuda/kernels/linear_bf16.h"
#include "cuda/kernels/linear_int8.h"
#include "kernels/quantized.h"

namespace {

using namespace vla;
using namespace vla::cuda;

struct Size {
  int n_row, depth, n_column;
};
// Of steps of a few rows, of action experts, of language models and of vision towers.
constexpr Size kSizes[] = {{1, 2048, 2048},   {4, 960, 2560},    {50, 720, 2048},   {50, 1024, 4096},
                           {113, 960, 2560},  {642, 2560, 2560}, {642, 2560, 6912}, {642, 6912, 2560},
                           {512, 1152, 4304}, {968, 2048, 16384}};
constexpr int kSplits[] = {1, 2, 4, 8};

/// Microseconds of one of a graph of so many launches.
template <class Job>
Result<float> time_launches(Gpu& gpu, Stream& stream, const Job& job, const std::vector<Launch>& launches,
                            int n_launch) {
  VLA_TRY(const Owned first, gpu.event(true));
  VLA_TRY(const Owned last, gpu.event(true));
  VLA_CHECK(stream.begin_capture());
  VLA_CHECK(stream.note_time(first));
  for (int i = 0; i < n_launch; ++i)
    for (const Launch& launch : launches) VLA_CHECK(stream.launch(launch, job));
  VLA_CHECK(stream.note_time(last));
  VLA_TRY(const Owned graph, stream.end_capture());
  for (int i = 0; i < 2; ++i) VLA_CHECK(stream.launch(graph));  // the first one warms it up
  VLA_CHECK(stream.wait());
  VLA_TRY(const float ms, gpu.elapsed(first, last));
  return 1e3f * ms / static_cast<float>(n_launch);
}

void tell(const char* kind, const Size& size, const char* shape, int n_split, float us) {
  const double flop = 2.0 * size.n_row * size.depth * size.n_column;
  fmt::print(
      R"({{"kind": "{}", "rows": {}, "depth": {}, "columns": {}, "shape": "{}", "splits": {}, "us": {:.2f}, "tera": {:.3f}}})"
      "\n",
      kind, size.n_row, size.depth, size.n_column, shape, n_split, us, 1e-6 * flop / us);
}

Status run(int n_size, int n_launch) {
  VLA_TRY(const Driver driver, load_driver());
  VLA_TRY(const std::unique_ptr<Gpu> gpu, Gpu::open(driver, 0, kernel_modules()));
  VLA_TRY(Stream stream, gpu->stream());
  for (int i = 0; i < n_size; ++i) {
    const Size& size = kSizes[i];
    const std::int64_t rows = size.n_row, columns = size.n_column, depth = size.depth;
    const std::int64_t x_stride = kernels::quantized_stride(depth);
    const auto bytes = [](std::int64_t n) { return static_cast<std::size_t>(n); };
    VLA_TRY(const Buffer x, gpu->allocate(bytes(4 * rows * std::max(x_stride, depth)), "x"));
    VLA_TRY(const Buffer weight, gpu->allocate(bytes(2 * columns * round_up(depth, 64) + (1 << 20)), "weight"));
    VLA_TRY(const Buffer scale, gpu->allocate(bytes(4 * columns), "scales"));
    VLA_TRY(const Buffer partial, gpu->allocate(bytes(4 * 8 * rows * columns), "partial sums"));
    VLA_TRY(const Buffer y, gpu->allocate(bytes(4 * rows * columns), "y"));
    for (const Buffer* buffer : {&x, &weight, &scale}) VLA_CHECK(stream.fill(buffer->address(), 0, buffer->size()));
    Epilogue end = {};
    end.y = y.as<void>(), end.y_stride = columns;
    for (const int n_split : kSplits) {
      const LinearBf16Job bf16 = {x.as<void>(),        weight.as<std::uint16_t>(),
                                  round_up(depth, 8),  round_up(depth, 8),
                                  size.n_row,          size.n_column,
                                  size.depth,          n_split,
                                  partial.as<float>(), end};
      for (const auto& [name, shape] :
           {std::pair{"few", Bf16Shape::few}, {"64", Bf16Shape::rows64}, {"128", Bf16Shape::rows128}}) {
        if (shape == Bf16Shape::few && size.n_row > 4 * kBf16FewRows) continue;
        std::vector<Launch> launches = {linear_bf16(shape, bf16)};
        if (n_split > 1) launches.push_back(finish_bf16_partial(bf16));
        VLA_TRY(const float us, time_launches(*gpu, stream, bf16, launches, n_launch));
        tell("bf16", size, name, n_split, us);
      }
      const LinearInt8Job codes = {x.as<std::byte>(),
                                   weight.as<std::byte>(),
                                   scale.as<float>(),
                                   x_stride,
                                   size.n_row,
                                   size.n_column,
                                   static_cast<int>(kernels::quantized_depth(depth)),
                                   n_split,
                                   partial.as<int>(),
                                   end};
      for (const auto& [kind, code] : {std::pair{"ternary", CodeKind::ternary}, {"int8", CodeKind::int8}})
        for (const auto& [name, shape] :
             {std::pair{"few", Int8Shape::few}, {"64", Int8Shape::rows64}, {"128", Int8Shape::rows128}}) {
          if (shape == Int8Shape::few && size.n_row > 16) continue;
          std::vector<Launch> launches = {linear_int8(code, shape, codes)};
          if (n_split > 1) launches.push_back(finish_int8_partial(codes));
          VLA_TRY(const float us, time_launches(*gpu, stream, codes, launches, n_launch));
          tell(kind, size, name, n_split, us);
        }
    }
  }
  return {};
}

}  // namespace

/// bench_products [N [LAUNCHES]]: the first N sizes, all without it; so many launches for each time, else 20.
int main(int n_argument, char** arguments) {
  constexpr int kMost = static_cast<int>(std::size(kSizes));
  const int n_size = n_argument > 1 ? std::clamp(std::atoi(arguments[1]), 1, kMost) : kMost;
  const int n_launch = n_argument > 2 ? std::clamp(std::atoi(arguments[2]), 1, 1000) : 20;
  const Status status = run(n_size, n_launch);
  if (!status) fmt::print(stderr, "error: {}\n", status.error().message());
  return status ? 0 : 1;
}
