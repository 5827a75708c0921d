// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_sender.h"

#include <cstring>

namespace vla::lower {

Result<std::shared_ptr<CudaSender>> CudaSender::open(std::shared_ptr<cuda::Gpu> gpu) {
  VLA_TRY(cuda::Stream stream, gpu->stream());
  return std::shared_ptr<CudaSender>(new CudaSender(std::move(gpu), std::move(stream)));
}

CudaSender::~CudaSender() { static_cast<void>(gpu_->use()); }

std::unique_ptr<CudaSent> CudaSender::send(const void* data, std::size_t size) {
  Result<std::unique_ptr<Parcel>> parcel = start(data, size);
  if (!parcel && parcel.error().code == Code::out_of_memory) return nullptr;
  return std::unique_ptr<CudaSent>(new CudaSent(shared_from_this(), std::move(parcel)));
}

/// Reuses a parcel whose old bytes are no longer needed. The old bytes may still be in transit: the stream keeps the
/// copies in order.
Result<std::unique_ptr<CudaSender::Parcel>> CudaSender::start(const void* data, std::size_t size) {
  VLA_CHECK(gpu_->use());
  VLA_TRY(std::unique_ptr<Parcel> parcel, take(size));
  std::memcpy(parcel->host.get(), data, size);
  VLA_CHECK(stream_.upload(parcel->device.address(), parcel->host.get(), size));
  VLA_CHECK(stream_.record(parcel->arrived));
  return parcel;
}

Result<std::unique_ptr<CudaSender::Parcel>> CudaSender::take(std::size_t size) {
  std::unique_ptr<Parcel> idle;
  {
    const std::lock_guard lock(mutex_);
    if (!idle_.empty()) idle = std::move(idle_.back()), idle_.pop_back();
  }
  if (idle && idle->size >= size) return idle;
  idle.reset();
  VLA_TRY(cuda::Owned host, gpu_->allocate_host(size));
  VLA_TRY(cuda::Buffer device, gpu_->allocate(size, "images on their way"));
  VLA_TRY(cuda::Owned arrived, gpu_->event(false));
  {
    const std::lock_guard lock(mutex_);
    idle_.reserve(++n_made_);  // so that give_back cannot fail
  }
  return std::unique_ptr<Parcel>(new Parcel{size, std::move(host), std::move(device), std::move(arrived)});
}

void CudaSender::give_back(std::unique_ptr<Parcel> parcel) {
  const std::lock_guard lock(mutex_);
  idle_.push_back(std::move(parcel));
}

CudaSent::~CudaSent() {
  if (parcel_) sender_->give_back(std::move(*parcel_));
}

}  // namespace vla::lower
