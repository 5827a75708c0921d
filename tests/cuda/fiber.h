// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>

#if !defined(__x86_64__)
#include <ucontext.h>
#endif
#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#include <sanitizer/common_interface_defs.h>
#endif

#if defined(__x86_64__)
/// Saves what a called function must keep and the stack at *save, and goes on where `to` was saved.
extern "C" void vla_switch_stack(void** save, void* to);
#endif

namespace vla::test::cuda {

/// A thread of control with a stack of its own, which runs until it switches to another. On x86-64 a switch is a dozen
/// instructions; elsewhere ucontext does it, which asks the operating system for the signal mask each time.
class Fiber {
 public:
  /// The stack that the caller runs on.
  Fiber() = default;
  /// `entry` begins when the fiber is first switched to, and never returns.
  void begin(void (*entry)());
  /// From this fiber, which is running, to another.
  void switch_to(Fiber& to);
  /// Called first on a new stack.
  void arrived() { finish_switch(); }

 private:
#if defined(__SANITIZE_ADDRESS__)
  static constexpr std::size_t kStack = 256 << 10;
#else
  static constexpr std::size_t kStack = 64 << 10;
#endif
  void start_switch(Fiber& to);
  void finish_switch();

  std::unique_ptr<std::byte[]> stack_;
#if defined(__x86_64__)
  void* top_ = nullptr;
#else
  ucontext_t context_;
#endif
  void* sanitizer_ = nullptr;
};

}  // namespace vla::test::cuda
