// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/probe/probe.h"

#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <barrier>
#include <chrono>
#include <cstdint>
#include <functional>
#include <thread>

namespace vla::kernels {
namespace {

using Clock = std::chrono::steady_clock;

double seconds_between(Clock::time_point begin, Clock::time_point end) {
  return std::chrono::duration<double>(end - begin).count();
}

/// Runs `work(thread)` on all threads at once, repeatedly for about `seconds`. Returns the shortest time from the first
/// thread's start to the last one's end.
double shortest_burst(int n_thread, double seconds, const std::function<void(int)>& work) {
  struct Span {
    Clock::time_point begin, end;
  };
  std::vector<Span> spans(static_cast<std::size_t>(n_thread));
  std::barrier together(n_thread);
  std::atomic<bool> again = true;
  double shortest = 0;
  const Clock::time_point start = Clock::now();
  const auto judge = [&] {  // runs on thread 0 while the other threads wait
    auto begin = spans[0].begin, end = spans[0].end;
    for (const Span& span : spans) begin = std::min(begin, span.begin), end = std::max(end, span.end);
    const double time = seconds_between(begin, end);
    shortest = shortest == 0 ? time : std::min(shortest, time);
    again = seconds_between(start, end) < seconds;
  };
  const auto thread_loop = [&](int thread) {
    while (again) {
      together.arrive_and_wait();
      Span& span = spans[static_cast<std::size_t>(thread)];
      span.begin = Clock::now();
      work(thread);
      span.end = Clock::now();
      together.arrive_and_wait();
      if (thread == 0) judge();
      together.arrive_and_wait();
    }
  };
  std::vector<std::thread> others;
  for (int thread = 1; thread < n_thread; ++thread) others.emplace_back(thread_loop, thread);
  thread_loop(0);
  for (std::thread& other : others) other.join();
  return shortest;
}

/// The number of rounds that take about a millisecond: much longer than the clock's resolution, short enough that most
/// bursts are not interrupted.
long rounds_of_a_burst(const PeakProbe& probe) {
  constexpr double kBurst = 1e-3;
  for (long n = 1024;; n *= 2) {
    const Clock::time_point start = Clock::now();
    probe.run(n);
    const double time = seconds_between(start, Clock::now());
    if (time > kBurst / 4) return std::max(1L, static_cast<long>(static_cast<double>(n) * kBurst / time));
  }
}

/// Temporary memory, in huge pages if the system has them.
class Memory {
 public:
  explicit Memory(std::size_t size) : size_(size) {
    void* got = ::mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (got == MAP_FAILED) return;
    data_ = static_cast<std::uint64_t*>(got);
    ::madvise(got, size, MADV_HUGEPAGE);
  }
  ~Memory() {
    if (data_ != nullptr) ::munmap(data_, size_);
  }
  Memory(const Memory&) = delete;
  Memory& operator=(const Memory&) = delete;
  std::uint64_t* data() const { return data_; }

 private:
  std::size_t size_;
  std::uint64_t* data_ = nullptr;
};

std::size_t beyond_caches() {
  const long last_cache = ::sysconf(_SC_LEVEL3_CACHE_SIZE);  // 0 or less if unknown
  return std::clamp<std::size_t>(4 * static_cast<std::size_t>(std::max(0L, last_cache)), std::size_t{256} << 20,
                                 std::size_t{1} << 30);
}

std::uint64_t sum(const std::uint64_t* data, std::size_t count) {
  std::uint64_t parts[8] = {};  // independent sums, so that no addition waits for another
  for (std::size_t i = 0; i + 8 <= count; i += 8)
    for (std::size_t j = 0; j < 8; ++j) parts[j] += data[i + j];
  std::uint64_t all = 0;
  for (std::uint64_t part : parts) all += part;
  return all;
}

}  // namespace

double measure_peak(const PeakProbe& probe, int n_thread, double seconds) {
  const long n_round = rounds_of_a_burst(probe);
  const double time = shortest_burst(n_thread, seconds, [&](int) { probe.run(n_round); });
  return static_cast<double>(n_thread) * static_cast<double>(n_round) * probe.op_per_round / time;
}

double measure_read_bandwidth(int n_thread, double seconds) {
  const std::size_t n_part = beyond_caches() / sizeof(std::uint64_t) / static_cast<std::size_t>(n_thread);
  const std::size_t bytes = n_part * static_cast<std::size_t>(n_thread) * sizeof(std::uint64_t);
  const Memory memory(bytes);
  if (memory.data() == nullptr) return 0;
  std::atomic<std::uint64_t> sink = 0;
  const auto part = [&](int thread) { return memory.data() + static_cast<std::size_t>(thread) * n_part; };
  // each thread faults in its own part
  shortest_burst(n_thread, 0, [&](int thread) { std::fill_n(part(thread), n_part, 1); });
  const double time = shortest_burst(n_thread, seconds, [&](int thread) { sink += sum(part(thread), n_part); });
  return static_cast<double>(bytes) / time;
}

}  // namespace vla::kernels
