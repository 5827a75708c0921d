// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "ggml/ggml_device.h"

namespace vla {

/// A graph as plain ggml operations, in the order in which its nodes were recorded.
class GgmlProgram final : public Program {
 public:
  /// Errors: out_of_memory, device, unsupported if the backend lacks an operation.
  static Result<std::unique_ptr<Program>> make(const Graph& graph, GgmlDevice& device);

  Status run() override;
  const std::vector<Stage>& stages() const override { return stages_; }
  std::vector<Work> work() const override { return work_; }
  const std::vector<Tap>& taps() const override { return taps_; }
  std::vector<float> tap(std::size_t i) const override;
  std::string text() const override { return text_; }
  std::size_t size() const override { return size_; }
  /// The matrices that each phase reads.
  const lower::MatrixReads& reads() const { return reads_; }

 private:
  /// A stretch of the graph that is computed once its groups are on the device.
  struct Part {
    lower::Groups groups;
    ggml_context_ptr context;
    ggml_cgraph* graph;
  };
  explicit GgmlProgram(GgmlDevice& device) : device_(device) {}
  Status cut(const std::vector<int>& phase_end, const std::vector<std::size_t>& stage_end);

  GgmlDevice& device_;
  ggml_context_ptr context_, constant_context_;
  std::shared_ptr<void> constant_memory_;
  std::shared_ptr<ggml_gallocr> places_;  // memory of all other values
  ggml_cgraph* graph_ = nullptr;
  std::vector<std::vector<Part>> parts_;  // parts of the graph, by stage
  lower::MatrixReads reads_;
  std::vector<Stage> stages_;
  std::vector<Work> work_;
  std::vector<Tap> taps_;
  std::vector<ggml_tensor*> tap_tensors_;
  std::string text_;
  std::size_t size_ = 0;
};

}  // namespace vla
