// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <memory>
#include <string>
#include <vector>

#include "cuda/driver/driver.h"
#include "cuda/kernels/launch.h"
#include "cuda/kernels/tensor_map.h"

/// A device and its resources. A driver failure is an Error that names the call: out_of_memory if the driver reports
/// that, else device. Resources are released once; failures while releasing are ignored.
namespace vla::cuda {

/// Owns a driver object and releases it on destruction.
class Owned {
 public:
  using Release = int (*)(Handle);
  Owned() = default;
  Owned(Handle handle, Release release) : held_(handle, release) {}
  Handle get() const { return held_.get(); }

 private:
  std::unique_ptr<void, Release> held_ = {nullptr, nullptr};
};

class Gpu;

/// Device memory; destroy it before the device. If `gpu` is null, the buffer owns nothing and the address is only
/// planned.
class Buffer {
 public:
  Buffer(const Gpu* gpu, Address address, std::size_t size) : gpu_(gpu), address_(address), size_(size) {}
  Buffer(Buffer&& other) noexcept : gpu_(other.gpu_), address_(other.address_), size_(other.size_) {
    other.address_ = 0;
  }
  Buffer& operator=(Buffer&&) = delete;
  ~Buffer();
  /// The address for kernels' jobs; the host must not dereference it.
  template <class T>
  T* as(std::size_t offset = 0) const {
    return reinterpret_cast<T*>(address_ + offset);
  }
  Address address() const { return address_; }
  std::size_t size() const { return size_; }

 private:
  const Gpu* gpu_;
  Address address_;
  std::size_t size_;
};

/// A stream: its operations run in order. Only events order operations of different streams.
class Stream {
 public:
  Status fill(Address to, unsigned char value, std::size_t size);
  /// Host memory must stay valid until the stream is waited for.
  Status upload(Address to, const void* from, std::size_t size);
  Status download(void* to, Address from, std::size_t size);
  /// Copies within device memory.
  Status copy(Address to, Address from, std::size_t size);
  template <class Job>
  Status launch(const Launch& how, const Job& job) {
    return launch_job(how, &job);
  }
  /// Launches a kernel; `job` points to its parameter. From Hopper on, the kernel may begin before the stream's
  /// previous kernel ends, and waits for the previous kernel's results itself (device.h, wait_for_earlier). Errors:
  /// internal for a cluster on another device than a Hopper.
  Status launch_job(const Launch& how, const void* job);
  /// Waits until all operations are done.
  Status wait();
  /// Makes later operations wait for everything in `other` so far.
  Status after(Stream& other);
  /// Records `event` after everything in this stream so far.
  Status record(const Owned& event);
  /// Makes later operations wait for `event`.
  Status after(const Owned& event);
  /// During capture: adds a node that records the time in `event` at every run of the graph.
  Status note_time(const Owned& event);

  /// Captures operations into a graph instead of running them, also operations of streams that wait for this one. Make
  /// this stream wait for such streams with after() before the capture ends.
  Status begin_capture();
  /// The captured graph, instantiated.
  Result<Owned> end_capture();
  Status launch(const Owned& graph);

 private:
  friend class Gpu;
  Stream(Gpu& gpu, Owned stream, Owned event) : gpu_(&gpu), stream_(std::move(stream)), event_(std::move(event)) {}

  Gpu* gpu_;
  Owned stream_, event_;
  bool follows_kernel_ = false;  // whether the latest operation is a kernel
};

/// A GPU that may be opened.
struct GpuInfo {
  std::string name, driver;
  std::size_t memory;  // bytes
};
/// The devices in order of their index. Errors: device if there is none or the driver is too old, with the reason as
/// `found`.
Result<std::vector<GpuInfo>> list_gpus(const Driver& driver);

/// Makes `map` one for copies of boxes of box_rows rows and 128 bytes of the depth, swizzled as wgmma takes them
/// (hopper.h). What is outside of the rows and the depth is zeros. Nothing is read; the rows need not be there yet.
Status map_rows(const Driver& driver, const MappedRows& of, TensorMap& map);
/// The same for boxes of box_tokens tokens and box_columns columns of one head in one batch. Places are column, head,
/// token and batch.
Status map_heads(const Driver& driver, const MappedHeads& of, TensorMap& map);

class Gpu {
 public:
  /// Driver version and compute capability that our kernels need.
  static constexpr int kMinDriver = 12060, kMinCapability = 80;
  /// The first driver that takes machine code of CUDA 13's compiler.
  static constexpr int kCodeDriver = 13000;

  /// Opens the device's context and loads the modules for its architecture. A module is a PTX text: one for sm_80 is
  /// loaded before Hopper, one for sm_90 from Hopper on, and one for sm_90a on Hopper only. The next entry after a text
  /// may be its machine code (an ELF file) for exactly that architecture. If the driver accepts the machine code, it is
  /// loaded instead and nothing is compiled.
  static Result<std::unique_ptr<Gpu>> open(const Driver& driver, int device, const std::vector<std::string>& modules);
  Gpu(const Gpu&) = delete;
  ~Gpu();

  /// Makes the device current on the calling thread, as every driver call needs. Functions that allocate or free do
  /// this themselves.
  Status use() const;

  /// The number of multiprocessors: about how many blocks of large kernels run at a time.
  int n_sm() const { return n_sm_; }
  const std::string& name() const { return name_; }
  /// Whether the compute capability is 9.0, whose wgmma instructions no other GPU has.
  bool is_hopper() const { return capability_ == 90; }
  /// Loads a kernel and permits it its shared memory, as the first launch would. Call it before a capture: the driver
  /// may have to wait or to allocate memory, which is not allowed while a stream captures.
  Status prepare(const Launch& how);
  /// Errors: out_of_memory, with both sizes, if less memory is free.
  Result<Buffer> allocate(std::size_t size, const std::string& what);
  /// Pinned host memory, which the device reads and writes without the processor.
  Result<Owned> allocate_host(std::size_t size);
  Result<Stream> stream();
  /// For Hopper, see above.
  Status map_rows(const MappedRows& of, TensorMap& map) const { return cuda::map_rows(driver_, of, map); }
  Status map_heads(const MappedHeads& of, TensorMap& map) const { return cuda::map_heads(driver_, of, map); }
  /// Creates an event: with time for Stream::note_time, without for Stream::record.
  Result<Owned> event(bool has_time);
  /// Milliseconds between two recorded events.
  Result<float> elapsed(const Owned& first, const Owned& second) const;
  /// Bytes of device memory.
  Result<std::size_t> free_memory() const;

 private:
  friend class Buffer;
  friend class Stream;
  explicit Gpu(const Driver& driver) : driver_(driver) {}
  Status start(int device, const std::vector<std::string>& modules);
  Result<Owned> load(const std::string& ptx, const std::string* machine_code) const;
  Result<Handle> kernel(const Launch& how);
  Status check(const char* call, int result) const;
  /// Checks a call that creates a handle.
  Result<Owned> own(const char* call, int result, Handle handle, Owned::Release release) const;

  Driver driver_;
  int device_ = -1, n_sm_ = 1, capability_ = 0;
  std::string name_;
  Handle context_ = nullptr;
  std::vector<Owned> modules_;
  Handle unlisted_ = nullptr;  // the module of kernels that no PTX text names; only a test's driver has one
  struct Function {
    Handle module = nullptr, handle = nullptr;
    unsigned shared = 48 << 10;  // bytes of shared memory that the kernel may use
  };
  std::map<std::string, Function> functions_;
};

}  // namespace vla::cuda
