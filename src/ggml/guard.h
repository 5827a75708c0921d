// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml.h>

#include <exception>
#include <new>
#include <string>

#include "base/result.h"

namespace vla {

/// Turns aborts of ggml into exceptions that `guarded` catches. The text of an exception includes the errors that ggml
/// logged before, because CUDA's reason is among them.
void set_guard() noexcept;

/// Whether an abort became an exception. It left ggml's functions without cleanup, perhaps with locks held that all
/// devices share.
bool ggml_aborted() noexcept;

/// While a Guard lives, an abort of ggml on its thread throws an exception. The exception unwinds C++ frames, and C
/// frames compiled with -fexceptions (cmake/deps.cmake). A destructor that throws meanwhile ends the process.
class Guard {
 public:
  Guard() noexcept;
  ~Guard();
  Guard(const Guard&) = delete;
  Guard& operator=(const Guard&) = delete;
};

Error lost_device(const std::string& device, const std::string& what);

/// Calls functions of a backend, which throw or abort if its driver returns an error. Not for work on ggml's own
/// threads: the other threads would wait forever for the one that threw. Errors: device, out_of_memory.
template <class F>
Status guarded(const std::string& device, const F& call) {
  const Guard guard;
  try {
    call();
    return {};
  } catch (const std::bad_alloc&) {
    return Error{Code::out_of_memory, device, "", "the system refused an allocation", "free memory"};
  } catch (const std::exception& exception) {
    return lost_device(device, exception.what());
  }
}

}  // namespace vla
