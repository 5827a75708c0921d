// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/turns.h"

#include <doctest/doctest.h>

#include <atomic>
#include <thread>
#include <vector>

using vla::kernels::Turns;

namespace {

/// How often each of n numbers was handed out when `nth` threads ran.
std::vector<int> counts(Turns& turns, int nth, std::int64_t n) {
  std::vector<std::atomic<int>> count(static_cast<std::size_t>(n));
  std::vector<std::thread> threads;
  for (int ith = 0; ith < nth; ++ith)
    threads.emplace_back([&, ith] { turns.share(ith, nth, n, [&](auto i) { ++count[static_cast<std::size_t>(i)]; }); });
  for (std::thread& thread : threads) thread.join();
  return {count.begin(), count.end()};
}

}  // namespace

TEST_CASE("threads together take every turn once, run after run") {
  Turns turns;
  for (int nth : {1, 2, 3, 17, 40})
    for (std::int64_t n : {0, 1, 2, 15, 1000})
      for (int run = 0; run < 3; ++run)
        CHECK(counts(turns, nth, n) == std::vector<int>(static_cast<std::size_t>(n), 1));
}

TEST_CASE("a thread that comes first does the work of those that come late") {
  Turns turns;
  int n_first = 0, n_second = 0;
  turns.share(1, 2, 10, [&](auto) { ++n_first; });
  turns.share(0, 2, 10, [&](auto) { ++n_second; });
  CHECK(n_first == 10);
  CHECK(n_second == 0);
}

TEST_CASE("a thread begins with its own stretch") {
  Turns turns;
  std::vector<std::int64_t> order;
  turns.share(1, 2, 4, [&](std::int64_t i) { order.push_back(i); });
  CHECK(order == std::vector<std::int64_t>{2, 3, 0, 1});
}
