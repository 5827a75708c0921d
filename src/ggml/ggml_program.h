// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "ggml/ggml_device.h"

namespace vla {

/// A graph as plain ggml operations, one after the other as they were recorded.
class GgmlProgram final : public Program {
 public:
  /// Errors: out_of_memory, device, unsupported where the backend lacks an operation.
  static Result<std::unique_ptr<Program>> make(const Graph& graph, GgmlDevice& device);

  Status run() override;
  const std::vector<Stage>& stages() const override { return stages_; }
  std::vector<Work> work() const override { return work_; }
  const std::vector<Tap>& taps() const override { return taps_; }
  std::vector<float> tap(std::size_t i) const override;
  std::string text() const override { return text_; }
  std::size_t size() const override { return size_; }

 private:
  explicit GgmlProgram(GgmlDevice& device) : device_(device) {}

  GgmlDevice& device_;
  ggml_context_ptr context_, constant_context_;
  std::shared_ptr<void> constant_memory_;
  std::shared_ptr<ggml_gallocr> places_;  // of all other values
  ggml_cgraph* graph_ = nullptr;
  std::vector<ggml_cgraph*> parts_;  // of the graph, stage by stage
  std::vector<Stage> stages_;
  std::vector<Work> work_;
  std::vector<Tap> taps_;
  std::vector<ggml_tensor*> tap_tensors_;
  std::string text_;
  std::size_t size_ = 0;
};

}  // namespace vla
