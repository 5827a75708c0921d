// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "base/cpu.h"
#include "graph/graph.h"
#include "graph/rounding.h"
#include "graph/work.h"

namespace vla {

/// The type that operands of large products are rounded to; sums are float32, but integers for int8 products.
enum class Precision { f32, bf16, int8 };

constexpr const char* precision_name(Precision precision) {
  switch (precision) {
    case Precision::bf16:
      return "bf16";
    case Precision::int8:
      return "int8";
    case Precision::f32:
      break;
  }
  return "f32";
}

/// A graph compiled for a device. Its memory is allocated and it can run any number of times.
class Program {
 public:
  using Time = std::chrono::steady_clock::time_point;
  virtual ~Program() = default;

  /// Computes the values that depend only on inputs that do not change from run to run (LowerOptions::varying). Errors:
  /// device; bad_bundle if table rows are read from a file that has changed since it was opened.
  virtual Status prepare() { return {}; }
  /// Errors: those of `prepare`.
  virtual Status run() = 0;

  struct Stage {
    std::string name;
    Time done;  // when the stage ended in the last run
  };
  virtual const std::vector<Stage>& stages() const = 0;
  /// The time at which the last run ended, for a device that still computes when `run` returns. Stage times are valid
  /// after a result is read.
  virtual std::optional<Time> ended() const { return {}; }
  /// The work of a run: one entry per stage, then one for everything after the last stage.
  virtual std::vector<Work> work() const = 0;
  /// The predicted time of a run: by a model of a device that is not present, or from timed parts of the program.
  struct Prediction {
    double seconds = 0;
    // Seconds that each kind of work takes alone: products at their units' rate, bytes at the memory's rate, and
    // launches. Where they overlap, `seconds` is less than their sum.
    double products = 0, bytes = 0, launches = 0;
    int n_launch = 0;

    Prediction& operator+=(const Prediction& other) {
      seconds += other.seconds, products += other.products, bytes += other.bytes, launches += other.launches;
      n_launch += other.n_launch;
      return *this;
    }
  };
  /// One entry per stage, one for everything after the last stage, and one for `prepare`. Empty if the device predicts
  /// nothing.
  virtual std::vector<Prediction> predictions() const { return {}; }

  struct Tap {
    std::string path;
    Shape shape;
  };
  virtual const std::vector<Tap>& taps() const = 0;
  /// The values of tap i in the last run.
  virtual std::vector<float> tap(std::size_t i) const = 0;

  /// One line per operation: what it computes, the kernel, the layout and the cost.
  virtual std::string text() const = 0;
  /// Bytes that only this program uses.
  virtual std::size_t size() const = 0;
};

/// Receives a tap's values in order. They are valid during the call only.
using TapVisitor =
    std::function<void(const std::string& path, std::span<const std::int64_t> shape, std::span<const float> values)>;

/// Options for lowering a graph.
struct LowerOptions {
  /// Slots that change from run to run. If given, Program::prepare computes the values that depend on none of them.
  std::vector<const Slot*> varying;
  /// Receives each tap's values during `run`, as soon as they are computed, so that none is kept. Only our own kernels
  /// for CPUs call it; other programs ignore it and fill Program::taps.
  TapVisitor see_tap = {};
};

/// An available device.
struct DeviceInfo {
  std::string name, description;
  std::size_t memory = 0, free = 0;  // bytes; `free` is 0 if only an opened device can report it
  std::string precision;             // supported precisions of products: "f32, bf16"
};

/// The matrices to stream in every act, if memory is too small for all of them.
struct WeightPlan {
  /// Matrices that are read from the bundle's file in every act, in groups, in the order in which the prefix reads
  /// them. If empty, all matrices stay in memory.
  std::vector<std::vector<const Param*>> streamed;
  std::size_t window = 0;    // bytes of memory for the largest group
  std::size_t n_read = 0;    // bytes that an act reads from the file
  std::size_t smallest = 0;  // least memory for parameters, in bytes
};

/// A device that runs graphs. It owns parameters, slots and working memory, and lowers graphs for itself.
class Device {
 public:
  virtual ~Device() = default;

