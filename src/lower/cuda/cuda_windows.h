// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lower/cuda/cuda_queue.h"
#include "lower/host/segments.h"
#include "lower/host/weight_stream.h"

namespace vla::lower {

/// The device's half of matrices that have no place of their own: windows that groups of them come to over a stream of
/// its own, while kernels read others. A WeightStream has the groups ready in as many windows of the host, from which
/// the device takes them by itself. One thread at a time may call this.
class CudaWindows {
 public:
  /// device: where the first of the windows is, each of `size` bytes. Errors: device, out_of_memory.
  static Result<std::shared_ptr<CudaWindows>> open(std::shared_ptr<CudaQueue> queue, cuda::Address device,
                                                   std::size_t size);
  CudaWindows(const CudaWindows&) = delete;
  CudaWindows& operator=(const CudaWindows&) = delete;
  ~CudaWindows();

  /// Where a group lies in memory of the host, and of the device.
  std::byte* host(std::size_t group) const;
  cuda::Address device(std::size_t group) const { return device_ + offset(group); }
  /// groups: the parts of each, which go to the host's window; sizes: their bytes there. Errors: out_of_memory.
  Status start(std::shared_ptr<const Content> content, std::vector<std::vector<PackPart>> groups,
               std::vector<std::size_t> sizes, int n_thread);

  /// Has groups on the device for what is asked of the queue next, until others are wanted. What was asked before is
  /// launched. Errors: bad_bundle where the file has not their bytes any more, device.
  Status bring(const Groups& groups);

 private:
  CudaWindows(std::shared_ptr<CudaQueue> queue, cuda::Stream copies, cuda::Address device, std::size_t size)
      : queue_(std::move(queue)), copies_(std::move(copies)), device_(device), size_(size) {}
  struct Window {
    cuda::Owned read;  // stands for all kernels that read it until now
    int held = -1;     // the group in it
  };
  static std::size_t number(std::size_t group) { return static_cast<std::size_t>(WeightStream::window_of(group)); }
  Window& window(int group) { return windows_[number(static_cast<std::size_t>(group))]; }
  std::size_t offset(std::size_t group) const { return number(group) * size_; }
  Status note_read();
  Status upload(int group);
  Status copy(int group);

  std::shared_ptr<CudaQueue> queue_;
  cuda::Stream copies_;
  cuda::Address device_;
  std::size_t size_;
  cuda::Owned host_;
  std::vector<std::size_t> sizes_;
  std::array<Window, WeightStream::kWindows> windows_;
  Groups reading_;                        // by what was asked last
  std::unique_ptr<WeightStream> stream_;  // goes before the memory that it writes to
};

}  // namespace vla::lower
