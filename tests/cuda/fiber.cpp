// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/fiber.h"

#if defined(__x86_64__)
asm(R"(
.pushsection .text
.globl vla_switch_stack
.type vla_switch_stack, @function
vla_switch_stack:
  push %rbp
  push %rbx
  push %r12
  push %r13
  push %r14
  push %r15
  mov %rsp, (%rdi)
  mov %rsi, %rsp
  pop %r15
  pop %r14
  pop %r13
  pop %r12
  pop %rbx
  pop %rbp
  ret
.size vla_switch_stack, .-vla_switch_stack
.popsection
)");
#endif

namespace vla::test::cuda {

void Fiber::begin(void (*entry)()) {
  if (!stack_) stack_ = std::make_unique<std::byte[]>(kStack);
#if defined(__SANITIZE_ADDRESS__)
  __asan_unpoison_memory_region(stack_.get(), kStack);  // frames that were never left
#endif
#if defined(__x86_64__)
  auto at = reinterpret_cast<std::size_t>(stack_.get() + kStack) / 16 * 16;
  auto* end = reinterpret_cast<void**>(at);
  end[-2] = reinterpret_cast<void*>(entry);  // as behind a call, the stack is 8 beyond a multiple of 16
  for (int i = 3; i < 9; ++i) end[-i] = nullptr;
  top_ = end - 8;
#else
  getcontext(&context_);
  context_.uc_stack.ss_sp = stack_.get();
  context_.uc_stack.ss_size = kStack;
  context_.uc_link = nullptr;
  makecontext(&context_, entry, 0);
#endif
  sanitizer_ = nullptr;
}

void Fiber::switch_to(Fiber& to) {
  start_switch(to);
#if defined(__x86_64__)
  vla_switch_stack(&top_, to.top_);
#else
  swapcontext(&context_, &to.context_);
#endif
  finish_switch();
}

#if defined(__SANITIZE_ADDRESS__)
// The address sanitizer is told of every switch, and where the stack is that the operating system gave.
static const void* thread_stack = nullptr;
static std::size_t thread_stack_size = 0;

void Fiber::start_switch(Fiber& to) {
  __sanitizer_start_switch_fiber(&sanitizer_, to.stack_ ? to.stack_.get() : thread_stack,
                                 to.stack_ ? kStack : thread_stack_size);
}
void Fiber::finish_switch() {
  const void* left = nullptr;
  std::size_t size = 0;
  __sanitizer_finish_switch_fiber(sanitizer_, &left, &size);
  if (stack_ && thread_stack == nullptr) thread_stack = left, thread_stack_size = size;
}
#else
void Fiber::start_switch(Fiber&) {}
void Fiber::finish_switch() {}
#endif

}  // namespace vla::test::cuda