  /// Loads the parameters in this device's layout, except those that `plan` streams. Every parameter must have its
  /// source: call ParamList::report first. With `fill` false it reserves memory without touching it, which is enough to
  /// learn sizes and needs no source. Errors: out_of_memory, bad_bundle, device.
  virtual Status load(const ParamList& params, bool fill, const WeightPlan& plan = {}) = 0;
  /// Plans which matrices to stream so that parameters take at most `size` bytes, or as few as possible. An act runs
  /// `prefix` once and `step` several times; both were lowered after a `load` of all parameters, with or without
  /// `fill`. Errors: unsupported for devices that keep all parameters.
  virtual Result<WeightPlan> plan_weights(const Program& /*prefix*/, const Program& /*step*/,
                                          std::size_t /*size*/) const {
    return Error{Code::unsupported, "memory", "our own kernels, or Vulkan, which read matrices as they need them",
                 name() + ", which keeps all of them", "leave the budget out, or use --device cpu"};
  }
  /// Allocates slots, filled with zeros. Errors: out_of_memory.
  virtual Status allocate(Slots& slots) = 0;
  /// Fills a slot. The caller may reuse `data` at once, unless it is in host_memory.
  virtual void set(const Slot& slot, const void* data, std::size_t size) = 0;
  virtual void get(const Slot& slot, void* data, std::size_t size) const = 0;
  /// Memory that the device reads directly, so `set` does not copy it: leave its values unchanged until a result that
  /// uses them is read. It may outlive the device. Any thread may call this function. Null if the device or its memory
  /// cannot do this.
  virtual std::shared_ptr<float[]> host_memory(std::size_t /*n*/) { return nullptr; }
  /// Bytes that were sent ahead to a device while it computes. Keep this object until a result that uses them is read.
  class Sent {
   public:
    virtual ~Sent() = default;
  };
  /// Copies bytes to the device ahead of their use; the caller may reuse them afterwards. Any thread may call it. Null
  /// if the device or its memory cannot do this: set the slot instead. A failure is reported by the device's next call.
  virtual std::unique_ptr<Sent> send(const void* /*data*/, std::size_t /*size*/) { return nullptr; }
  /// Fills a slot with bytes from an earlier `send` of this device. Their number must be the slot's size.
  virtual void take(const Slot& /*slot*/, const Sent& /*sent*/) {}
  /// The first error of the device; every later call fails too. Errors: device, out_of_memory.
  virtual Status failure() const { return {}; }
  /// Compiles a graph whose slots have memory. The graph is not needed afterwards. Errors: out_of_memory, internal,
  /// unsupported for sizes without a kernel.
  virtual Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options = {}) = 0;

  /// For display: "cpu, 2 threads".
  virtual std::string name() const = 0;
  virtual int n_thread() const = 0;
  /// Whether the device computes on the CPU cores that also preprocess observations.
  virtual bool is_host() const { return true; }
  /// The kernels' name, as `--kernels` takes it.
  virtual std::string kernels() const = 0;
  /// The features of the processor that its kernels use, if any.
  virtual Features features() const { return {}; }
  /// The precision of the large products.
  virtual Precision precision() const = 0;
  /// The rounding that large matrices get at load.
  virtual Rounding rounding() const = 0;
  /// Whether bf16 products would be faster on this device (graph/rounding.h).
  virtual bool has_bf16() const = 0;
  /// The kernels of the matrix products, with the number of matrices per encoding: `avx2 (98 bf16)`.
  virtual const std::string& linear_kernels() const = 0;
  /// Bytes of parameters, and bytes that running programs share.
  virtual std::size_t weights_size() const = 0;
  virtual std::size_t working_size() const = 0;
  /// Starts counting the time of each kind of operation from zero, or stops.
  virtual void count_times(bool /*on*/) {}
  /// The counted times, in seconds summed over threads. Empty if the device does not count times.
  virtual std::vector<std::pair<std::string, double>> times() const { return {}; }
  /// Touches all pages of the shared memory, so that no request waits for page faults.
  virtual void touch() {}

  std::vector<float> get(const Slot& slot) const {
    std::vector<float> values(static_cast<std::size_t>(count(slot.shape)));
    get(slot, values.data(), slot.size());
    return values;
  }
};

}  // namespace vla
