// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "capi/last_error.h"

namespace vla::capi {
namespace {

constexpr vla_error kNone = {sizeof(vla_error), VLA_OK, "ok", "", "", "", "", ""};
constexpr vla_error kNoMemory = {sizeof(vla_error),
                                 VLA_OUT_OF_MEMORY,
                                 code_name(Code::out_of_memory),
                                 "vla",
                                 "",
                                 "the system has no memory left",
                                 "use a smaller model or free memory",
                                 "vla: the system has no memory left; use a smaller model or free memory"};

/// The error of a thread's last failure. `seen` points into the strings beside it.
struct LastError {
  const vla_policy* policy = nullptr;
  Error error;
  std::string message;
  vla_error seen = kNone;
};

thread_local LastError last;

}  // namespace

vla_status fail_without_memory(const vla_policy* policy) noexcept {
  last.policy = policy;
  last.seen = kNoMemory;
  return VLA_OUT_OF_MEMORY;
}

vla_status fail(const vla_policy* policy, Error error) noexcept try {
  last.policy = policy;
  last.error = std::move(error);
  last.message = last.error.message();
  const Error& e = last.error;
  last.seen = {sizeof(vla_error),  exit_code(e.code), code_name(e.code), e.where.c_str(),
               e.expected.c_str(), e.found.c_str(),   e.hint.c_str(),    last.message.c_str()};
  return last.seen.code;
} catch (...) {
  return fail_without_memory(policy);
}

vla_status fail_unexpected(const vla_policy* policy, const char* what) noexcept try {
  return fail(policy, {Code::internal, "vla", "", what, "please report this"});
} catch (...) {
  return fail_without_memory(policy);
}

const vla_error* last_error(const vla_policy* policy) noexcept { return last.policy == policy ? &last.seen : &kNone; }

}  // namespace vla::capi
