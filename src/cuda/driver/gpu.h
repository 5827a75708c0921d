// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <memory>
#include <string>
#include <vector>

#include "cuda/driver/driver.h"
#include "cuda/kernels/launch.h"

/// A device and what it holds. Every failure of the driver is a typed Error that names the call: out_of_memory where
/// the driver says so, else device. Nothing is released twice, and failures while releasing are passed over.
namespace vla::cuda {

/// Something of the driver's that ends with this object.
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

/// Device memory; it goes before the device does. Without a Gpu it is none, and its address says where it would lie.
class Buffer {
 public:
  Buffer(const Gpu* gpu, Address address, std::size_t size) : gpu_(gpu), address_(address), size_(size) {}
  Buffer(Buffer&& other) noexcept : gpu_(other.gpu_), address_(other.address_), size_(other.size_) {
    other.address_ = 0;
  }
  Buffer& operator=(Buffer&&) = delete;
  ~Buffer();
  /// As kernels' jobs take it; the host must not follow it.
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

/// Operations in order. Between streams only events order them.
class Stream {
 public:
  Status fill(Address to, unsigned char value, std::size_t size);
  /// Host memory must stay until the stream was waited for.
  Status upload(Address to, const void* from, std::size_t size);
  Status download(void* to, Address from, std::size_t size);
  /// On the device.
  Status copy(Address to, Address from, std::size_t size);
  template <class Job>
  Status launch(const Launch& how, const Job& job) {
    return launch_job(how, &job);
  }
  /// `job` points at what the kernel takes.
  Status launch_job(const Launch& how, const void* job);
  /// Until all operations are done.
  Status wait();
  /// Delays what comes next until all that is in `other` has ended.
  Status after(Stream& other);
  /// `event` stands for all that is in here until now.
  Status record(const Owned& event);
  /// Delays what comes next until all has ended that `event` stands for.
  Status after(const Owned& event);
  /// While operations are captured: has `event` note the time whenever the graph comes here.
  Status note_time(const Owned& event);

  /// Operations, also of streams that come after this one, become a graph instead of running; those must be waited for
  /// with after() before the end.
  Status begin_capture();
  /// The graph, as it is launched.
  Result<Owned> end_capture();
  Status launch(const Owned& graph);

 private:
  friend class Gpu;
  Stream(Gpu& gpu, Owned stream, Owned event) : gpu_(&gpu), stream_(std::move(stream)), event_(std::move(event)) {}

  Gpu* gpu_;
  Owned stream_, event_;
};

/// A GPU that may be opened.
struct GpuInfo {
  std::string name, driver;
  std::size_t memory;  // bytes
};
/// In the order of their numbers. Errors: device where there is none, or the driver is too old, with the reason as
/// `found`.
Result<std::vector<GpuInfo>> list_gpus(const Driver& driver);

class Gpu {
 public:
  /// Driver version and compute capability that our kernels need.
  static constexpr int kMinDriver = 12060, kMinCapability = 80;

  /// Takes the device's context and loads the modules, texts of PTX.
  static Result<std::unique_ptr<Gpu>> open(const Driver& driver, int device, const std::vector<std::string>& modules);
  Gpu(const Gpu&) = delete;
  ~Gpu();

  /// Makes this the device of the calling thread, which it must be for every call of the driver. What allocates or
  /// gives back does so itself.
  Status use() const;

  /// Blocks of big kernels that run at a time, about.
  int n_sm() const { return n_sm_; }
  const std::string& name() const { return name_; }
  /// Has the driver load a kernel and allow it its shared memory, as the first launch does. Before a capture: a driver
  /// may have to wait or to allocate for it, which no stream that captures allows.
  Status prepare(const Launch& how);
  /// out_of_memory with both sizes where less is free.
  Result<Buffer> allocate(std::size_t size, const std::string& what);
  /// Memory of the host that the device reads and writes without the processor.
  Result<Owned> allocate_host(std::size_t size);
  Result<Stream> stream();
  /// For Stream::note_time, or for `record` where it has no time.
  Result<Owned> event(bool has_time);
  /// Milliseconds between the times that two events noted.
  Result<float> elapsed(const Owned& first, const Owned& second) const;
  /// Bytes of device memory.
  Result<std::size_t> free_memory() const;

 private:
  friend class Buffer;
  friend class Stream;
  explicit Gpu(const Driver& driver) : driver_(driver) {}
  Status start(int device, const std::vector<std::string>& modules);
  Result<Owned> load(const std::string& module) const;
  Result<Handle> kernel(const Launch& how);
  Status check(const char* call, int result) const;
  /// Checks a call that made a handle.
  Result<Owned> own(const char* call, int result, Handle handle, Owned::Release release) const;

  Driver driver_;
  int device_ = -1, n_sm_ = 1;
  std::string name_;
  Handle context_ = nullptr;
  std::vector<Owned> modules_;
  struct Function {
    Handle handle;
    unsigned shared;  // bytes that it is allowed
  };
  std::map<std::string, Function> functions_;
};

}  // namespace vla::cuda
