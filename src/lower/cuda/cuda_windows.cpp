// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_windows.h"

namespace vla::lower {

Result<std::shared_ptr<CudaWindows>> CudaWindows::open(std::shared_ptr<CudaQueue> queue, cuda::Address device,
                                                       std::size_t size) {
  const std::shared_ptr<cuda::Gpu> gpu = queue->gpu();
  VLA_CHECK(gpu->use());
  VLA_TRY(cuda::Stream copies, gpu->stream());
  std::shared_ptr<CudaWindows> windows(new CudaWindows(std::move(queue), std::move(copies), device, size));
  for (Window& window : windows->windows_) {
    VLA_TRY(window.read, gpu->event(false));
  }
  VLA_TRY(windows->host_, gpu->allocate_host(WeightStream::kWindows * size));
  return windows;
}

CudaWindows::~CudaWindows() { static_cast<void>(queue_->gpu()->use()); }

std::byte* CudaWindows::host(std::size_t group) const { return static_cast<std::byte*>(host_.get()) + offset(group); }

Status CudaWindows::start(std::shared_ptr<const Content> content, std::vector<std::vector<PackPart>> groups,
                          std::vector<std::size_t> sizes, int n_thread) {
  sizes_ = std::move(sizes);
  VLA_TRY(stream_, WeightStream::start(std::move(content), std::move(groups), n_thread));
  return {};
}

Status CudaWindows::bring(const Groups& groups) {
  VLA_CHECK(queue_->flush());
  VLA_CHECK(queue_->keep(note_read()));
  reading_ = groups;
  for (int group = groups.first; group <= groups.last; ++group)
    if (window(group).held != group) VLA_CHECK(upload(group));
  return {};
}

/// What reads the windows was launched: they are free when it has ended.
Status CudaWindows::note_read() {
  if (!reading_.any()) return {};
  for (int group = reading_.first; group <= reading_.last; ++group) VLA_CHECK(queue_->record(window(group).read));
  return {};
}

Status CudaWindows::upload(int group) {
  window(group).held = -1;
  VLA_CHECK(stream_->bring(group, group));
  VLA_CHECK(queue_->keep(copy(group)));
  stream_->release(group);
  window(group).held = group;
  return {};
}

/// Waits until the group is there: then its kernels may be launched, and the host's window be filled with another one.
/// Kernels of the groups before compute meanwhile.
Status CudaWindows::copy(int group) {
  const auto i = static_cast<std::size_t>(group);
  VLA_CHECK(queue_->gpu()->use());
  VLA_CHECK(copies_.after(window(group).read));
  VLA_CHECK(copies_.upload(device(i), host(i), sizes_[i]));
  return copies_.wait();
}

}  // namespace vla::lower
