// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/thread.h"

#include <doctest/doctest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <fstream>

namespace thread_test {

using namespace vla;

TEST_CASE("a thread that the system does not give is an error, and the next one runs") {
#if defined(__SANITIZE_ADDRESS__)
  MESSAGE("SKIP: the address sanitizer takes terabytes of address space");
#else
  rlimit before = {};
  REQUIRE(getrlimit(RLIMIT_AS, &before) == 0);
  std::size_t n_page = 0;
  std::ifstream("/proc/self/statm") >> n_page;
  const rlimit none_left = {n_page * static_cast<std::size_t>(sysconf(_SC_PAGESIZE)) + (1 << 20), before.rlim_max};
  REQUIRE(setrlimit(RLIMIT_AS, &none_left) == 0);
  const auto refused = start_thread("here", [] {});  // its stack takes more than a megabyte
  REQUIRE(setrlimit(RLIMIT_AS, &before) == 0);
  REQUIRE_FALSE(refused.ok());
  CHECK(refused.error().code == Code::out_of_memory);
  CHECK(refused.error().where == "here");
#endif
  bool ran = false;
  auto thread = start_thread("here", [&] { ran = true; });
  REQUIRE(thread.ok());
  thread->join();
  CHECK(ran);
}

TEST_CASE("signals are not delivered to a thread") {
  sigset_t blocked;
  sigemptyset(&blocked);
  auto thread = start_thread("here", [&] { pthread_sigmask(SIG_BLOCK, nullptr, &blocked); });
  REQUIRE(thread.ok());
  thread->join();
  CHECK(sigismember(&blocked, SIGTERM) == 1);
  sigset_t own;
  pthread_sigmask(SIG_BLOCK, nullptr, &own);
  CHECK(sigismember(&own, SIGTERM) == 0);
}

}  // namespace thread_test
