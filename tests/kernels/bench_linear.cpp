// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// How fast each row of the matrix product is on this machine, as a share of the multiply-add peak that is measured
// beside it; of products of ternary, int4 and int8 weights also how much faster than the kernel of bf16 weights that
// takes turns with them, and of int4 ones than that of int8. Not a test: what it prints depends on what else the
// machine does.
//
//   bench_linear [threads] [rounds] [kernel]
#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <ctime>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "kernels/executor.h"
#include "kernels/int8_kernels.h"
#include "kernels/linear_kernel.h"
#include "kernels/linear_panels.h"
#include "kernels/pages.h"
#include "kernels/probe/probe.h"
#include "kernels/quantized.h"

using namespace vla;
using namespace vla::kernels;

namespace {

struct Shape {
  std::int64_t n_row, d_in, d_out;
};

constexpr Shape kShapes[] = {{1024, 768, 768},   {1024, 768, 3072}, {1024, 3072, 768}, {177, 960, 2560},
                             {177, 2560, 960},   {50, 720, 2048},   {50, 2048, 720},   {256, 1152, 4304},
                             {560, 2048, 16384}, {1, 2048, 16384}};

/// Of BitVLA's language model and tower.
constexpr Shape kInt8Shapes[] = {{640, 2560, 2560}, {300, 2560, 6912}, {640, 2560, 6912}, {640, 6912, 2560},
                                 {640, 2560, 640},  {512, 1152, 1152}, {512, 1152, 4304}, {512, 4304, 1152},
                                 {1, 2560, 6912},   {16, 2560, 6912},  {1, 4096, 16384},  {16, 4096, 16384},
                                 {50, 4096, 16384}};

/// Memory at a multiple of a page.
struct Block {
  explicit Block(std::size_t size)
      : data(static_cast<std::byte*>(std::aligned_alloc(4096, (size + 4095) / 4096 * 4096))), n(size) {
    want_large_pages(data, n);
  }
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

/// Seconds of the fastest of the runs in about `seconds`, behind one that may touch memory for the first time.
double best_time(Executor& executor, const Product& product, double seconds) {
  const Phase phase = {{&product}, nullptr};
  executor.run(std::span(&phase, 1));
  double best = 1e9;
  const double start = now(executor.n_thread());
  do {
    const double before = now(executor.n_thread());
    executor.run(std::span(&phase, 1));
    best = std::min(best, now(executor.n_thread()) - before);
  } while (now(executor.n_thread()) - start < seconds);
  return best;
}

/// A product of random numbers with all that it reads and writes.
struct Trial {
  Trial(const LinearKernel& kernel, const MatrixDesc& d, std::int64_t n_row, int n_thread, bool rounded)
      : desc(d),
        s{n_row, d.d_in, d.d_out},
        x(static_cast<std::size_t>(quantized_size(round_up(s.n_row, kTileSide), s.d_in)) * 4),
        y(static_cast<std::size_t>(round_up(s.n_row, kTileSide) * round_up(s.d_out, kTileSide)) * 4),
        stored(Encoding{d.type, s.d_in}.size(s.d_in * s.d_out)),
        packed(kernel.packed_size(desc)),
        scale(static_cast<std::size_t>(s.d_out), 1.0f) {
    LinearJob job = {};
    std::vector<float> row(static_cast<std::size_t>(s.d_in));
    for (std::size_t k = 0; k < row.size(); ++k) row[k] = 1.0f / static_cast<float>(1 + k % 61);
    job.x = x.data, job.x_type = kernel.quantize != nullptr ? DType::i8 : DType::f32;
    if (rounded) job.x_type = DType::bf16, job.activation = Activation::gelu_tanh;
    job.x_stride = kernel.quantize != nullptr ? quantized_stride(s.d_in) : s.d_in;
    for (std::int64_t r = 0; r < s.n_row; ++r)
      if (kernel.quantize != nullptr)
        kernel.quantize(row.data(), s.d_in, x.data + r * job.x_stride);
      else
        std::memcpy(x.data + 4 * r * s.d_in, row.data(), row.size() * sizeof(float));
    for (std::size_t i = 0; i + 1 < stored.n; i += 2) {
      const std::uint16_t bits =
          kernel.quantize != nullptr ? 0x2412 : to_bf16(1.0f / static_cast<float>(1 + i / 2 % 63));
      std::memcpy(stored.data + i, &bits, sizeof(bits));
    }
    const auto start = std::chrono::steady_clock::now();
    kernel.pack(desc, stored.data, packed.data);
    pack_seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    job.n_row = s.n_row, job.d_in = s.d_in, job.n_part = 1;
    job.part[0] = {desc.type, packed.data, nullptr, nullptr, nullptr, y.data, s.d_out, scale.data()};
    if (rounded) job.part[0].y_type = DType::bf16;
    product.emplace(kernel, job, n_thread);
  }
  MatrixDesc desc;
  Shape s;
  Block x, y, stored, packed;
  std::vector<float> scale;
  double pack_seconds;
  std::optional<Product> product;
};

double median(std::vector<double> values) {
  std::sort(values.begin(), values.end());
  return values[values.size() / 2];
}

/// A kernel that takes turns with the one that is measured, and its weights.
struct Rival {
  const LinearKernel* kernel;
  DType weights;
};

/// `rounded`: x and y lie as this kernel's products leave them for each other, and y has a GELU; else they are float32
/// rows.
void measure(Executor& executor, const LinearKernel& kernel, const PeakProbe& probe, const MatrixDesc& desc,
             std::int64_t n_row, int n_round, bool rounded, const std::vector<Rival>& rivals) {
  const int n_thread = executor.n_thread();
  const Trial trial(kernel, desc, n_row, n_thread, rounded);
  const Shape& s = trial.s;
  std::vector<std::unique_ptr<Trial>> others;
  for (const Rival& rival : rivals)
    others.push_back(
        std::make_unique<Trial>(*rival.kernel, MatrixDesc{rival.weights, s.d_in, s.d_out}, s.n_row, n_thread, false));
  const double flop = 2.0 * static_cast<double>(s.n_row * s.d_in * s.d_out);
  std::vector<double> rates, peaks, shares;
  std::vector<std::vector<double>> factors(rivals.size());
  for (int i = 0; i < n_round; ++i) {  // alternating, since the machine's speed may change for seconds at a time
    peaks.push_back(measure_peak(probe, n_thread, 0.02));
    rates.push_back(flop / best_time(executor, *trial.product, 0.05));
    shares.push_back(rates.back() / peaks.back());
    for (std::size_t j = 0; j < others.size(); ++j)
      factors[j].push_back(rates.back() / flop * best_time(executor, *others[j]->product, 0.05));
  }
  const double best = *std::max_element(rates.begin(), rates.end()),
               peak = *std::max_element(peaks.begin(), peaks.end());
  fmt::print("{:12} {:7} {:5} x {:5} x {:5}  {:8.1f} G/s  {:5.1f} % of {:8.1f}  median {:5.1f} %  reads {:6.1f} GB/s",
             kernel.name, dtype_name(desc.type), s.n_row, s.d_in, s.d_out, best * 1e-9, 100 * best / peak, peak * 1e-9,
             100 * median(shares), best / flop * static_cast<double>(trial.stored.n) * 1e-9);
  fmt::print("  packed at {:.1f} GB/s", static_cast<double>(trial.stored.n) / trial.pack_seconds * 1e-9);
  if (rounded) fmt::print("  rounded, GELU");
  for (std::size_t j = 0; j < rivals.size(); ++j)
    fmt::print("  {:.2f} x {} {}", median(factors[j]), rivals[j].kernel->name, dtype_name(rivals[j].weights));
  fmt::print("\n");
  std::fflush(stdout);
}

/// An int8 kernel's loop on registers has its name: `avx2_int8` and `avx2 int8`.
const PeakProbe* probe_of(const LinearKernel& kernel) {
  std::string name = kernel.name;
  std::replace(name.begin(), name.end(), '_', ' ');
  for (const PeakProbe& probe : peak_probes())
    if (probe.name == name) return &probe;
  return nullptr;
}

}  // namespace

int main(int argc, char** argv) {
  const int n_thread = argc > 1 ? std::atoi(argv[1]) : 1, n_round = argc > 2 ? std::atoi(argv[2]) : 7;
  if (n_thread < 1 || n_round < 1) return fmt::print("usage: bench_linear [threads] [rounds] [kernel]\n"), 1;
  fmt::print("{} thread(s), best and median of {} rounds, bf16, ternary, int4 or int8 weights\n", n_thread, n_round);
  const auto executor = Executor::shared(n_thread);
  if (!executor) return fmt::print("{}\n", executor.error().message()), 1;
  const auto wants = [&](const LinearKernel& kernel) { return argc < 4 || kernel.name == std::string(argv[3]); };
  for (const LinearKernel* kernel : linear_kernels()) {
    if (!(*executor)->reserve(kernel->scratch_size).ok()) return 1;
    for (const KernelSet& set : usable_kernels())
      if (name_of(set) == kernel->name && wants(*kernel))
        for (const Shape& shape : kShapes)
          for (const bool rounded : {false, true}) {
            if (rounded && kernel->y_layout(shape.d_in) == RoundedLayout::none) continue;
            measure(**executor, *kernel, peak_probe_of(set.uses), {DType::bf16, shape.d_in, shape.d_out}, shape.n_row,
                    n_round, rounded, {});
          }
  }
  const std::pair<DType, std::span<const LinearKernel* const>> int8[] = {
      {DType::ternary, ternary_kernels()}, {DType::int4, int4_kernels()}, {DType::i8, int8_kernels()}};
  for (const auto& [weights, kernels] : int8)
    for (const LinearKernel* kernel : kernels) {
      const PeakProbe* probe = probe_of(*kernel);
      if (probe == nullptr || !wants(*kernel)) continue;
      std::vector<Rival> rivals = {{choose_linear({DType::bf16, 64, 64}, this_cpu()), DType::bf16}};
      for (const LinearKernel* other : int8_kernels())
        if (weights == DType::int4 && other->name == std::string(kernel->name)) rivals.push_back({other, DType::i8});
      if (!(*executor)->reserve(kernel->scratch_size).ok()) return 1;
      for (const Shape& shape : kInt8Shapes)
        measure(**executor, *kernel, *probe, {weights, shape.d_in, shape.d_out}, shape.n_row, n_round, false, rivals);
    }
}
