// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// libcuda.so.1 without a GPU: the fake driver under NVIDIA's names, for programs as they are. The environment says how
// it behaves: VLA_FAKE_FAILS_AT (the number of a call), VLA_FAKE_LOST, VLA_FAKE_MEMORY (bytes), VLA_FAKE_VERSION,
// VLA_FAKE_CAPABILITY (75), VLA_FAKE_COMPUTES=no, and VLA_FAKE_COUNTS, a file that gets a line for each call.
#include <cstdio>
#include <cstdlib>

#include "cuda/fake_driver.h"

namespace {

using vla::cuda::Driver;

long number(const char* name, long otherwise) {
  const char* text = std::getenv(name);
  return text == nullptr ? otherwise : std::atol(text);
}

const Driver& driver() {
  static const Driver table = [] {
    vla::test::cuda::FakeDriver& fake = vla::test::cuda::fake_driver();
    const char* computes = std::getenv("VLA_FAKE_COMPUTES");
    const char* counts = std::getenv("VLA_FAKE_COUNTS");
    const long capability = number("VLA_FAKE_CAPABILITY", 87);
    fake.fail_at = number("VLA_FAKE_FAILS_AT", 0), fake.is_lost_then = std::getenv("VLA_FAKE_LOST") != nullptr;
    fake.memory = static_cast<std::size_t>(number("VLA_FAKE_MEMORY", 1L << 34));
    fake.version = static_cast<int>(number("VLA_FAKE_VERSION", 13000));
    fake.major = static_cast<int>(capability / 10), fake.minor = static_cast<int>(capability % 10);
    fake.computes = computes == nullptr || std::string(computes) != "no";
    if (counts != nullptr) fake.counts = std::fopen(counts, "a");
    return vla::test::cuda::fake_driver_table();
  }();
  return table;
}

template <auto kMember>
struct Forward;
template <class... Args, int (*Driver::*kMember)(Args...)>
struct Forward<kMember> {
  static int call(Args... args) { return (driver().*kMember)(args...); }
};

}  // namespace

// The parameters of a macro's list have no names to pass on: a symbol is a jump to the function that has them.
#define VLA_CUDA_CALL(name, symbol, ...)                                                                     \
  extern "C" __attribute__((visibility("hidden"))) auto* const vla_##symbol = &Forward<&Driver::name>::call; \
  asm(".text\n.globl " #symbol "\n.type " #symbol ", @function\n" #symbol ": jmp *vla_" #symbol "(%rip)\n");
VLA_CUDA_CALLS(VLA_CUDA_CALL)
