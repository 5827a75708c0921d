// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// libvla-cuda-ggml.so: ggml's CUDA backend, for --kernels ggml.
#include <cuda_runtime_api.h>
#include <ggml-cuda.h>

#include <stdexcept>
#include <string>

#include "ggml/ggml_library.h"

namespace {

std::string version_text(int version) {
  return std::to_string(version / 1000) + "." + std::to_string(version % 1000 / 10);
}

ggml_backend_reg_t open() {
  int version = 0, n_device = 0;
  if (cudaDriverGetVersion(&version) != cudaSuccess || version == 0) return nullptr;
  const cudaError_t found = cudaGetDeviceCount(&n_device);
  if (found == cudaSuccess) return ggml_backend_cuda_reg();
  throw std::runtime_error(std::string(cudaGetErrorString(found)) + " (a driver for CUDA " + version_text(version) +
                           ")");
}

std::string driver(ggml_backend_dev_t) {
  int newest = 0, runtime = 0;
  cudaDriverGetVersion(&newest);
  cudaRuntimeGetVersion(&runtime);
  return "driver for CUDA " + version_text(newest) + ", runtime " + version_text(runtime);
}

constexpr vla::GgmlBackend kCuda = {"cuda", open, driver};

}  // namespace

const vla::DeviceLibrary* vla_device_library() {
  static const vla::DeviceLibrary library = vla::library_of<kCuda>();
  return &library;
}
