// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <cstddef>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "lower/cuda/cuda_sender.h"

namespace vla::lower {

/// Parameters, slots and values begin at multiples of it.
constexpr std::size_t kDeviceAlignment = 256;
constexpr std::size_t device_aligned(std::size_t size) {
  return (size + kDeviceAlignment - 1) / kDeviceAlignment * kDeviceAlignment;
}

/// A launch and what the kernel takes.
struct Call {
  cuda::Launch how;
  std::vector<std::byte> job;
};
/// Launches one after the other.
using Calls = std::vector<Call>;

/// Phases that are launched together, one after the other; the operations of each are independent.
struct CudaPart {
  using Time = std::chrono::steady_clock::time_point;
  /// Has a time noted that is behind so many phases.
  struct Mark {
    std::size_t n_phase;
    cuda::Owned event;
    Time* time;
  };
  std::vector<std::vector<Calls>> phases;
  std::vector<Mark> marks;  // in the order of phases
};

/// A device's work, in order. Parts are launched when a result is wanted or an input changes: then all
/// since are one graph, which is captured the first time that these parts follow each other. So an act is one launch.
/// The first failure is kept, and is the answer to every later call. Errors: device, out_of_memory.
class CudaQueue {
 public:
  static Result<std::unique_ptr<CudaQueue>> open(const cuda::Driver& driver, int index,
                                                 const std::vector<std::string>& modules);
  /// A queue without a device: dry from the beginning.
  CudaQueue(int n_sm, bool is_hopper) : n_sm_(n_sm), is_hopper_(is_hopper), is_dry_(true) {}
  ~CudaQueue();

  int n_sm() const { return n_sm_; }
  /// Whether kernels for Hopper alone run.
  bool is_hopper() const { return is_hopper_; }
  /// As the driver names the device.
  std::string device_name() const { return gpu_ ? gpu_->name() : ""; }
  const Status& failure() const { return failure_; }
  /// Whether nothing is allocated from now on, and what would be written is passed over.
  void set_dry(bool dry) { is_dry_ = dry; }

  /// Device memory, which the caller gives back before the queue goes.
  Result<std::shared_ptr<cuda::Buffer>> allocate(std::size_t size, const std::string& what);
  Status fill_zeros(const cuda::Buffer& memory);
  /// For a mark.
  Result<cuda::Owned> event();
  /// Bytes on their way to the device, before what runs next. Those that lie side by side there go together. They are
  /// the caller's again.
  void set(cuda::Address to, const void* from, std::size_t size);
  /// Bytes ahead of the act that takes them, from any thread; null of a dry device, and where memory is short.
  std::unique_ptr<CudaSent> send(const void* data, std::size_t size);
  void take(cuda::Address to, const CudaSent& sent, std::size_t size);
  /// As `set`, at once, for much.
  Status upload(cuda::Address to, const void* from, std::size_t size);
  /// The part must stay until it is forgotten.
  Status run(const CudaPart& part);
  /// Waits for all that was asked for. Marks have their times then.
  void get(void* to, cuda::Address from, std::size_t size);
  /// Launches what was asked for.
  Status flush();
  /// `event` stands for all that was launched.
  Status record(const cuda::Owned& event);
  /// Keeps the first failure of the device, also of a stream beside the queue's.
  Status keep(Status status);
  /// Null of a queue without a device.
  const std::shared_ptr<cuda::Gpu>& gpu() const { return gpu_; }
  /// A part that goes.
  void forget(const CudaPart& part);

 private:
  using Parts = std::vector<const CudaPart*>;
  explicit CudaQueue(std::shared_ptr<cuda::Gpu> gpu)
      : n_sm_(gpu->n_sm()), is_hopper_(gpu->is_hopper()), is_dry_(false), gpu_(std::move(gpu)) {}
  /// Bytes in host memory that the device reads and writes by itself.
  struct HostMemory {
    cuda::Owned memory;
    std::size_t size = 0;
    std::byte* at(std::size_t offset) const { return static_cast<std::byte*>(memory.get()) + offset; }
  };
  struct Upload {
    cuda::Address to;
    std::size_t begin, size;  // in staging_
  };

  Status grow(HostMemory& memory, std::size_t size);
  Status stage(cuda::Address to, const void* from, std::size_t size);
  Status copy(cuda::Address to, const CudaSent& sent, std::size_t size);
  Status download(void* to, cuda::Address from, std::size_t size);
  Status start_uploads();
  Status launch();
  Status wait();
  Status note_times();
  Status capture(const Parts& parts);
  Status capture(const CudaPart& part);

  int n_sm_;
  bool is_hopper_;
  bool is_dry_;
  cuda::Address next_ = 1 << 20;  // where memory would lie that is not allocated
  std::shared_ptr<cuda::Gpu> gpu_;
  std::unique_ptr<cuda::Stream> main_;
  std::vector<cuda::Stream> side_;
  cuda::Owned end_;  // of a graph
  std::shared_ptr<CudaSender> sender_;
  HostMemory staging_, landing_;
  std::size_t n_staged_ = 0;  // bytes that are not to be written over
  std::vector<Upload> uploads_;
  Parts pending_, launched_;
  std::size_t n_pending_ = 0;  // launches
  std::map<Parts, cuda::Owned> graphs_;
  Status failure_;
};

}  // namespace vla::lower
