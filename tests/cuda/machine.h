// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstring>
#include <span>
#include <string>
#include <vector>

#include "cuda/device_memory.h"
#include "cuda/driver/gpu.h"
#include "cuda/kernels/launch.h"
#include "cuda/shared_memory.h"

/// A device that is not there: it runs kernels as the host's compiler made them, or the PTX that nvcc made of them. In
/// test_kernels_gpu it is a real one (library/real_machine.cpp).
namespace vla::test::cuda {

/// Throws Fault where the kernel does what none may, and where a device would refuse the launch.
void launch(const vla::cuda::Launch& launch, const void* job, std::size_t job_size);
template <class Job>
void launch(const vla::cuda::Launch& how, const Job& job) {
  launch(how, &job, sizeof(job));
}

/// As the device's driver maps them. Throws Fault where it refuses to.
vla::cuda::TensorMap map_rows(const vla::cuda::MappedRows& of);
vla::cuda::TensorMap map_heads(const vla::cuda::MappedHeads& of);

/// Whether kernels run as PTX: where VLA_CUDA_PTX names files, FILE:FILE.
bool runs_ptx();

/// Whether kernels for Hopper alone run, too.
bool is_hopper();

/// How far a bf16 product's sum over a depth may be from the exact one, beside the rounding of the result: nothing on
/// the emulated machine, which adds exact products in float32. As a share of the largest result.
double bf16_sum_error(int depth);

/// The files of VLA_CUDA_PTX as texts, or what the fake driver knows the host's kernels by.
std::vector<std::string> modules_of_tests();

/// Values in device memory.
template <class T>
class Device {
 public:
  explicit Device(std::size_t n) : n_(n), data_(static_cast<T*>(device_memory().allocate(n * sizeof(T)))) {}
  explicit Device(const std::vector<T>& values) : Device(values.size()) {
    std::memcpy(data_, values.data(), n_ * sizeof(T));
  }
  Device(const Device&) = delete;
  ~Device() { device_memory().release(data_); }
  T* get() const { return data_; }
  std::vector<T> host() const { return {data_, data_ + n_}; }

 private:
  std::size_t n_;
  T* data_;
};

constexpr Schedule kSchedules[] = {{0, true}, {0, false}, {1, true}, {7, false}};
/// Runs `test` in each schedule of threads and copies.
template <class Test>
void in_every_schedule(Test test) {
  for (const Schedule& one : kSchedules) {
    schedule = one;
    test();
  }
  schedule = {};
}
/// The same in two of them, which `number` chooses: numbers that follow each other try all.
template <class Test>
void in_two_schedules(std::size_t number, Test test) {
  for (const std::size_t i : {number, number + 1}) {
    schedule = kSchedules[i % std::size(kSchedules)];
    test();
  }
  schedule = {};
}

}  // namespace vla::test::cuda
