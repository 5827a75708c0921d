// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// What a graph must not do while it runs: take memory, or touch a page for the first time. This program's own malloc
// counts, and the linker puts `__wrap_ggml_backend_graph_compute` around every run (tests/CMakeLists.txt).
#include <doctest/doctest.h>
#include <errno.h>
#include <ggml-backend.h>
#include <sys/resource.h>

#include <algorithm>
#include <atomic>
#include <limits>

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

ggml_status __real_ggml_backend_graph_compute(ggml_backend_t backend, ggml_cgraph* graph);
ggml_status __wrap_ggml_backend_graph_compute(ggml_backend_t backend, ggml_cgraph* graph);
ggml_status __wrap_ggml_backend_graph_compute(ggml_backend_t backend, ggml_cgraph* graph) {
  const long before = minor_faults();
  running = true;
  const ggml_status status = __real_ggml_backend_graph_compute(backend, graph);
  running = false;
  n_fault += minor_faults() - before;
  ++n_run;
  return status;
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
  // ggml makes an empty context in every run, to be sure of its tables, and frees it at once: two small blocks.
  constexpr long kOfGgml = 2;
  for (const std::string& path : golden_paths()) {
    CAPTURE(path);
    const GoldenCase golden = GoldenCase::read(path);
    const auto engine = load_engine(golden.bundle());
    REQUIRE(engine->act(golden.observation, golden.noise).ok());
    long fewest_faults = std::numeric_limits<long>::max();  // the system may move pages at any time
    for (int i = 0; i < 3; ++i) {
      reset();
      REQUIRE(engine->act(golden.observation, golden.noise).ok());
      CHECK(n_run == 1 + engine->solver().n_step);
      CHECK(n_allocation.load() <= kOfGgml * n_run);
      fewest_faults = std::min(fewest_faults, n_fault);
    }
    CHECK(fewest_faults == 0);
  }
}
