// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/double_buffer.h"

#include <doctest/doctest.h>

#include <atomic>
#include <thread>
#include <vector>

namespace double_buffer_test {

using vla::serve::DoubleBuffer;

TEST_CASE("acts are computed in the order in which they were prepared, and at most two are under way") {
  constexpr int kN = 2000;
  DoubleBuffer<int> acts;
  std::atomic<int> n_under_way = 0, most = 0;
  std::thread preparing([&] {
    for (int i = 0; i < kN; ++i) {
      int& act = acts.to_prepare();
      const int now = ++n_under_way;
      if (now > most) most = now;
      act = i;
      acts.prepared();
    }
    acts.close();
  });
  std::vector<int> computed;
  while (const int* act = acts.to_compute()) {
    computed.push_back(*act);
    --n_under_way;
    acts.computed();
  }
  preparing.join();
  REQUIRE(computed.size() == kN);
  for (int i = 0; i < kN; ++i) REQUIRE(computed[static_cast<std::size_t>(i)] == i);
  CHECK(most <= 2);
}

TEST_CASE("an act that is prepared before the end is still computed") {
  DoubleBuffer<int> acts;
  acts.to_prepare() = 7;
  acts.prepared();
  acts.close();
  REQUIRE(acts.to_compute() != nullptr);
  CHECK(*acts.to_compute() == 7);
  acts.computed();
  CHECK(acts.to_compute() == nullptr);
}

}  // namespace double_buffer_test
