// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "cuda/driver/gpu.h"
#include "graph/device.h"

namespace vla::lower {

class CudaSent;

/// Sends bytes to a device while it computes, over a separate stream. The bytes go to memory of their own, because the
/// previous act may still read the slots. Safe for any thread.
class CudaSender : public std::enable_shared_from_this<CudaSender> {
 public:
  /// Errors: device.
  static Result<std::shared_ptr<CudaSender>> open(std::shared_ptr<cuda::Gpu> gpu);
  ~CudaSender();

  /// Returns null if memory is short.
  std::unique_ptr<CudaSent> send(const void* data, std::size_t size);

 private:
  friend class CudaSent;
  /// Page-locked host memory, device memory of the same size, and the event recorded after the copy.
  struct Parcel {
    std::size_t size;
    cuda::Owned host;
    cuda::Buffer device;
    cuda::Owned arrived;
  };
  CudaSender(std::shared_ptr<cuda::Gpu> gpu, cuda::Stream stream) : gpu_(std::move(gpu)), stream_(std::move(stream)) {}
  Result<std::unique_ptr<Parcel>> take(std::size_t size);
  Result<std::unique_ptr<Parcel>> start(const void* data, std::size_t size);
  void give_back(std::unique_ptr<Parcel> parcel);

  std::shared_ptr<cuda::Gpu> gpu_;
  cuda::Stream stream_;
  std::mutex mutex_;
  std::vector<std::unique_ptr<Parcel>> idle_;  // parcels for reuse
  std::size_t n_made_ = 0;
};

/// A sent parcel, or the error that prevented it.
class CudaSent final : public Device::Sent {
 public:
  ~CudaSent() override;
  Status status() const { return parcel_ ? Status() : parcel_.error(); }
  // Only if the parcel was sent:
  cuda::Address address() const { return (*parcel_)->device.address(); }
  const cuda::Owned& arrived() const { return (*parcel_)->arrived; }

 private:
  friend class CudaSender;
  using Parcel = std::unique_ptr<CudaSender::Parcel>;
  CudaSent(std::shared_ptr<CudaSender> sender, Result<Parcel> parcel)
      : sender_(std::move(sender)), parcel_(std::move(parcel)) {}

  std::shared_ptr<CudaSender> sender_;
  Result<Parcel> parcel_;
};

}  // namespace vla::lower
