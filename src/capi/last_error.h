// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vla/vla.h>

#include <exception>
#include <new>

#include "base/result.h"

namespace vla::capi {

/// Stores an error for this thread's `last_error`. Returns its status.
vla_status fail(const vla_policy* policy, Error error) noexcept;
/// The same for an unexpected exception, and for out of memory, when no string can be allocated.
vla_status fail_unexpected(const vla_policy* policy, const char* what) noexcept;
vla_status fail_without_memory(const vla_policy* policy) noexcept;
const vla_error* last_error(const vla_policy* policy) noexcept;

/// Runs the body of an interface function. An error or exception in it becomes the caller's status.
template <class F>
vla_status guarded(const vla_policy* policy, F&& body) noexcept {
  try {
    const Status status = body();
    return status ? VLA_OK : fail(policy, status.error());
  } catch (const std::bad_alloc&) {
    return fail_without_memory(policy);
  } catch (const std::exception& exception) {
    return fail_unexpected(policy, exception.what());
  } catch (...) {
    return fail_unexpected(policy, "an exception without a name");
  }
}

}  // namespace vla::capi
