// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What a program must not do while it runs: take memory, or touch a page for the first time. This program's own malloc
// counts, and the linker puts a function of this file around every run of an executor (tests/CMakeLists.txt).
#include <doctest/doctest.h>
#include <errno.h>
#include <sys/resource.h>

#include <algorithm>
#include <atomic>
#include <limits>

#include "ggml/ggml_device.h"
#include "kernels/executor.h"
#include "kernels/kernel_set.h"
#include "support/golden_case.h"

using namespace vla;
using namespace vla::test;

namespace {

#if defined(__GLIBC__) && !defined(__SANITIZE_ADDRESS__)
constexpr bool kCounts = true;
#else
constexpr bool kCounts = false;  // the sanitizer's malloc is not to be replaced
#endif

std::atomic<bool> running = false;
std::atomic<long> n_allocation = 0;
long n_run = 0, n_fault = 0;

long minor_faults() {
  rusage usage = {};
  getrusage(RUSAGE_SELF, &usage);
  return usage.ru_minflt;
}

void reset() {
  n_run = n_fault = 0;
  n_allocation = 0;
}

}  // namespace

extern "C" {

// Executor::run(std::span<const Phase>), a member function whose object is its first argument.
void __real__ZN3vla7kernels8Executor3runESt4spanIKNS0_5PhaseELm18446744073709551615EE(
    kernels::Executor* executor, std::span<const kernels::Phase> phases);
void __wrap__ZN3vla7kernels8Executor3runESt4spanIKNS0_5PhaseELm18446744073709551615EE(
    kernels::Executor* executor, std::span<const kernels::Phase> phases);
void __wrap__ZN3vla7kernels8Executor3runESt4spanIKNS0_5PhaseELm18446744073709551615EE(
    kernels::Executor* executor, std::span<const kernels::Phase> phases) {
  const long before = minor_faults();
  running = true;
  __real__ZN3vla7kernels8Executor3runESt4spanIKNS0_5PhaseELm18446744073709551615EE(executor, phases);
  running = false;
  n_fault += minor_faults() - before;
  ++n_run;
}

#if defined(__GLIBC__) && !defined(__SANITIZE_ADDRESS__)
void* __libc_malloc(size_t size);
void* __libc_calloc(size_t count, size_t size);
void* __libc_realloc(void* memory, size_t size);
void* __libc_memalign(size_t alignment, size_t size);

static void count() {
  if (running) ++n_allocation;
}
void* malloc(size_t size) {
  count();
  return __libc_malloc(size);
}
void* calloc(size_t number, size_t size) {
  count();
  return __libc_calloc(number, size);
}
void* realloc(void* memory, size_t size) {
  count();
  return __libc_realloc(memory, size);
}
void* aligned_alloc(size_t alignment, size_t size) {
  count();
  return __libc_memalign(alignment, size);
}
int posix_memalign(void** memory, size_t alignment, size_t size) {
  count();
  *memory = __libc_memalign(alignment, size);
  return *memory != nullptr ? 0 : ENOMEM;
}
#endif
}

TEST_CASE("a second request takes no memory and touches no new page while its graphs run" * doctest::skip(!kCounts)) {
  for (const std::string& path : golden_paths()) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    const auto engine = load_engine(golden.bundle());
    REQUIRE(engine->act(golden.observation, golden.noise).ok());
    long fewest_faults = std::numeric_limits<long>::max();  // the system may move pages at any time
    for (int i = 0; i < 3; ++i) {
      reset();
      REQUIRE(engine->act(golden.observation, golden.noise).ok());
      const Solver& solver = engine->robot().solver();
      CHECK(n_run >= 1 + (solver.decodes ? 1 : solver.n_step));
      CHECK(n_allocation.load() == 0);
      fewest_faults = std::min(fewest_faults, n_fault);
    }
    CHECK(fewest_faults == 0);
  }
}

TEST_CASE("inputs, run and result of a ggml device take no memory the second time but ggml's own" *
          doctest::skip(!kCounts)) {
  auto device = GgmlDevice::cpu(1);
  REQUIRE(device.ok());
  Slots slots;
  Slot *a = slots.add_f32({64, 8, 1, 1}), *b = slots.add_f32({3, 1, 1, 1}), *sum = slots.add_f32({64, 8, 1, 1});
  Graph graph(slots);
  graph.write(graph.add(op::Add{}, {graph.input(a), graph.input(a)}), sum);
  const Keys keys;
  REQUIRE((*device)->load(ParamList(keys, nullptr), true).ok());
  REQUIRE((*device)->allocate(slots).ok());
  const auto program = (*device)->lower(graph);
  REQUIRE(program.ok());
  std::vector<float> values(64 * 8, 1.5f), result(values.size());
  bool ran = false;
  const auto act = [&] {
    (*device)->set(*a, values.data(), a->size());
    (*device)->set(*b, values.data(), b->size());
    ran = (*program)->run().ok();
    (*device)->get(*sum, result.data(), sum->size());
  };
  const auto allocations = [](const auto& call) {
    call();
    reset();
    running = true;
    call();
    running = false;
    return n_allocation.load();
  };
  const auto context = make_context(1, ggml_graph_overhead());
  ggml_cgraph* empty = ggml_new_graph(context->get());
  ggml_backend_t backend = static_cast<GgmlDevice&>(**device).backend();
  const long of_ggml = allocations([&] { ggml_backend_graph_compute(backend, empty); });
  CHECK(allocations(act) == of_ggml);
  REQUIRE(ran);
  CHECK(result == std::vector<float>(values.size(), 3.0f));
}
