// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// libvla-cuda.so: ggml's CUDA backend.
#include <cuda_runtime_api.h>
#include <ggml-cuda.h>

#include <stdexcept>
#include <string>

#include "ggml/backend_library.h"

namespace {

ggml_backend_reg_t open() {
  int driver = 0, n_device = 0;
  if (cudaDriverGetVersion(&driver) != cudaSuccess || driver == 0) return nullptr;
  const cudaError_t found = cudaGetDeviceCount(&n_device);
  if (found == cudaSuccess) return ggml_backend_cuda_reg();
  throw std::runtime_error(std::string(cudaGetErrorString(found)) + " (a driver for CUDA " +
                           std::to_string(driver / 1000) + "." + std::to_string(driver % 1000 / 10) + ")");
}

}  // namespace

const vla::BackendLibrary* vla_backend_library() {
  static const vla::BackendLibrary library = {VLA_BACKEND_BUILD, open, ggml_log_set, ggml_set_abort_callback};
  return &library;
}
