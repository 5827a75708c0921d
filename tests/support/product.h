// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <atomic>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <thread>
#include <vector>

#include "kernels/linear_kernel.h"

/// What tests of matrix products share: numbers, and a job run as the executor runs it.
namespace vla::test {

struct ProductShape {
  std::int64_t n_row, d_in, d_out;
};

/// The same numbers on every machine; they differ from call to call.
class Numbers {
 public:
  std::uint32_t next() {
    state_ = state_ * 1664525u + 1013904223u;
    return state_ >> 8;
  }
  std::uint32_t below(std::uint32_t n) { return next() % n; }
  /// In [-1, 1].
  std::vector<float> floats(std::int64_t count) {
    std::vector<float> values(static_cast<std::size_t>(count));
    for (float& value : values) value = static_cast<float>(next()) / 8388608.0f - 1.0f;
    return values;
  }

 private:
  std::uint32_t state_ = 12345;
};

using Pages = std::unique_ptr<std::byte, decltype(&std::free)>;

/// Memory at a multiple of a page, all ones: what is found there must not matter, and as floats ones are NaN.
inline Pages pages(std::size_t size) {
  constexpr std::size_t kPage = 4096;
  Pages memory(static_cast<std::byte*>(std::aligned_alloc(kPage, (size + kPage - 1) / kPage * kPage)), std::free);
  std::memset(memory.get(), 0xff, size);
  return memory;
}

/// A weight as its kernel wants it.
inline Pages packed(const kernels::LinearKernel& kernel, const kernels::MatrixDesc& desc, const std::byte* stored) {
  Pages memory = pages(kernel.packed_size(desc));
  kernel.pack(desc, stored, memory.get());
  return memory;
}

/// Stands before and behind the rows of a y, and in them until they are computed.
constexpr float kUntouched = 1234.5f;

/// Compares rows that lie between two untouched numbers: is_right(row, n, value).
template <class IsRight>
void check_rows(const std::vector<float>& y, std::int64_t n_row, std::int64_t d_out, const IsRight& is_right) {
  CHECK(y.front() == kUntouched);
  CHECK(y.back() == kUntouched);
  int wrong = 0;
  for (std::int64_t row = 0; row < n_row; ++row)
    for (std::int64_t n = 0; n < d_out; ++n)
      wrong += !is_right(row, n, y[static_cast<std::size_t>(row * d_out + n + 1)]);
  CHECK(wrong == 0);
}

/// Items are taken by whichever thread comes first.
inline void run_job(const kernels::LinearKernel& kernel, kernels::LinearJob& job, int n_thread) {
  const std::int64_t n_item = kernel.cut(job, n_thread);
  CHECK(n_item >= 1);
  std::atomic<std::int64_t> next = 0;
  const auto work = [&](int index) {
    const Pages scratch = pages(kernel.scratch_size);
    kernels::Worker worker(index);
    worker.begin(1, scratch.get());
    for (std::int64_t item = next++; item < n_item; item = next++) kernel.run(job, item, worker);
  };
  std::vector<std::thread> threads;
  for (int i = 1; i < n_thread; ++i) threads.emplace_back(work, i);
  work(0);
  for (std::thread& thread : threads) thread.join();
}

}  // namespace vla::test
