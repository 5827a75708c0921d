// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <span>
#include <thread>
#include <utility>
#include <vector>

#include "base/result.h"
#include "kernels/kind_clock.h"

namespace vla::kernels {

/// A thread that takes items of a phase. It has scratch memory at a multiple of 4 KiB. An item may rely on the contents
/// only if an item of the same job left them: the memory belongs to that job until another one takes it.
class Worker {
 public:
  explicit Worker(int i) : index(i) {}

  /// phase: a number that is unique to one run of one phase.
  void begin(std::uint64_t phase, std::byte* memory) { phase_ = phase, memory_ = memory; }

  /// Scratch memory for one item.
  template <class T>
  T* scratch() {
    owner_ = {};
    return reinterpret_cast<T*>(memory_);
  }
  /// Scratch memory for consecutive items of one job, and whether the last item left its contents there.
  template <class T>
  std::pair<T*, bool> scratch_of(const void* job) {
    const bool kept = owner_.job == job && owner_.phase == phase_;
    owner_ = {job, phase_};
    return {reinterpret_cast<T*>(memory_), kept};
  }

  /// Scratch memory after the first `offset` bytes. Earlier contents are lost.
  std::byte* scratch_from(std::size_t offset) {
    owner_ = {};
    return memory_ + offset;
  }

  const int index;

 private:
  std::uint64_t phase_ = 0;
  std::byte* memory_ = nullptr;
  struct Owner {
    const void* job = nullptr;
    std::uint64_t phase = 0;
  } owner_;
};

/// Work that is split into items, which any worker may take in any order.
class Task {
 public:
  virtual ~Task() = default;
  virtual void run(std::int64_t item, Worker& worker) const = 0;

  /// Runs an item. While the clock runs, adds the item's time to the task's kind.
  void take(std::int64_t item, Worker& worker) const {
    if (clock == nullptr || !clock->runs.load(std::memory_order_relaxed)) return run(item, worker);
    const auto start = std::chrono::steady_clock::now();
    run(item, worker);
    clock->add(kind, std::chrono::steady_clock::now() - start);
  }

  std::int64_t n_item = 1;
  KindClock::Kind kind = KindClock::others;
  KindClock* clock = nullptr;  // must outlive the task
};

/// A task whose items are calls of run(item, worker).
template <class Run>
std::unique_ptr<Task> task_of(std::int64_t n_item, Run run) {
  struct Calls final : Task {
    explicit Calls(Run call) : call_(std::move(call)) {}
    void run(std::int64_t item, Worker& worker) const override { call_(item, worker); }
    Run call_;
  };
  auto task = std::make_unique<Calls>(std::move(run));
  task->n_item = n_item;
  return task;
}

/// Tasks that do not depend on each other: their items may run at the same time.
struct Phase {
  std::vector<const Task*> tasks;
  std::chrono::steady_clock::time_point* done = nullptr;  // if set, receives the time when the last item ended
};

/// A thread pool that runs phases in order. A phase is done when its *items* are done, so a worker that the system
/// suspends between two items delays no other worker. The worker that finishes the last item opens the next phase. A
/// worker without work spins briefly, then sleeps until a phase of several items opens; an idle executor uses no
/// processor time.
///
/// Each worker has its own range of items, the same in every run so that operands may still be in its caches. After its
/// own range it takes items from other workers' ranges.
class Executor {
 public:
  /// The executor of `n_thread` threads, including the caller of `run`. Engines of one process with the same number
  /// share it, and their runs take turns. Errors: device if the system refuses a thread.
  static Result<std::shared_ptr<Executor>> shared(int n_thread);
  explicit Executor(int n_thread);
  ~Executor();

  int n_thread() const { return n_thread_; }
  /// Ensures at least `size` bytes of scratch memory per worker from the next run on. Errors: out_of_memory.
  Status reserve(std::size_t size);
  std::size_t scratch_size() const { return scratch_size_ * static_cast<std::size_t>(n_thread_); }
  /// Faults the scratch memory in now.
  void touch();

  /// Runs the phases in order and returns when the last is done. One thread at a time runs; others wait.
  void run(std::span<const Phase> phases);

 private:
  static constexpr int kMaxStretches = 64;
  /// Items left in a worker's range, with the phase number in the upper bits. The number keeps a suspended worker from
  /// mistaking an item of a later phase for one of an earlier phase.
  struct alignas(64) Stretch {
    std::atomic<std::uint64_t> left = 0;
    std::int64_t end = 0;  // end of the range
  };

  Status start();
  void serve(int index);
  bool work(Worker& worker);
  void run_item(std::int64_t item, Worker& worker);
  void finish_item();
  void open(std::size_t i_phase);
  bool has_work() const;
  template <class Ready>
  void wait(std::atomic<std::uint32_t>& word, std::atomic<int>& n_sleeping, const Ready& ready);
  void wake(std::atomic<std::uint32_t>& word, std::atomic<int>& n_sleeping, bool all);

  const int n_thread_, n_stretch_;
  std::mutex turn_;  // held during `run`, `reserve` and `touch`
  std::vector<std::thread> threads_;
  std::atomic<std::size_t> scratch_size_ = 0;  // may grow while another thread reads it
  struct Free {
    void operator()(std::byte* memory) const;
  };
  std::unique_ptr<std::byte, Free> scratch_;

  // The current phase. Written by the thread that opens it, read by workers that hold one of its items.
  std::span<const Phase> phases_;
  std::size_t i_phase_ = 0;
  std::uint64_t ticket_ = 0;
  Stretch stretches_[kMaxStretches];
  alignas(64) std::atomic<std::int64_t> n_left_ = 0;  // unfinished items of the phase

  // Two words to sleep on: workers wait for a phase, the caller of `run` for a phase or the end of the run.
  alignas(64) std::atomic<std::uint32_t> opened_ = 0;
  std::atomic<int> n_sleeping_ = 0;
  alignas(64) std::atomic<std::uint32_t> caller_word_ = 0;
  std::atomic<int> caller_sleeps_ = 0;
  std::atomic<bool> finished_ = true, stop_ = false;
};

}  // namespace vla::kernels
