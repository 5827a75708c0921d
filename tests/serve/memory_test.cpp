// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The server's threads without memory: every allocation on the way of a request fails once.
#include <sys/prctl.h>

#include <atomic>
#include <cstdlib>
#include <cstring>
#include <new>

#include "serve/support.h"

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kCanFail = false;
#else
constexpr bool kCanFail = true;
#endif

namespace {

std::atomic<long> countdown = -1;  // allocations of other threads until one fails; negative: none does
thread_local bool is_test = false;

/// Threads of the clients' libzmq end the process without memory: they are not what is tested.
[[maybe_unused]] bool is_of_server() {
  char name[16] = {};
  return !is_test && prctl(PR_GET_NAME, name) == 0 && std::strncmp(name, "ZMQ", 3) != 0;
}

}  // namespace

#pragma GCC diagnostic ignored "-Wmismatched-new-delete"  // seen from inside the pair that matches
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
void* operator new(std::size_t size) {
  if (countdown.load(std::memory_order_relaxed) >= 0 && is_of_server() && countdown.fetch_sub(1) == 0)
    throw std::bad_alloc();
  if (void* memory = std::malloc(size == 0 ? 1 : size)) return memory;
  throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
#endif

using namespace vla;
using namespace vla::test;

TEST_CASE("whichever allocation of a request fails, its client hears of it, and the next request is served") {
  if (!kCanFail) {
    MESSAGE("SKIP: a sanitizer has the allocator");
    return;
  }
  is_test = true;
  Running running;
  auto peer = std::make_unique<Peer>(running.address());
  check_serves(*peer);
  const std::string request = act_request(golden(), 7).SerializeAsString();
  int n_told = 0, n_lost = 0, n_unreached = 0;
  for (long n = 0; n_unreached < 3; ++n) {
    REQUIRE(n < 5000);
    CAPTURE(n);
    countdown = n;
    peer->send(request);
    const auto response = peer->receive(2000);
    n_unreached = countdown.exchange(-1) >= 0 ? n_unreached + 1 : 0;
    if (response && response->has_error()) {
      CHECK(code_of(*response) == "OUT_OF_MEMORY");
      CHECK(response->request_id() == 7);
      ++n_told;
    } else if (!response) {
      ++n_lost;
      peer = std::make_unique<Peer>(running.address());
    }
    check_serves(*peer);
  }
  CHECK(n_told > 10);
  CHECK(n_lost <= 20);  // what the connection itself needs: it ends, and the client sees that
  MESSAGE(n_told, " told, ", n_lost, " lost their connection");
  is_test = false;
}
