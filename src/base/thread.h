// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <pthread.h>

#include <csignal>
#include <system_error>
#include <thread>
#include <utility>

#include "base/result.h"

namespace vla {

/// Runs `work` on a new thread with the system's default stack size. The thread blocks all signals, which the caller's
/// threads handle. `where` names the thread in an error. Errors: out_of_memory.
template <class Work>
Result<std::thread> start_thread(const char* where, Work work) {
  sigset_t all, before;
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before);
  Result<std::thread> thread = std::thread();
  try {
    thread = std::thread(std::move(work));
  } catch (const std::system_error& error) {
    thread = Error{Code::out_of_memory, where, "a thread", error.what()};
  }
  pthread_sigmask(SIG_SETMASK, &before, nullptr);
  return thread;
}

}  // namespace vla
