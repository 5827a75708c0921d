// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// libvla-cuda.so: GPUs with our own kernels.
#include "cuda/driver/modules.h"
#include "graph/device_library.h"
#include "lower/cuda/cuda_device.h"

namespace vla {
namespace {

/// Returns the CUDA driver, which is loaded once.
const Result<cuda::Driver>& driver() {
  static const Result<cuda::Driver> loaded = cuda::load_driver();
  return loaded;
}

Result<std::vector<DeviceInfo>> list() {
  if (!driver()) return driver().error();
  VLA_TRY(const std::vector<cuda::GpuInfo> found, cuda::list_gpus(*driver()));
  std::vector<DeviceInfo> devices;
  for (const cuda::GpuInfo& gpu : found)
    devices.push_back({"cuda:" + std::to_string(devices.size()), gpu.name + "; " + gpu.driver, gpu.memory,
                       0 /* its context would have to be made */, "f32, bf16, int8"});
  return devices;
}

Result<std::unique_ptr<Device>> open(int index, Rounding rounding) {
  if (!driver()) return driver().error();
  return lower::CudaDevice::open(*driver(), index, cuda::kernel_modules(), rounding);
}

}  // namespace
}  // namespace vla

const vla::DeviceLibrary* vla_device_library() {
  static const vla::DeviceLibrary library = {vla::kDeviceBuild, vla::list, vla::open, vla::lower::CudaDevice::model};
  return &library;
}
