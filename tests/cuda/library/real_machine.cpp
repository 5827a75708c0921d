// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The machine of tests/cuda on a real GPU: tests of kernels that are linked with this file, in the place of
// machine.cpp, device_memory.cpp and the emulation, run on what libcuda.so.1 finds.
//
// Tests fill and read device memory by pointer. So it is page-locked memory of the host here, which the device reaches
// at the same address. VLA_REAL_MEMORY=device allocates memory of the device instead: for the driver of tests, whose
// device memory is the host's. Each allocation has bytes behind it that are looked at when it is released, so that a
// kernel that writes there ends the program.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <variant>

#include "cuda/driver/gpu.h"
#include "cuda/driver/modules.h"
#include "cuda/fault.h"
#include "cuda/machine.h"

namespace vla::test::cuda {
namespace {

using namespace vla::cuda;

constexpr std::size_t kBehind = 256;  // bytes

template <class T>
T must(Result<T> result) {
  if (result) return std::move(*result);
  std::fprintf(stderr, "error: %s\n", result.error().message().c_str());
  std::exit(3);
}

/// The first GPU, a stream of it, and what tests hold.
struct Machine {
  struct Memory {
    std::size_t size;
    std::variant<Owned, Buffer> held;
  };
  Driver driver = must(load_driver());
  std::unique_ptr<Gpu> gpu = must(Gpu::open(driver, 0, kernel_modules()));
  Stream stream = must(gpu->stream());
  bool is_device_memory = std::getenv("VLA_REAL_MEMORY") != nullptr;
  std::map<std::byte*, Memory> memory;

  Machine() { std::fprintf(stderr, "kernels run on %s, %d SMs\n", gpu->name().c_str(), gpu->n_sm()); }
};

/// It is never closed: tests hold memory until the end.
Machine& machine() {
  static Machine* const one = new Machine;
  return *one;
}

}  // namespace

DeviceMemory& device_memory() {
  static DeviceMemory memory;
  return memory;
}
DeviceMemory::~DeviceMemory() = default;

void* DeviceMemory::allocate(std::size_t size) {
  Machine& m = machine();
  std::byte* first = nullptr;
  Machine::Memory memory = {size, {}};
  if (m.is_device_memory) {
    const Buffer& made = memory.held.emplace<Buffer>(must(m.gpu->allocate(size + kBehind, "memory of a test")));
    first = made.as<std::byte>();
  } else {
    first = static_cast<std::byte*>(memory.held.emplace<Owned>(must(m.gpu->allocate_host(size + kBehind))).get());
  }
  std::memset(first, kGarbage, size + kBehind);
  m.memory.emplace(first, std::move(memory));
  return first;
}

void DeviceMemory::release(void* p) {
  Machine& m = machine();
  const auto found = m.memory.find(static_cast<std::byte*>(p));
  if (found == m.memory.end()) std::abort();
  for (std::size_t i = 0; i < kBehind; ++i)
    if (found->first[found->second.size + i] != std::byte{kGarbage}) {
      std::fprintf(stderr, "FAILED: a kernel wrote %zu bytes behind an allocation of %zu\n", i, found->second.size);
      std::_Exit(4);
    }
  m.memory.erase(found);
}

bool runs_ptx() { return true; }
bool is_hopper() { return machine().gpu->is_hopper(); }

/// Tensor cores multiply exactly, but add in groups, of 8 products on Ampere and more on Hopper: a group's products are
/// shifted to the largest exponent among them and the sum so far, and what lies a bit or two below the last place of
/// that is cut off, not rounded (Fasi, Higham, Mikaitis, Pranesh: Numerical behavior of NVIDIA tensor cores, 2021).
/// Cuts of one group are of either sign but those of the sum itself, so that one unit in the last place for each group
/// of 8 is several times what is to be expected, and far below what a wrong operand would do.
double bf16_sum_error(int depth) { return (depth + 7) / 8 * 0x1p-23; }

TensorMap map_rows(const MappedRows& of) {
  TensorMap map = {};
  const Status made = machine().gpu->map_rows(of, map);
  if (!made.ok()) throw Fault(made.error().message());
  return map;
}

TensorMap map_heads(const MappedHeads& of) {
  TensorMap map = {};
  const Status made = machine().gpu->map_heads(of, map);
  if (!made.ok()) throw Fault(made.error().message());
  return map;
}

void launch(const Launch& how, const void* job, std::size_t) {
  Machine& m = machine();
  Status status = m.gpu->use();
  if (status) status = m.stream.launch_job(how, job);
  if (status) status = m.stream.wait();
  if (!status) throw Fault(std::string(how.kernel) + ": " + status.error().message());
}

}  // namespace vla::test::cuda
