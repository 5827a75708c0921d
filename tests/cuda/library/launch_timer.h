// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "cuda/driver/gpu.h"
#include "cuda/driver/modules.h"

/// What programs that time kernels on the first GPU share.
namespace vla::test::cuda {

struct Repeats {
  int n_launch, n_time;
};

/// A GPU with a stream, and microseconds of launches one after the other.
class LaunchTimer {
 public:
  static Result<LaunchTimer> open(Repeats repeats) {
    VLA_TRY(const vla::cuda::Driver driver, vla::cuda::load_driver());
    VLA_TRY(std::unique_ptr<vla::cuda::Gpu> gpu, vla::cuda::Gpu::open(driver, 0, vla::cuda::kernel_modules()));
    VLA_TRY(vla::cuda::Stream stream, gpu->stream());
    return LaunchTimer(std::move(gpu), std::move(stream), repeats);
  }
  vla::cuda::Gpu& gpu() { return *gpu_; }
  vla::cuda::Stream& stream() { return stream_; }
  const Repeats& repeats() const { return repeats_; }

  Result<vla::cuda::Buffer> upload(std::span<const std::byte> values) {
    VLA_TRY(vla::cuda::Buffer buffer, gpu_->allocate(values.size(), "operands"));
    VLA_CHECK(stream_.upload(buffer.address(), values.data(), values.size()));
    VLA_CHECK(stream_.wait());
    return buffer;
  }

  /// Microseconds of one launch of a graph of so many, whose jobs take turns: the median of several graphs' launches.
  template <class Job>
  Result<float> time(std::span<const Job> jobs, std::span<const vla::cuda::Launch> launches) {
    for (const vla::cuda::Launch& launch : launches) VLA_CHECK(gpu_->prepare(launch));
    return time_graph([&](int i) -> Status {
      for (const vla::cuda::Launch& launch : launches)
        VLA_CHECK(stream_.launch(launch, jobs[static_cast<std::size_t>(i) % jobs.size()]));
      return {};
    });
  }
  /// The same of launches with a job each.
  struct JobLaunch {
    vla::cuda::Launch how;
    const void* job;
  };
  Result<float> time(std::span<const JobLaunch> launches) {
    for (const JobLaunch& launch : launches) VLA_CHECK(gpu_->prepare(launch.how));
    return time_graph([&](int) -> Status {
      for (const JobLaunch& launch : launches) VLA_CHECK(stream_.launch_job(launch.how, launch.job));
      return {};
    });
  }

 private:
  template <class LaunchAll>
  Result<float> time_graph(LaunchAll launch_all) {
    VLA_TRY(const vla::cuda::Owned first, gpu_->event(true));
    VLA_TRY(const vla::cuda::Owned last, gpu_->event(true));
    VLA_CHECK(stream_.begin_capture());
    VLA_CHECK(stream_.note_time(first));
    for (int i = 0; i < repeats_.n_launch; ++i) VLA_CHECK(launch_all(i));
    VLA_CHECK(stream_.note_time(last));
    VLA_TRY(const vla::cuda::Owned graph, stream_.end_capture());
    std::vector<float> times;
    for (int i = 0; i <= repeats_.n_time; ++i) {
      VLA_CHECK(stream_.launch(graph));
      VLA_CHECK(stream_.wait());
      VLA_TRY(const float ms, gpu_->elapsed(first, last));
      if (i > 0) times.push_back(1e3f * ms / static_cast<float>(repeats_.n_launch));  // the first one warms it up
    }
    std::sort(times.begin(), times.end());
    return times[times.size() / 2];
  }

  LaunchTimer(std::unique_ptr<vla::cuda::Gpu> gpu, vla::cuda::Stream stream, Repeats repeats)
      : gpu_(std::move(gpu)), stream_(std::move(stream)), repeats_(repeats) {}

  std::unique_ptr<vla::cuda::Gpu> gpu_;
  vla::cuda::Stream stream_;
  Repeats repeats_;
};

/// The program NAME [SIZES [LAUNCHES [TIMES]]]: Bench::run of the first sizes, all without it; launches of a graph,
/// else 20; how often it is timed, else 5. Returns its exit code.
template <class Bench, class Size, std::size_t kN>
int run_bench(const Size (&sizes)[kN], int n_argument, char** arguments) {
  const auto number = [&](int i, int otherwise, int most) {
    return n_argument > i ? std::clamp(std::atoi(arguments[i]), 1, most) : otherwise;
  };
  constexpr int kAll = static_cast<int>(kN);
  const int n_size = number(1, kAll, kAll);
  const auto run = [&]() -> Status {
    VLA_TRY(LaunchTimer timer, LaunchTimer::open({number(2, 20, 1000), number(3, 5, 1000)}));
    Bench bench(std::move(timer));
    for (int i = 0; i < n_size; ++i) VLA_CHECK(bench.run(sizes[i]));
    return {};
  };
  const Status status = run();
  if (!status) fmt::print(stderr, "error: {}\n", status.error().message());
  return status ? 0 : 1;
}

}  // namespace vla::test::cuda
