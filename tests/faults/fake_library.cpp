// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// A libvla-cuda.so for machines without a GPU: ggml's CPU behind a driver that computes a graph as late as it may, when
// somebody waits for it. It counts its calls and fails when told to, as ggml-cuda does: by an abort of the library's
// own ggml, in every call from the first that fails, freeing too.
//   VLA_FAKE_FAILS_AT=N    the N-th call (from 1) fails
//   VLA_FAKE_MEMORY=N      buffers of more than N bytes together are refused
//   VLA_FAKE_COMPUTES=no   graphs are not computed
//   VLA_FAKE_AT_ONCE=yes   they are computed when they are asked for
//   VLA_FAKE_TAKES_MS=N    the driver sleeps so long before it computes a graph
//   VLA_FAKE_COUNTS=FILE   a line for each call: compute, synchronize, record, wait, set, get, memset, allocate or free
#include <ggml-backend-impl.h>
#include <ggml-cpu.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <thread>

#include "ggml/ggml_library.h"

namespace {

struct Driver {
  long n_call = 0, fails_at = 0;
  std::size_t memory = SIZE_MAX, used = 0;
  bool computes = true, at_once = false;
  int takes_ms = 0;
  std::FILE* counts = nullptr;
  // Of ggml's CPU: what is done where nothing fails.
  ggml_backend_i backend;
  ggml_backend_buffer_i buffer;
  ggml_backend_buffer_type_i type;
  ggml_backend_device_i device;
} driver;

/// Graphs that nobody waited for yet, in their order.
struct Asked {
  ggml_backend_t backend;
  ggml_cgraph* graph;
};
std::deque<Asked> asked;
std::size_t n_computed = 0;

ggml_backend_buffer_type buffer_type;

void call(const char* what) {
  ++driver.n_call;
  if (driver.counts != nullptr) std::fprintf(driver.counts, "%s\n", what), std::fflush(driver.counts);
  if (driver.fails_at == 0 || driver.n_call < driver.fails_at) return;
  ggml_log_callback log = nullptr;
  void* data = nullptr;
  ggml_log_get(&log, &data);
  log(GGML_LOG_LEVEL_ERROR, "CUDA error: unspecified launch failure\n", data);
  GGML_ABORT("in %s", what);
}

void compute_to(std::size_t n) {
  for (; n_computed < n; ++n_computed, asked.pop_front()) {
    std::this_thread::sleep_for(std::chrono::milliseconds(driver.takes_ms));
    if (driver.computes) driver.backend.graph_compute(asked.front().backend, asked.front().graph);
  }
}

ggml_status compute(ggml_backend_t backend, ggml_cgraph* graph) {
  call("compute");
  asked.push_back({backend, graph});
  if (driver.at_once) compute_to(n_computed + asked.size());
  return GGML_STATUS_SUCCESS;
}
void synchronize(ggml_backend_t) {
  call("synchronize");
  compute_to(n_computed + asked.size());
}

/// Of an event: how many graphs had been asked for.
std::size_t& stands_for(ggml_backend_event_t event) { return *static_cast<std::size_t*>(event->context); }
ggml_backend_event_t make_event(ggml_backend_dev_t device) {
  return new ggml_backend_event{device, new std::size_t(0)};
}
void free_event(ggml_backend_dev_t, ggml_backend_event_t event) {
  delete &stands_for(event);
  delete event;
}
void record(ggml_backend_t, ggml_backend_event_t event) {
  call("record");
  stands_for(event) = n_computed + asked.size();
}
void wait(ggml_backend_dev_t, ggml_backend_event_t event) {
  call("wait");
  compute_to(stands_for(event));
}

void free_backend(ggml_backend_t backend) {
  call("free");
  driver.backend.free(backend);
}

void set(ggml_backend_buffer_t buffer, ggml_tensor* tensor, const void* data, size_t offset, size_t size) {
  call("set");
  driver.buffer.set_tensor(buffer, tensor, data, offset, size);
}
void get(ggml_backend_buffer_t buffer, const ggml_tensor* tensor, void* data, size_t offset, size_t size) {
  call("get");
  driver.buffer.get_tensor(buffer, tensor, data, offset, size);
}
void fill(ggml_backend_buffer_t buffer, ggml_tensor* tensor, uint8_t value, size_t offset, size_t size) {
  call("memset");
  driver.buffer.memset_tensor(buffer, tensor, value, offset, size);
}
void free_buffer(ggml_backend_buffer_t buffer) {
  call("free");
  driver.used -= buffer->size;
  driver.buffer.free_buffer(buffer);
}

ggml_backend_buffer_t allocate(ggml_backend_buffer_type_t type, size_t size) {
  call("allocate");
  if (size > driver.memory - driver.used) return nullptr;
  driver.used += size;
  ggml_backend_buffer_t buffer = driver.type.alloc_buffer(type, size);
  driver.buffer = buffer->iface;
  buffer->iface.set_tensor = set;
  buffer->iface.get_tensor = get;
  buffer->iface.memset_tensor = fill;
  buffer->iface.free_buffer = free_buffer;
  buffer->buft = &buffer_type;
  return buffer;
}

ggml_backend_t init(ggml_backend_dev_t device, const char* params) {
  ggml_backend_t backend = driver.device.init_backend(device, params);
  ggml_backend_cpu_set_n_threads(backend, 1);
  driver.backend = backend->iface;
  backend->iface.graph_compute = compute;
  backend->iface.synchronize = synchronize;
  backend->iface.event_record = record;
  backend->iface.free = free_backend;
  backend->device = device;
  return backend;
}

ggml_backend_reg_t open() {
  const char* fails_at = std::getenv("VLA_FAKE_FAILS_AT");
  const char* computes = std::getenv("VLA_FAKE_COMPUTES");
  const char* counts = std::getenv("VLA_FAKE_COUNTS");
  const char* memory = std::getenv("VLA_FAKE_MEMORY");
  const char* takes_ms = std::getenv("VLA_FAKE_TAKES_MS");
  if (fails_at != nullptr) driver.fails_at = std::atol(fails_at);
  driver.at_once = std::getenv("VLA_FAKE_AT_ONCE") != nullptr;
  if (memory != nullptr) driver.memory = static_cast<std::size_t>(std::atol(memory));
  driver.computes = computes == nullptr || std::strcmp(computes, "no") != 0;
  if (takes_ms != nullptr) driver.takes_ms = std::atoi(takes_ms);
  if (counts != nullptr) driver.counts = std::fopen(counts, "a");

  ggml_backend_reg_t cpu = ggml_backend_cpu_reg();
  static ggml_backend_reg registry = *cpu;
  static ggml_backend_device device = *ggml_backend_reg_dev_get(cpu, 0);
  buffer_type = *ggml_backend_cpu_buffer_type();
  driver.device = device.iface;
  driver.type = buffer_type.iface;
  buffer_type.iface.alloc_buffer = allocate;
  buffer_type.device = &device;
  device.reg = &registry;
  device.iface.init_backend = init;
  device.iface.event_new = make_event;
  device.iface.event_free = free_event;
  device.iface.event_synchronize = wait;
  device.iface.get_buffer_type = [](ggml_backend_dev_t) -> ggml_backend_buffer_type_t { return &buffer_type; };
  registry.iface.get_device = [](ggml_backend_reg_t, size_t) -> ggml_backend_dev_t { return &device; };
  return &registry;
}

constexpr vla::GgmlBackend kFake = {"cuda", open, [](ggml_backend_dev_t) { return std::string("driver fake 1.0"); }};

}  // namespace

const vla::DeviceLibrary* vla_device_library() {
  static const vla::DeviceLibrary library = vla::library_of<kFake>();
  return &library;
}
