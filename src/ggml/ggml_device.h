// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-cpp.h>

#include <map>
#include <memory>

#include "graph/device.h"

namespace vla {

/// A backend of ggml: graphs run as its plain operations, without a node of our own. On the CPU this is the reference
/// that every kernel and every fusion is tested against; what a graph needs of a backend is in ggml_program.cpp.
class GgmlDevice final : public Device {
 public:
  /// Errors: device.
  static Result<std::unique_ptr<Device>> cpu(int n_thread);

  Status load(const ParamList& params, bool fill) override;
  Status allocate(Slots& slots) override;
  void set(const Slot& slot, const void* data, std::size_t size) override;
  void get(const Slot& slot, void* data, std::size_t size) const override;
  Result<std::unique_ptr<Program>> lower(const Graph& graph, const LowerOptions& options) override;

  std::string name() const override;
  int n_thread() const override { return n_thread_; }
  std::string kernels() const override { return "ggml"; }
  std::string precision() const override { return "f32"; }
  const std::string& linear_kernels() const override { return text_; }
  std::size_t weights_size() const override;
  std::size_t working_size() const override { return 0; }  // programs have memory of their own

  ggml_backend_t backend() const { return backend_.get(); }
  ggml_tensor* weight(const Param* param) const { return weights_[static_cast<std::size_t>(param->id)]; }

 private:
  struct FreePool {
    void operator()(ggml_threadpool* pool) const;
  };

  // What threads share during a run; without one of ours ggml makes and frees one in every run.
  std::unique_ptr<ggml_threadpool, FreePool> pool_;
  ggml_backend_ptr backend_;
  ggml_context_ptr weight_context_;
  ggml_backend_buffer_ptr weight_buffer_;
  std::vector<ggml_tensor*> weights_;
  std::string text_;
  int n_thread_ = 0;
};

/// A context for `n` tensors without memory. Errors: out_of_memory.
Result<ggml_context_ptr> make_context(std::size_t n, std::size_t extra = 0);

}  // namespace vla
