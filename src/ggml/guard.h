// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml.h>

#include <exception>
#include <new>
#include <string>

#include "base/result.h"

namespace vla {

/// From now on an abort of ggml becomes an exception where `guarded` catches it. What ggml logged as an error before is
/// part of its text, since that is where CUDA's reason stands.
void set_guard() noexcept;

/// An abort was made an exception. It left ggml's functions where they stood, maybe with locks of all devices held.
bool ggml_aborted() noexcept;

/// While one lives, ggml's abort on this thread is an exception. The frames that it leaves are C++, or C compiled with
/// -fexceptions (cmake/deps.cmake); a destructor among them that fails as well ends the process.
class Guard {
 public:
  Guard() noexcept;
  ~Guard();
  Guard(const Guard&) = delete;
  Guard& operator=(const Guard&) = delete;
};

Error lost_device(const std::string& device, const std::string& what);

/// Calls functions of a backend, which throws or aborts where its driver answers with an error. Not for what ggml's own
/// threads compute: they would wait forever for the one that left. Errors: device, out_of_memory.
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
