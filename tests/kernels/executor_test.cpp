// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "support/executor.h"

#include <atomic>
#include <ctime>
#include <set>
#include <thread>

namespace executor_test {

using namespace vla;
using namespace vla::test;
using kernels::Executor;
using kernels::Phase;
using kernels::Worker;

namespace {

std::shared_ptr<Executor> open(int n_thread) {
  auto executor = Executor::shared(n_thread);
  REQUIRE(executor.ok());
  return std::move(*executor);
}

void sleep_ms(int n) { std::this_thread::sleep_for(std::chrono::milliseconds(n)); }

/// Phases whose items add to the sum of the phase before: what an item of a later phase reads is complete, or the sums
/// are wrong. Plain numbers, so that the thread sanitizer sees an order that is missing.
struct Chain {
  std::vector<std::vector<std::int64_t>> values;  // of each phase and item
  std::vector<std::unique_ptr<FunctionTask>> tasks;
  std::vector<Phase> phases;

  explicit Chain(const std::vector<std::int64_t>& n_item) {
    values.reserve(n_item.size());
    for (std::size_t p = 0; p < n_item.size(); ++p) {
      values.emplace_back(static_cast<std::size_t>(n_item[p]));
      // Two tasks of a phase, where it has as many items.
      const std::int64_t first = n_item[p] / 3;
      Phase& phase = phases.emplace_back();
      for (const auto& [offset, n] : {std::pair(std::int64_t{0}, first), std::pair(first, n_item[p] - first)}) {
        if (n == 0) continue;
        tasks.push_back(std::make_unique<FunctionTask>(
            n, [this, p, offset = offset](std::int64_t item, Worker&) { step(p, offset + item); }));
        phase.tasks.push_back(tasks.back().get());
      }
    }
  }
  void step(std::size_t p, std::int64_t item) {
    std::int64_t sum = 1;
    if (p > 0)
      for (const std::int64_t value : values[p - 1]) sum += value;
    values[p][static_cast<std::size_t>(item)] += sum % 1009;
  }
};

std::vector<std::int64_t> many_phases() {
  std::vector<std::int64_t> n_item;
  for (int i = 0; i < 2000; ++i) n_item.push_back(i % 5 == 0 ? 1 : 1 + i * 7 % 23);
  return n_item;
}

}  // namespace

TEST_CASE("every item runs once and phases follow each other, however many threads there are") {
  Chain expected(many_phases());
  open(1)->run(expected.phases);
  for (const int n_thread : {1, 2, 3, 8}) {
    CAPTURE(n_thread);
    Chain chain(many_phases());
    open(n_thread)->run(chain.phases);
    CHECK(chain.values == expected.values);
  }
}

TEST_CASE("the end of a phase is noted where somebody asks for it") {
  for (const int n_thread : {1, 3}) {
    std::chrono::steady_clock::time_point first, last;
    const FunctionTask quick(4, [](std::int64_t, Worker&) {}), slow(2, [](std::int64_t, Worker&) { sleep_ms(2); });
    const Phase phases[] = {{{&quick}, &first}, {{&slow, &quick}, &last}};
    open(n_thread)->run(phases);
    CHECK(last - first >= std::chrono::milliseconds(2));
  }
}

TEST_CASE("runs of several threads take turns") {
  const auto executor = open(2);
  std::atomic<int> inside = 0;
  std::atomic<bool> met = false;
  const auto run = [&] {
    // The items of a phase belong to one run: two at a time, and never three.
    const FunctionTask task(5, [&](std::int64_t, Worker&) {
      if (++inside > 2) met = true;
      --inside;
    });
    const Phase phase = {{&task}, nullptr};
    for (int i = 0; i < 200; ++i) executor->run(std::span(&phase, 1));
  };
  std::thread others[] = {std::thread(run), std::thread(run)};
  run();
  for (std::thread& other : others) other.join();
  CHECK_FALSE(met);
}

TEST_CASE("engines that ask for the same number of threads share them, and others do not") {
  CHECK(open(2) == open(2));
  const auto two = open(2), three = open(3);
  CHECK(two != three);
  std::atomic<int> n = 0;
  const FunctionTask task(3, [&](std::int64_t, Worker&) { ++n; });
  const Phase phase = {{&task}, nullptr};
  std::thread other([&] {
    for (int i = 0; i < 100; ++i) three->run(std::span(&phase, 1));
  });
  for (int i = 0; i < 100; ++i) two->run(std::span(&phase, 1));
  other.join();
  CHECK(n == 600);
}

TEST_CASE("each worker has scratch memory of its own") {
  constexpr std::size_t kSize = 10000;
  const auto three = open(3);
  REQUIRE(three->reserve(kSize).ok());
  CHECK(three->scratch_size() >= 3 * kSize);
  std::mutex mutex;
  std::set<std::pair<int, std::byte*>> seen;
  const FunctionTask task(64, [&](std::int64_t item, Worker& worker) {
    // Whoever shares this memory would write another item's number between these lines.
    auto* scratch = worker.scratch<std::byte>();
    for (std::size_t i = 0; i < kSize; ++i) scratch[i] = static_cast<std::byte>(item);
    std::this_thread::yield();
    for (std::size_t i = 0; i < kSize; ++i)
      if (scratch[i] != static_cast<std::byte>(item)) FAIL_CHECK("shared scratch");
    const std::lock_guard lock(mutex);
    seen.insert({worker.index, scratch});
  });
  const Phase phases[] = {{{&task}, nullptr}, {{&task}, nullptr}};
  three->run(phases);
  three->run(phases);
  std::set<int> workers;
  for (const auto& [index, memory] : seen) {
    CHECK(reinterpret_cast<std::uintptr_t>(memory) % 4096 == 0);
    CHECK(workers.insert(index).second);
  }
}

TEST_CASE("scratch memory stays a job's from item to item, until another task takes it or the phase ends") {
  for (const int n_thread : {1, 2}) {
    CAPTURE(n_thread);
    const auto executor = open(n_thread);
    REQUIRE(executor->reserve(64).ok());
    const int job = 0, other = 0;
    std::mutex mutex;
    int n_first = 0;  // items that found nothing of their job
    const auto keeps = [&](const int& whose) {
      return FunctionTask(40, [&](std::int64_t, Worker& worker) {
        const auto [memory, kept] = worker.scratch_of<const void*>(&whose);
        if (kept && *memory != &whose) FAIL_CHECK("kept by another job");
        *memory = &whose;
        const std::lock_guard lock(mutex);
        n_first += !kept;
      });
    };
    const FunctionTask one = keeps(job), two = keeps(other);
    const FunctionTask alone(40, [](std::int64_t, Worker& worker) { *worker.scratch<const void*>() = nullptr; });
    const Phase phases[] = {{{&one}, nullptr}, {{&one, &alone, &one, &two}, nullptr}, {{&one}, nullptr}};
    executor->run(phases);
    executor->run(phases);
    if (n_thread == 1) CHECK(n_first == 2 * 5);  // several workers share items as it comes
  }
}

TEST_CASE("an executor without work takes no time of the processor") {
  const auto executor = open(8);
  const FunctionTask task(64, [](std::int64_t, Worker&) {});
  const Phase phase = {{&task}, nullptr};
  executor->run(std::span(&phase, 1));
  sleep_ms(20);  // until all of them sleep
  const auto used = [] {
    timespec time;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
  };
  const double before = used();
  sleep_ms(200);
  CHECK(used() - before < 0.01);
  std::atomic<int> n = 0;  // and it wakes
  const FunctionTask count(64, [&](std::int64_t, Worker&) { ++n; });
  const Phase again = {{&count}, nullptr};
  executor->run(std::span(&again, 1));
  CHECK(n == 64);
}

TEST_CASE("a worker that is held up in an item does not keep others from the rest of the phase") {
  const auto executor = open(2);
  std::atomic<int> n_done = 0;
  int done_by_others = 0;
  const FunctionTask task(40, [&](std::int64_t item, Worker&) {
    if (item != 0) {
      ++n_done;
      return;
    }
    // The other thread has 39 items to take while this one waits, its own stretch's and those behind this item.
    for (int i = 0; i < 5000 && n_done < 39; ++i) sleep_ms(1);
    done_by_others = n_done;
  });
  const Phase phase = {{&task}, nullptr};
  executor->run(std::span(&phase, 1));
  CHECK(done_by_others == 39);
}

}  // namespace executor_test
