// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "ggml/ggml_device.h"

namespace vla {

/// Windows into which groups of matrices are copied while the backend computes, or between two graphs if the backend
/// has no events. The host's windows are in the driver's host memory, if it has any.
class GgmlWindows final : public lower::WindowMemory {
 public:
  /// windows: tensors of one size. Errors: device, out_of_memory.
  static Result<std::unique_ptr<GgmlWindows>> open(GgmlDevice& device, std::vector<ggml_tensor*> windows);

  std::byte* host(int window) override;
  Status note_read(int window) override;
  Status upload(int window, std::size_t size) override;
  /// Everything that the driver must free.
  std::shared_ptr<void> held() const { return held_; }

 private:
  struct Held {
    ggml_backend_buffer_ptr host;
    // By window, the event after all graphs that have read it so far; null if the backend has no events.
    std::array<ggml_backend_event_ptr, lower::WeightStream::kWindows> read;
  };
  GgmlWindows(GgmlDevice& device, std::vector<ggml_tensor*> windows) : device_(device), windows_(std::move(windows)) {}
  ggml_tensor* window(int i) const { return windows_[static_cast<std::size_t>(i)]; }
  ggml_backend_event_t read(int window) const { return held_->read[static_cast<std::size_t>(window)].get(); }

  GgmlDevice& device_;
  std::vector<ggml_tensor*> windows_;
  std::shared_ptr<Held> held_ = std::make_shared<Held>();
};

}  // namespace vla
