// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lower/cuda/cuda_queue.h"
#include "lower/host/device_windows.h"

namespace vla::lower {

/// Copies groups of matrices into windows of device memory over a separate stream, while kernels read other windows.
/// The host's windows are page-locked, so that the device reads them directly.
class CudaWindows final : public WindowMemory {
 public:
  /// device: address of the first window; each has `size` bytes. Errors: device, out_of_memory.
  static Result<std::unique_ptr<WindowMemory>> open(std::shared_ptr<CudaQueue> queue, cuda::Address device,
                                                    std::size_t size);
  ~CudaWindows() override;

  std::byte* host(int window) override { return static_cast<std::byte*>(host_.get()) + offset(window); }
  Status note_read(int window) override;
  Status upload(int window, std::size_t size) override;

 private:
  CudaWindows(std::shared_ptr<CudaQueue> queue, cuda::Stream copies, cuda::Address device, std::size_t size)
      : queue_(std::move(queue)), copies_(std::move(copies)), device_(device), size_(size) {}
  std::size_t offset(int window) const { return static_cast<std::size_t>(window) * size_; }
  /// The event recorded after the kernels that have read a window so far.
  const cuda::Owned& read(int window) const { return read_[static_cast<std::size_t>(window)]; }
  Status copy(int window, std::size_t size);

  std::shared_ptr<CudaQueue> queue_;
  cuda::Stream copies_;
  cuda::Address device_;
  std::size_t size_;
  cuda::Owned host_;
  std::array<cuda::Owned, WeightStream::kWindows> read_;
};

}  // namespace vla::lower
