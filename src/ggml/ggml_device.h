// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-alloc.h>
#include <ggml-cpp.h>

#include <memory>
#include <optional>

#include "ggml/ggml_memory.h"
#include "ggml/guard.h"
#include "graph/device.h"
#include "graph/rounding.h"
#include "lower/host/device_windows.h"

namespace vla {

/// A ggml backend as a device: it runs graphs as plain ggml operations, without custom nodes. On the CPU it is the
/// reference for every kernel and fusion. ggml_program.cpp translates graphs.
class GgmlDevice final : public Device {
 public:
  /// Errors: device.
  static Result<std::unique_ptr<Device>> cpu(int n_thread);
  /// A device other than the CPU, with Rounding::none or bf16; bf16 also rounds the activations that bf16 matrices
  /// multiply. `keeps_f16`: products of f16 weights are as exact as those of float32. Errors: device.
  static Result<std::unique_ptr<Device>> open(ggml_backend_dev_t of, const std::string& name, bool keeps_f16,
                                              Rounding rounding);
  ~GgmlDevice() override;

  Status load(const ParamList& params, bool fill, const WeightPlan& plan) override;
  Result<WeightPlan> plan_weights(const Program& prefix, const Program& step, std::size_t size) const override;
  Status allocate(Slots& slots) override;
  void set(const Slot& slot, const void* data, std::size_t size) override;
  void get(const Slot& slot, void* data, std::size_t size) const override;
  Status failure() const override;
  Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options) override;

  std::string name() const override { return text_; }
  int n_thread() const override { return n_thread_; }
  bool is_host() const override { return held_->pool != nullptr; }
  std::string kernels() const override { return "ggml"; }
  Precision precision() const override { return precision_; }
  Rounding rounding() const override { return rounding_; }
  bool has_bf16() const override { return !is_host(); }
  const std::string& linear_kernels() const override { return linear_text_; }
  std::size_t weights_size() const override { return weights_size_; }
  std::size_t working_size() const override;

  ggml_backend_t backend() const { return held_->backend.get(); }
  ggml_tensor* weight(const Param* param) const { return weights_[static_cast<std::size_t>(param->id)]; }
  /// For each Param::id the group that streams the matrix, or -1.
  const std::vector<int>& groups() const { return groups_; }
  GgmlMemory& memory() const { return *held_->memory; }
  /// Allocates host memory for uploads, pinned by the driver if it can. Errors: device, out_of_memory.
  Result<ggml_backend_buffer_ptr> allocate_host(std::size_t size) const;
  /// Places a graph's values in memory that all programs share, since one runs at a time. The result keeps the memory
  /// alive. Errors: out_of_memory.
  Result<std::shared_ptr<ggml_gallocr>> place(ggml_cgraph* graph);

  /// Calls a function of the backend. After the first failure every call returns that error. Errors: device,
  /// out_of_memory.
  template <class F>
  Status guarded(const F& call) const {
    if (failure_) return *failure_;
    Status done = vla::guarded(text_, call);
    if (!done) failure_ = done.error();
    return done;
  }
  /// Loads groups of streamed matrices for the next launches, until other groups are requested. Errors: bad_bundle if
  /// the file no longer has these bytes, device.
  Status bring(const lower::Groups& groups);
  /// Starts a graph; it is complete after `wait`. Errors: device, out_of_memory.
  Status launch(ggml_cgraph* graph);
  Status wait();

 private:
  struct FreePool {
    void operator()(ggml_threadpool* pool) const;
  };
  struct Working {
    std::shared_ptr<ggml_gallocr> places;
    std::size_t size;
  };
  /// Bytes for adjacent slots that are being sent to the device.
  struct Upload {
    const ggml_tensor* first;
    std::size_t begin, size;  // in `Held::staging`
  };
  bool is_streamed(const Param& param) const { return groups_[static_cast<std::size_t>(param.id)] >= 0; }
  Status make_tensors(const ParamList& params, const WeightPlan& plan);
  Status give_places(const WeightPlan& plan);
  std::size_t size_of(const Param& matrix) const;
  Status upload(const ParamList& params);
  Status start_stream(const ParamList& params, const WeightPlan& plan);
  std::byte* staging(std::size_t size);
  Status flush() const;

  /// Everything that the driver must free.
  struct Held {
    // The thread pool of all runs. Without it ggml makes and frees one in every run.
    std::unique_ptr<ggml_threadpool, FreePool> pool;
    ggml_backend_ptr backend;
    std::optional<GgmlMemory> memory;
    std::vector<Working> working;  // the last one serves new programs, earlier ones belong to older programs
    ggml_backend_buffer_ptr staging;
    std::shared_ptr<void> windows;  // GgmlWindows::held
    Held* next = nullptr;           // list of leaked devices (see the destructor)
  };
  ggml_type resident_type(const Param& param) const;

  std::unique_ptr<Held> held_ = std::make_unique<Held>();
  std::string text_;
  int n_thread_ = 0;
  bool keeps_f16_ = false;
  Rounding rounding_ = Rounding::none;
  Precision precision_ = Precision::f32;
  ggml_context_ptr weight_context_, streamed_context_;
  std::shared_ptr<void> weight_memory_;
  std::size_t weights_size_ = 0;
  std::vector<ggml_tensor*> weights_;         // by Param::id
  std::vector<int> groups_;                   // by Param::id
  std::vector<ggml_tensor*> window_tensors_;  // none if all weights are resident
  std::shared_ptr<lower::DeviceWindows> windows_;
  std::string linear_text_;
  mutable std::vector<Upload> uploads_;
  mutable std::optional<Error> failure_;
};

}  // namespace vla
