// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/executor.h"

#include <algorithm>
#include <cstdlib>
#include <map>
#include <system_error>

#include "kernels/cores.h"
#include "kernels/pages.h"

namespace vla::kernels {
namespace {

/// How long a worker without work spins before it sleeps: longer than most operations on one thread, so that workers
/// stay awake through a chain of such operations, and much shorter than a time slice, because the system counts a
/// spinning core as busy.
constexpr std::chrono::microseconds kSpin(20);

constexpr std::uint64_t kCountBits = 24, kCountMask = (std::uint64_t{1} << kCountBits) - 1;

void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

}  // namespace

void Executor::Free::operator()(std::byte* memory) const { std::free(memory); }

Result<std::shared_ptr<Executor>> Executor::shared(int n_thread) {
  static std::mutex mutex;
  static std::map<int, std::weak_ptr<Executor>> all;
  const std::lock_guard lock(mutex);
  if (auto known = all[n_thread].lock()) return known;
  auto executor = std::make_shared<Executor>(n_thread);
  VLA_CHECK(executor->start());
  all[n_thread] = executor;
  return executor;
}

Executor::Executor(int n_thread) : n_thread_(n_thread), n_stretch_(std::min(n_thread, kMaxStretches)) {}

Status Executor::start() {
  const std::vector<int> all = allowed_cores(), big = big_cores(all);
  const bool fits = big.size() < all.size() && static_cast<std::size_t>(n_thread_) <= big.size();
  try {
    for (int i = 1; i < n_thread_; ++i)
      threads_.emplace_back([this, i, only = fits ? big : std::vector<int>{}] {
        if (!only.empty()) stay_on(only);
        serve(i);
      });
  } catch (const std::system_error& error) {
    return Error{Code::device, "threads", std::to_string(n_thread_), error.what(), "use fewer threads"};
  }
  return {};
}

Executor::~Executor() {
  stop_ = true;
  ++opened_;
  opened_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

Status Executor::reserve(std::size_t size) {
  constexpr std::size_t kPage = 4096;  // at least a cache line; pages may be larger
  const std::lock_guard lock(turn_);
  if (size <= scratch_size_) return {};
  size = (size + kPage - 1) / kPage * kPage;
  std::unique_ptr<std::byte, Free> memory(
      static_cast<std::byte*>(std::aligned_alloc(kPage, size * static_cast<std::size_t>(n_thread_))));
  if (!memory)
    return Error{Code::out_of_memory, "scratch memory of threads", "", "the system refused the allocation",
                 "free memory or use fewer threads"};
  scratch_ = std::move(memory);
  scratch_size_ = size;
  want_large_pages(scratch_.get(), scratch_size());
  return {};
}

void Executor::touch() {
  const std::lock_guard lock(turn_);
  want_memory_now(scratch_.get(), scratch_size());
}

void Executor::run(std::span<const Phase> phases) {
  if (phases.empty()) return;
  const std::lock_guard lock(turn_);
  Worker self(0);
  if (n_thread_ == 1) {  // no queue
    for (const Phase& phase : phases) {
      self.begin(++ticket_, scratch_.get());
      for (const Task* task : phase.tasks)
        for (std::int64_t item = 0; item < task->n_item; ++item) task->take(item, self);
      if (phase.done != nullptr) *phase.done = std::chrono::steady_clock::now();
    }
    return;
  }
  phases_ = phases;
  finished_.store(false, std::memory_order_relaxed);
  open(0);
  while (!finished_.load(std::memory_order_acquire)) {
    if (work(self)) continue;
    wait(caller_word_, caller_sleeps_, [this] { return has_work() || finished_.load(std::memory_order_acquire); });
  }
}

void Executor::serve(int index) {
  while (!stop_) {
    Worker self(index);
    if (work(self)) continue;
    wait(opened_, n_sleeping_, [this] { return has_work() || stop_.load(std::memory_order_relaxed); });
  }
}

bool Executor::has_work() const {
  return std::any_of(stretches_, stretches_ + n_stretch_, [](const Stretch& stretch) {
    return (stretch.left.load(std::memory_order_acquire) & kCountMask) != 0;
  });
}

/// Takes items while there are any, first from the worker's own range. Returns false if there were none.
bool Executor::work(Worker& worker) {
  bool worked = false;
  for (int i = 0; i < n_stretch_; ++i) {
    Stretch& stretch = stretches_[(worker.index + i) % n_stretch_];
    std::uint64_t left = stretch.left.load(std::memory_order_acquire);
    while ((left & kCountMask) != 0) {
      if (!stretch.left.compare_exchange_weak(left, left - 1, std::memory_order_acq_rel)) continue;
      // The phase cannot end before this item is finished. Scratch memory may have grown since the last run, but does
      // not grow while a worker holds an item.
      worker.begin(left >> kCountBits, scratch_.get() + static_cast<std::size_t>(worker.index) * scratch_size_);
      run_item(stretch.end - static_cast<std::int64_t>(left & kCountMask), worker);
      finish_item();
      worked = true;
      left = stretch.left.load(std::memory_order_acquire);
    }
  }
  return worked;
}

void Executor::run_item(std::int64_t item, Worker& worker) {
  for (const Task* task : phases_[i_phase_].tasks) {
    if (item < task->n_item) return task->take(item, worker);
    item -= task->n_item;
  }
}

void Executor::finish_item() {
  if (n_left_.fetch_sub(1, std::memory_order_acq_rel) != 1) return;
  const Phase& phase = phases_[i_phase_];
  if (phase.done != nullptr) *phase.done = std::chrono::steady_clock::now();
  if (i_phase_ + 1 < phases_.size()) return open(i_phase_ + 1);
  finished_.store(true, std::memory_order_seq_cst);
  wake(caller_word_, caller_sleeps_, false);
}

void Executor::open(std::size_t i_phase) {
  i_phase_ = i_phase;
  ++ticket_;
  std::int64_t n = 0;
  for (const Task* task : phases_[i_phase].tasks) n += task->n_item;
  n_left_.store(n, std::memory_order_relaxed);
  for (int i = 0; i < n_stretch_; ++i) {
    const std::int64_t begin = n * i / n_stretch_, end = n * (i + 1) / n_stretch_;
    stretches_[i].end = end;
    stretches_[i].left.store(ticket_ << kCountBits | static_cast<std::uint64_t>(end - begin),
                             std::memory_order_seq_cst);
  }
  // A single item goes to the first thread, which usually opens the phase.
  if (n > 1) {
    wake(opened_, n_sleeping_, n > 2);
    wake(caller_word_, caller_sleeps_, false);
  }
}

/// Spins, then sleeps until `ready`.
template <class Ready>
void Executor::wait(std::atomic<std::uint32_t>& word, std::atomic<int>& n_sleeping, const Ready& ready) {
  const auto start = std::chrono::steady_clock::now();
  do {
    for (int i = 0; i < 32; ++i) {
      if (ready()) return;
      pause();
    }
  } while (std::chrono::steady_clock::now() - start < kSpin);
  n_sleeping.fetch_add(1, std::memory_order_seq_cst);
  const std::uint32_t seen = word.load(std::memory_order_seq_cst);
  if (!ready()) word.wait(seen);
  n_sleeping.fetch_sub(1, std::memory_order_seq_cst);
}

void Executor::wake(std::atomic<std::uint32_t>& word, std::atomic<int>& n_sleeping, bool all) {
  word.fetch_add(1, std::memory_order_seq_cst);
  if (n_sleeping.load(std::memory_order_seq_cst) > 0) all ? word.notify_all() : word.notify_one();
}

}  // namespace vla::kernels
