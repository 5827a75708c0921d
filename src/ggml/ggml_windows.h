// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "ggml/ggml_device.h"

namespace vla {

/// Windows that groups of matrices come to while the backend computes; without events, between two graphs. Those of the
/// host are of the driver's own kind, where it has one.
class GgmlWindows final : public lower::WindowMemory {
 public:
  /// windows: tensors of one size. Errors: device, out_of_memory.
  static Result<std::unique_ptr<GgmlWindows>> open(GgmlDevice& device, std::vector<ggml_tensor*> windows);

  std::byte* host(int window) override;
  Status note_read(int window) override;
  Status upload(int window, std::size_t size) override;
  /// Everything that the driver is asked to free.
  std::shared_ptr<void> held() const { return held_; }

 private:
  struct Held {
    ggml_backend_buffer_ptr host;
    // They stand for all graphs that read a window until now; null of a backend without events.
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
