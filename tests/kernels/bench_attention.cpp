// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What attention's two operations take on one thread of this machine, for each kernel that it can run: microseconds of
// the thread's own time, the best of several runs. Not a test: what it prints depends on what else the machine does.
//
//   bench_attention [seconds for each shape] [kernel]
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <memory>
#include <vector>

#include "kernels/cpu_kernels.h"

using namespace vla;
using namespace vla::kernels;

namespace {

struct Shape {
  const char* what;
  std::int64_t d_head, n_head, n_head_kv, n_query, n_key;
};

constexpr Shape kShapes[] = {{"tower", 64, 2, 2, 1024, 1024},
                             {"prefix", 64, 15, 5, 177, 177},
                             {"step", 64, 15, 5, 50, 227},
                             {"wide heads", 256, 8, 1, 51, 867}};

double now() {
  timespec time;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

template <class Work>
double best_time(double seconds, Work work) {
  double best = 1e9;
  const double start = now();
  do {
    const double before = now();
    work();
    best = std::min(best, now() - before);
  } while (now() - start < seconds);
  return best;
}

struct Memory {
  explicit Memory(std::size_t size)
      : data(static_cast<std::byte*>(std::aligned_alloc(64, (size + 63) / 64 * 64)), std::free) {}
  std::unique_ptr<std::byte, decltype(&std::free)> data;
};

void measure(const AttentionKernel& kernel, const std::string& name, const Shape& s, double seconds) {
  const auto numbers = [](std::int64_t n) {
    std::vector<float> x(static_cast<std::size_t>(n));
    for (std::size_t i = 0; i < x.size(); ++i) x[i] = std::sin(static_cast<float>(i * i % 7919));
    return x;
  };
  const std::vector<float> q = numbers(s.d_head * s.n_head * s.n_query);
  const std::vector<float> k = numbers(s.d_head * s.n_head_kv * s.n_key), v = numbers(s.d_head * s.n_head_kv * s.n_key);
  const auto rows = [&](const std::vector<float>& x, std::int64_t n_head) {
    return HeadRows{reinterpret_cast<const std::byte*>(x.data()), 0, s.d_head, s.d_head * n_head, 0};
  };
  PackJob keys = {s.d_head, s.n_head_kv, s.n_key, 1, rows(k, s.n_head_kv), rows(v, s.n_head_kv), {}, nullptr};
  const Memory packed(kernel.packed_size(keys));
  std::vector<float> out(q.size());
  keys.packed = packed.data.get();
  AttentionJob job = {};
  job.d_head = s.d_head, job.n_head = s.n_head, job.n_head_kv = s.n_head_kv;
  job.n_query = s.n_query, job.n_key = s.n_key, job.n_batch = 1;
  job.scale = 1 / std::sqrt(static_cast<float>(s.d_head));
  job.q = rows(q, s.n_head), job.out = reinterpret_cast<std::byte*>(out.data());
  job.n_segment = 1, job.segment[0] = {keys.packed, s.n_key};
  const std::int64_t n_item = kernel.cut(job, 1);
  const double pack = best_time(seconds / 4, [&] {
    for (std::int64_t i = 0; i < kernel.n_pack(keys); ++i) kernel.pack(keys, i);
  });
  const double run = best_time(seconds, [&] {
    for (std::int64_t i = 0; i < n_item; ++i) kernel.run(job, i);
  });
  const double flop = 4.0 * static_cast<double>(s.d_head * s.n_head * s.n_query * s.n_key);
  fmt::print("{:8} {:12} pack {:8.1f} us  run {:9.1f} us  {:7.1f} GFLOP/s\n", name, s.what, 1e6 * pack, 1e6 * run,
             1e-9 * flop / run);
  std::fflush(stdout);
}

}  // namespace

int main(int argc, char** argv) {
  const double seconds = argc > 1 ? std::atof(argv[1]) : 0.2;
  for (const KernelSet& set : usable_kernels())
    if (const CpuKernels* kernels = cpu_kernels(this_cpu().both(set.uses));
        kernels != nullptr && (argc < 3 || name_of(set) == std::string(argv[2])))
      for (const Shape& shape : kShapes) measure(kernels->attention, name_of(set), shape, seconds);
}
