// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/relay.h"

#include <doctest/doctest.h>

#include <atomic>
#include <thread>
#include <vector>

using vla::serve::Relay;

TEST_CASE("acts are computed in the order in which they were prepared, and at most two are under way") {
  constexpr int kN = 2000;
  Relay<int> relay;
  std::atomic<int> n_under_way = 0, most = 0;
  std::thread preparing([&] {
    for (int i = 0; i < kN; ++i) {
      int& act = relay.to_prepare();
      const int now = ++n_under_way;
      if (now > most) most = now;
      act = i;
      relay.prepared();
    }
    relay.close();
  });
  std::vector<int> computed;
  while (const int* act = relay.to_compute()) {
    computed.push_back(*act);
    --n_under_way;
    relay.computed();
  }
  preparing.join();
  REQUIRE(computed.size() == kN);
  for (int i = 0; i < kN; ++i) REQUIRE(computed[static_cast<std::size_t>(i)] == i);
  CHECK(most <= 2);
}

TEST_CASE("an act that is prepared before the end is still computed") {
  Relay<int> relay;
  relay.to_prepare() = 7;
  relay.prepared();
  relay.close();
  REQUIRE(relay.to_compute() != nullptr);
  CHECK(*relay.to_compute() == 7);
  relay.computed();
  CHECK(relay.to_compute() == nullptr);
}
