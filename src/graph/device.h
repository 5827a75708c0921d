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

/// The type that operands of large products are rounded to; sums are float32, or integers of int8.
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

/// A graph made ready for a device: memory is there, and it can be run as often as wanted.
class Program {
 public:
  using Time = std::chrono::steady_clock::time_point;
  virtual ~Program() = default;

  /// Computes what depends on inputs that stay the same from run to run (LowerOptions::varying). Errors: device, and
  /// bad_bundle where rows of a table are read from a file that has been changed since it was opened.
  virtual Status prepare() { return {}; }
  /// Errors: those of `prepare`.
  virtual Status run() = 0;

  struct Stage {
    std::string name;
    Time done;  // of the last run
  };
  virtual const std::vector<Stage>& stages() const = 0;
  /// When the last run ended, of a device that runs on while `run` returns: then stages too have their times once a
  /// result was got.
  virtual std::optional<Time> ended() const { return {}; }
  /// The work of a run: one entry for each stage, then one for all that follows the last.
  virtual std::vector<Work> work() const = 0;
  /// The time of a run, predicted by a model of a device that is not there, or from parts of the program.
  struct Prediction {
    double seconds = 0;
    // Of them, if nothing overlapped: products at the rate of their units, bytes at the memory's, and launches.
    double products = 0, bytes = 0, launches = 0;
    int n_launch = 0;

    Prediction& operator+=(const Prediction& other) {
      seconds += other.seconds, products += other.products, bytes += other.bytes, launches += other.launches;
      n_launch += other.n_launch;
      return *this;
    }
  };
  /// One entry for each stage, then one for all that follows the last, and one for `prepare`. Empty of other devices.
  virtual std::vector<Prediction> predictions() const { return {}; }

  struct Tap {
    std::string path;
    Shape shape;
  };
  virtual const std::vector<Tap>& taps() const = 0;
  /// Values of tap i in the last run.
  virtual std::vector<float> tap(std::size_t i) const = 0;

  /// One line an operation: what is computed, by what kernel, in which layout, at what cost.
  virtual std::string text() const = 0;
  /// Bytes that belong to this program alone.
  virtual std::size_t size() const = 0;
};

/// Is shown the value of a tap: its elements one after the other, which are gone afterwards.
using TapVisitor =
    std::function<void(const std::string& path, std::span<const std::int64_t> shape, std::span<const float> values)>;

/// How a graph is to be lowered.
struct LowerOptions {
  /// Slots that change from run to run. What depends on none of them is computed by Program::prepare, if this is given.
  std::vector<const Slot*> varying;
  /// Is shown what would be Program::taps: by `run`, as soon as a value is there, so that none is kept. Our own kernels
  /// for CPUs do this; other programs leave it alone and have their taps.
  TapVisitor see_tap = {};
};

/// A device that is there.
struct DeviceInfo {
  std::string name, description;
  std::size_t memory = 0, free = 0;  // bytes; none are free where only opening it would tell
  std::string precision;             // of products: "f32, bf16"
};

/// The matrices to stream in every act, if memory is too small for all of them.
struct WeightPlan {
  /// Those that come from the bundle's file in every act, in groups, in the order in which the prefix reads them.
  /// Empty: all of them stay in memory.
  std::vector<std::vector<const Param*>> streamed;
  std::size_t window = 0;    // bytes of memory that the largest group takes
  std::size_t n_read = 0;    // bytes of the file that an act reads
  std::size_t smallest = 0;  // bytes of memory that parameters take at least
};

/// Something that graphs run on: it keeps parameters, slots and working memory, and lowers graphs for itself.
class Device {
 public:
  virtual ~Device() = default;

  /// Makes the parameters resident but those that `plan` has elsewhere, laid out for this device. Every one must have
  /// its source: call ParamList::report first. `fill` false reserves memory without touching it, which is enough to
  /// learn sizes; no source is needed. Errors: out_of_memory, bad_bundle, device.
  virtual Status load(const ParamList& params, bool fill, const WeightPlan& plan = {}) = 0;
  /// How parameters take at most `size` bytes of memory, or as few as they can. Of each act `prefix` is run once and
  /// `step` several times; both were lowered after a `load` of all parameters, which may have filled nothing. Errors:
  /// unsupported of devices that keep all parameters.
  virtual Result<WeightPlan> plan_weights(const Program& /*prefix*/, const Program& /*step*/,
                                          std::size_t /*size*/) const {
    return Error{Code::unsupported, "memory", "our own kernels, or Vulkan, which read matrices as they need them",
                 name() + ", which keeps all of them", "leave the budget out, or use --device cpu"};
  }
  /// Gives slots memory, filled with zeros. Errors: out_of_memory.
  virtual Status allocate(Slots& slots) = 0;
  virtual void set(const Slot& slot, const void* data, std::size_t size) = 0;
  virtual void get(const Slot& slot, void* data, std::size_t size) const = 0;
  /// Bytes that went ahead to a device that computes. They must stay until a result of what took them was got.
  class Sent {
   public:
    virtual ~Sent() = default;
  };
  /// Sends bytes ahead, which are the caller's again, from any thread. Null where the device, or its memory, is not
  /// made for it: then they are set. What goes wrong on the way is the failure of the device that takes them.
  virtual std::unique_ptr<Sent> send(const void* /*data*/, std::size_t /*size*/) { return nullptr; }
  /// Sets a slot with what this device sent, as large as the slot is.
  virtual void take(const Slot& /*slot*/, const Sent& /*sent*/) {}
  /// The first error of a call of the device, after which no other succeeds. Errors: device, out_of_memory.
  virtual Status failure() const { return {}; }
  /// The graph's slots must have memory; the graph is not needed afterwards. Errors: out_of_memory, internal,
  /// unsupported for sizes that the device has no kernel for.
  virtual Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options = {}) = 0;

  /// For display: "cpu, 2 threads".
  virtual std::string name() const = 0;
  virtual int n_thread() const = 0;
  /// Whether it computes on the cores that also prepare observations.
  virtual bool is_host() const { return true; }
  /// As `--kernels` names them.
  virtual std::string kernels() const = 0;
  /// The features of the processor that its kernels use, if any.
  virtual Features features() const { return {}; }
  /// The precision of the large products.
  virtual Precision precision() const = 0;
  /// The rounding of large matrices when they are loaded.
  virtual Rounding rounding() const = 0;
  /// Whether it has faster products of bf16, for whoever asks for them (graph/rounding.h).
  virtual bool has_bf16() const = 0;
  /// Which kernel multiplies how many matrices, and how those are stored: `avx2 (98 bf16)`.
  virtual const std::string& linear_kernels() const = 0;
  /// Bytes of parameters, and of what programs share while they run.
  virtual std::size_t weights_size() const = 0;
  virtual std::size_t working_size() const = 0;
  /// Counts from now on, from zero, how long each kind of operation takes, or stops counting.
  virtual void count_times(bool /*on*/) {}
  /// The times that were counted: seconds of all threads together. Empty where the device does not know.
  virtual std::vector<std::pair<std::string, double>> times() const { return {}; }
  /// Has the system back the shared memory now, so that no request waits for it.
  virtual void touch() {}

  std::vector<float> get(const Slot& slot) const {
    std::vector<float> values(static_cast<std::size_t>(count(slot.shape)));
    get(slot, values.data(), slot.size());
    return values;
  }
};

}  // namespace vla
