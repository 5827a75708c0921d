// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How fast each row of the matrix product is on this machine, as a share of the multiply-add peak that is measured
// beside it. Not a test: what it prints depends on what else the machine does.
//
//   bench_linear [threads] [rounds] [kernel]
#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <ctime>
#include <memory>

#include "kernels/executor.h"
#include "kernels/linear_kernel.h"
#include "kernels/linear_panels.h"
#include "kernels/probe/probe.h"

using namespace vla;
using namespace vla::kernels;

namespace {

struct Shape {
  std::int64_t n_row, d_in, d_out;
};

constexpr Shape kShapes[] = {{1024, 768, 768},   {1024, 768, 3072}, {1024, 3072, 768}, {177, 960, 2560},
                             {177, 2560, 960},   {50, 720, 2048},   {50, 2048, 720},   {256, 1152, 4304},
                             {560, 2048, 16384}, {1, 2048, 16384}};

/// Memory at a multiple of a page, filled with numbers near 1 in bf16 or float32 as it is read.
struct Block {
  explicit Block(std::size_t size)
      : data(static_cast<std::byte*>(std::aligned_alloc(4096, (size + 4095) / 4096 * 4096))), n(size) {}
  ~Block() { std::free(data); }
  Block(const Block&) = delete;
  Block& operator=(const Block&) = delete;
  std::byte* data;
  std::size_t n;
};

/// What a run took: one thread's own time, which other programs hardly change, or the wall's for several side by side.
double now(int n_thread) {
  timespec time;
  clock_gettime(n_thread == 1 ? CLOCK_THREAD_CPUTIME_ID : CLOCK_MONOTONIC, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

/// A product for the executor.
struct Product final : Task {
  Product(const LinearKernel& k, LinearJob j, int n_thread) : kernel(k), job(j) { n_item = kernel.cut(job, n_thread); }
  void run(std::int64_t item, Worker& worker) const override { kernel.run(job, item, worker); }
  const LinearKernel& kernel;
  LinearJob job;
};

/// Seconds of the fastest of the runs in about `seconds`.
double best_time(Executor& executor, const Product& product, double seconds) {
  const Phase phase = {{&product}, nullptr};
  double best = 1e9;
  const double start = now(executor.n_thread());
  do {
    const double before = now(executor.n_thread());
    executor.run(std::span(&phase, 1));
    best = std::min(best, now(executor.n_thread()) - before);
  } while (now(executor.n_thread()) - start < seconds);
  return best;
}

void measure(Executor& executor, const LinearKernel& kernel, Isa isa, const Shape& s, int n_round) {
  const int n_thread = executor.n_thread();
  const MatrixDesc desc = {DType::bf16, s.d_in, s.d_out};
  Block x(static_cast<std::size_t>(s.n_row * s.d_in) * 4), y(static_cast<std::size_t>(s.n_row * s.d_out) * 4);
  Block stored(static_cast<std::size_t>(s.d_in * s.d_out) * 2);
  for (std::size_t i = 0; i < stored.n; i += 2)
    reinterpret_cast<std::uint16_t*>(stored.data)[i / 2] = to_bf16(1.0f / static_cast<float>(1 + i % 63));
  for (std::size_t i = 0; i < x.n; i += 4)
    reinterpret_cast<float*>(x.data)[i / 4] = 1.0f / static_cast<float>(1 + i % 61);
  Block packed(kernel.packed_size(desc));
  const auto start = std::chrono::steady_clock::now();
  kernel.pack(desc, stored.data, packed.data);
  const double pack_seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  LinearJob job = {};
  job.x = x.data, job.x_stride = s.d_in, job.n_row = s.n_row, job.d_in = s.d_in, job.n_part = 1;
  job.part[0] = {DType::bf16, packed.data, nullptr, nullptr, nullptr, y.data, s.d_out};
  const Product product(kernel, job, n_thread);
  const double flop = 2.0 * static_cast<double>(s.n_row * s.d_in * s.d_out);
  std::vector<double> rates, peaks, shares;
  for (int i = 0; i < n_round; ++i) {  // alternating, since the machine's speed may change for seconds at a time
    peaks.push_back(measure_peak(peak_probe_of(isa), n_thread, 0.02));
    rates.push_back(flop / best_time(executor, product, 0.05));
    shares.push_back(rates.back() / peaks.back());
  }
  std::sort(shares.begin(), shares.end());
  const double best = *std::max_element(rates.begin(), rates.end()),
               peak = *std::max_element(peaks.begin(), peaks.end());
  fmt::print("{:8} {:5} x {:5} x {:5}  {:8.1f} GFLOP/s  {:5.1f} % of {:8.1f}  median {:5.1f} %  reads {:6.1f} GB/s",
             kernel.name, s.n_row, s.d_in, s.d_out, best * 1e-9, 100 * best / peak, peak * 1e-9,
             100 * shares[shares.size() / 2], best / flop * static_cast<double>(stored.n) * 1e-9);
  fmt::print("  packed at {:.1f} GB/s\n", static_cast<double>(stored.n) / pack_seconds * 1e-9);
  std::fflush(stdout);
}

}  // namespace

int main(int argc, char** argv) {
  const int n_thread = argc > 1 ? std::atoi(argv[1]) : 1, n_round = argc > 2 ? std::atoi(argv[2]) : 7;
  if (n_thread < 1 || n_round < 1) return fmt::print("usage: bench_linear [threads] [rounds] [kernel]\n"), 1;
  fmt::print("{} thread(s), best and median of {} rounds, bf16 weights\n", n_thread, n_round);
  const auto executor = Executor::shared(n_thread);
  if (!executor) return fmt::print("{}\n", executor.error().message()), 1;
  for (const LinearKernel* kernel : linear_kernels()) {
    if (!(*executor)->reserve(kernel->scratch_size).ok()) return 1;
    for (Isa isa : usable_isas())
      if (isa_name(isa) == kernel->name && (argc < 4 || kernel->name == std::string(argv[3])))
        for (const Shape& shape : kShapes) measure(**executor, *kernel, isa, shape, n_round);
  }
}
