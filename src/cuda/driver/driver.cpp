// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/driver/driver.h"

#include <dlfcn.h>

#include <cstdlib>

#include "cuda/driver/compiler_cache.h"

namespace vla::cuda {

Result<Driver> load_driver() {
  if (const std::string folder = compiler_cache(); !folder.empty()) setenv("CUDA_CACHE_PATH", folder.c_str(), 0);
  constexpr const char* kFile = "libcuda.so.1";
  void* library = dlopen(kFile, RTLD_NOW | RTLD_LOCAL);  // never closed: its threads keep running
  if (library == nullptr) return Error{Code::device, "cuda", "NVIDIA's driver", dlerror()};
  Driver driver;
#define VLA_CUDA_CALL(name, symbol, ...)                                             \
  driver.name = reinterpret_cast<decltype(driver.name)>(dlsym(library, #symbol));    \
  if (driver.name == nullptr)                                                        \
    return Error{Code::device, kFile, #symbol, "a driver that has no such function", \
                 "install a driver for CUDA 12.6 or newer"};
  VLA_CUDA_CALLS(VLA_CUDA_CALL)
#undef VLA_CUDA_CALL
  return driver;
}

}  // namespace vla::cuda
