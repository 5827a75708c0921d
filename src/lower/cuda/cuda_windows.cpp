// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_windows.h"

namespace vla::lower {

Result<std::unique_ptr<WindowMemory>> CudaWindows::open(std::shared_ptr<CudaQueue> queue, cuda::Address device,
                                                        std::size_t size) {
  const std::shared_ptr<cuda::Gpu> gpu = queue->gpu();
  VLA_CHECK(gpu->use());
  VLA_TRY(cuda::Stream copies, gpu->stream());
  std::unique_ptr<CudaWindows> windows(new CudaWindows(std::move(queue), std::move(copies), device, size));
  for (cuda::Owned& event : windows->read_) {
    VLA_TRY(event, gpu->event(false));
  }
  VLA_TRY(windows->host_, gpu->allocate_host(WeightStream::kWindows * size));
  return std::unique_ptr<WindowMemory>(std::move(windows));
}

CudaWindows::~CudaWindows() { static_cast<void>(queue_->gpu()->use()); }

Status CudaWindows::note_read(int window) { return queue_->keep(queue_->record(read(window))); }

Status CudaWindows::upload(int window, std::size_t size) { return queue_->keep(copy(window, size)); }

Status CudaWindows::copy(int window, std::size_t size) {
  VLA_CHECK(queue_->gpu()->use());
  VLA_CHECK(copies_.after(read(window)));
  VLA_CHECK(copies_.upload(device_ + offset(window), host(window), size));
  return copies_.wait();
}

}  // namespace vla::lower
