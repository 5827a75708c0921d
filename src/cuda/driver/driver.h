// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "base/result.h"

/// A table of the functions of NVIDIA's driver that we call. With it the build needs no NVIDIA software, and a test can
/// use its own driver. Source: CUDA Driver API 13.0.
namespace vla::cuda {

using Address = std::uint64_t;  // CUdeviceptr
using Handle = void*;           // a context, stream, event, module, function or graph

/// CUlaunchAttribute. An int value, or a cluster's three sizes of 4 bytes, are stored in the first bytes of `value`.
struct LaunchAttribute {
  int id, padding;
  std::uint64_t value[8];
};
/// CUlaunchConfig.
struct LaunchConfig {
  unsigned grid_x, grid_y, grid_z, block_x, block_y, block_z, shared;
  Handle stream;
  LaunchAttribute* attributes;
  unsigned n_attribute;
};

/// Name in the table, symbol of libcuda, parameters. All return a CUresult, 0 for success.
#define VLA_CUDA_CALLS(CALL)                                                                                   \
  CALL(init, cuInit, unsigned flags)                                                                           \
  CALL(error_name, cuGetErrorName, int error, const char** name)                                               \
  CALL(error_text, cuGetErrorString, int error, const char** text)                                             \
  CALL(driver_version, cuDriverGetVersion, int* version)                                                       \
  CALL(device_count, cuDeviceGetCount, int* count)                                                             \
  CALL(device_get, cuDeviceGet, int* device, int ordinal)                                                      \
  CALL(device_attribute, cuDeviceGetAttribute, int* value, int attribute, int device)                          \
  CALL(device_name, cuDeviceGetName, char* name, int size, int device)                                         \
  CALL(memory_size, cuDeviceTotalMem_v2, std::size_t* size, int device)                                        \
  CALL(context_retain, cuDevicePrimaryCtxRetain, Handle* context, int device)                                  \
  CALL(context_release, cuDevicePrimaryCtxRelease_v2, int device)                                              \
  CALL(context_use, cuCtxSetCurrent, Handle context)                                                           \
  CALL(memory_info, cuMemGetInfo_v2, std::size_t* free, std::size_t* total)                                    \
  CALL(allocate, cuMemAlloc_v2, Address* address, std::size_t size)                                            \
  CALL(release, cuMemFree_v2, Address address)                                                                 \
  CALL(host_allocate, cuMemHostAlloc, void** memory, std::size_t size, unsigned flags)                         \
  CALL(host_release, cuMemFreeHost, void* memory)                                                              \
  CALL(fill, cuMemsetD8Async, Address to, unsigned char value, std::size_t size, Handle stream)                \
  CALL(upload, cuMemcpyHtoDAsync_v2, Address to, const void* from, std::size_t size, Handle stream)            \
  CALL(copy, cuMemcpyDtoDAsync_v2, Address to, Address from, std::size_t size, Handle stream)                  \
  CALL(download, cuMemcpyDtoHAsync_v2, void* to, Address from, std::size_t size, Handle stream)                \
  CALL(stream_create, cuStreamCreate, Handle* stream, unsigned flags)                                          \
  CALL(stream_destroy, cuStreamDestroy_v2, Handle stream)                                                      \
  CALL(stream_wait, cuStreamSynchronize, Handle stream)                                                        \
  CALL(stream_wait_event, cuStreamWaitEvent, Handle stream, Handle event, unsigned flags)                      \
  CALL(event_create, cuEventCreate, Handle* event, unsigned flags)                                             \
  CALL(event_record, cuEventRecord, Handle event, Handle stream)                                               \
  CALL(event_record_flags, cuEventRecordWithFlags, Handle event, Handle stream, unsigned flags)                \
  CALL(event_elapsed, cuEventElapsedTime, float* ms, Handle first, Handle second)                              \
  CALL(event_destroy, cuEventDestroy_v2, Handle event)                                                         \
  CALL(module_load, cuModuleLoadDataEx, Handle* module, const void* image, unsigned n_option, int* options,    \
       void** values)                                                                                          \
  CALL(module_function, cuModuleGetFunction, Handle* function, Handle module, const char* name)                \
  CALL(module_unload, cuModuleUnload, Handle module)                                                           \
  CALL(function_attribute, cuFuncSetAttribute, Handle function, int attribute, int value)                      \
  CALL(launch, cuLaunchKernelEx, const LaunchConfig* config, Handle function, void** parameters, void** extra) \
  CALL(capture_begin, cuStreamBeginCapture_v2, Handle stream, int mode)                                        \
  CALL(capture_end, cuStreamEndCapture, Handle stream, Handle* graph)                                          \
  CALL(graph_instantiate, cuGraphInstantiateWithFlags, Handle* executable, Handle graph, std::uint64_t flags)  \
  CALL(graph_launch, cuGraphLaunch, Handle executable, Handle stream)                                          \
  CALL(graph_destroy, cuGraphDestroy, Handle graph)                                                            \
  CALL(executable_destroy, cuGraphExecDestroy, Handle executable)                                              \
  CALL(tensor_map, cuTensorMapEncodeTiled, void* map, int type, unsigned n_dimension, void* address,           \
       const std::uint64_t* sizes, const std::uint64_t* strides, const unsigned* box, const unsigned* steps,   \
       int interleave, int swizzle, int promotion, int fill)

struct Driver {
#define VLA_CUDA_CALL(name, symbol, ...) int (*name)(__VA_ARGS__) = nullptr;
  VLA_CUDA_CALLS(VLA_CUDA_CALL)
#undef VLA_CUDA_CALL
};

/// Loads the machine's driver. Errors: device, if there is none or it lacks a function.
Result<Driver> load_driver();

}  // namespace vla::cuda
