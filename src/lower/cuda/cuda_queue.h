// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <cstddef>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "lower/cuda/cuda_sender.h"

namespace vla::lower {

/// Alignment of parameters, slots and values in device memory, in bytes.
constexpr std::size_t kDeviceAlignment = 256;
constexpr std::size_t device_aligned(std::size_t size) {
  return (size + kDeviceAlignment - 1) / kDeviceAlignment * kDeviceAlignment;
}

/// A launch with its arguments.
struct Call {
  cuda::Launch how;
  std::vector<std::byte> job;
};
/// Launches in order.
using Calls = std::vector<Call>;

/// Phases that are launched together, in order; the operations of a phase are independent.
struct CudaPart {
  using Time = std::chrono::steady_clock::time_point;
  /// Requests a timestamp after `n_phase` phases.
  struct Mark {
    std::size_t n_phase;
    cuda::Owned event;
    Time* time;
  };
  std::vector<std::vector<Calls>> phases;
  std::vector<Mark> marks;  // sorted by phase
};

/// A device's work, in order. Parts are collected until a result is requested or an input changes; then they are
/// launched as one graph, which is captured the first time that these parts follow each other. So an act is one launch.
/// The queue keeps the first failure and returns it from every later call. Errors: device, out_of_memory.
class CudaQueue {
 public:
  static Result<std::unique_ptr<CudaQueue>> open(const cuda::Driver& driver, int index,
                                                 const std::vector<std::string>& modules);
  /// A queue without a device, always dry.
  CudaQueue(int n_sm, bool is_hopper) : n_sm_(n_sm), is_hopper_(is_hopper), is_dry_(true) {}
  ~CudaQueue();

  int n_sm() const { return n_sm_; }
  /// Whether the device runs Hopper kernels (sm_90a).
  bool is_hopper() const { return is_hopper_; }
  const Status& failure() const { return failure_; }
  /// Dry: from now on nothing is allocated and writes are skipped.
  void set_dry(bool dry) { is_dry_ = dry; }

  /// Allocates device memory; free it before the queue is destroyed.
  Result<std::shared_ptr<cuda::Buffer>> allocate(std::size_t size, const std::string& what);
  Status fill_zeros(const cuda::Buffer& memory);
  /// Creates an event for a mark.
  Result<cuda::Owned> event();
  /// Allocates page-locked memory that the device reads directly and that may outlive the queue. Safe for any thread.
  /// Null if the queue is dry or memory is short. The next `set` records any other failure.
  std::shared_ptr<std::byte> host_memory(std::size_t size);
  /// Copies bytes to the device before the next launch. `from` may be reused at once, except in `host_memory`, which is
  /// read when the copy runs. Adjacent copies are joined.
  void set(cuda::Address to, const void* from, std::size_t size);
  /// Sends bytes ahead of the act that reads them, from any thread. Null if the queue is dry or memory is short.
  std::unique_ptr<CudaSent> send(const void* data, std::size_t size);
  void take(cuda::Address to, const CudaSent& sent, std::size_t size);
  /// Like `set`, but copies at once; for large inputs.
  Status upload(cuda::Address to, const void* from, std::size_t size);
  /// Queues a part, which must live until `forget`.
  Status run(const CudaPart& part);
  /// Copies bytes from the device after all queued work; afterwards the marks have their times.
  void get(void* to, cuda::Address from, std::size_t size);
  /// Launches all queued work.
  Status flush();
  /// Records `event` after all launched work.
  Status record(const cuda::Owned& event);
  /// Keeps the device's first failure, also one on another stream, and returns `status`.
  Status keep(Status status);
  /// Null if the queue has no device.
  const std::shared_ptr<cuda::Gpu>& gpu() const { return gpu_; }
  /// Removes a part and the graphs that contain it, after waiting for its queued or launched work.
  void forget(const CudaPart& part);

 private:
  using Parts = std::vector<const CudaPart*>;
  explicit CudaQueue(std::shared_ptr<cuda::Gpu> gpu)
      : n_sm_(gpu->n_sm()), is_hopper_(gpu->is_hopper()), is_dry_(false), gpu_(std::move(gpu)) {}
  /// Page-locked host memory that the device accesses directly.
  struct HostMemory {
    cuda::Owned memory;
    std::size_t size = 0;
    std::byte* at(std::size_t offset) const { return static_cast<std::byte*>(memory.get()) + offset; }
  };
  /// The memory of one host_memory() call, followed by capacity for the act's other inputs, which are uploaded with it.
  struct HostBlock {
    std::shared_ptr<cuda::Gpu> gpu;
    HostMemory memory = {};
    explicit HostBlock(std::shared_ptr<cuda::Gpu> of) : gpu(std::move(of)) {}
    ~HostBlock() { static_cast<void>(gpu->use()); }
  };
  struct Upload {
    cuda::Address to;
    std::byte* from;
    std::size_t size;
    std::shared_ptr<HostBlock> block;  // the block that holds `from`; null: staging_
  };

  Status grow(HostMemory& memory, std::size_t size);
  Status stage(cuda::Address to, const void* from, std::size_t size);
  bool join(cuda::Address to, const void* from, std::size_t size);
  Result<std::shared_ptr<HostBlock>> block_of(const void* from);
  Result<std::shared_ptr<HostBlock>> make_block(std::size_t size);
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
  cuda::Address next_ = 1 << 20;  // the next address of dry allocations
  std::shared_ptr<cuda::Gpu> gpu_;
  std::unique_ptr<cuda::Stream> main_;
  std::vector<cuda::Stream> side_;
  cuda::Owned end_;  // recorded at the end of every graph
  std::shared_ptr<CudaSender> sender_;
  HostMemory staging_, landing_;
  std::size_t n_staged_ = 0;  // bytes that queued copies still read
  std::vector<Upload> uploads_;
  std::vector<std::shared_ptr<HostBlock>> read_;  // blocks that started copies may still read
  std::mutex blocks_mutex_;
  std::vector<std::weak_ptr<HostBlock>> blocks_;
  Status block_failure_;
  Parts pending_, launched_;
  std::size_t n_pending_ = 0;  // launches of pending_
  std::map<Parts, cuda::Owned> graphs_;
  Status failure_;
};

}  // namespace vla::lower
