// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <functional>
#include <memory>

#include "lower/host/segments.h"
#include "lower/host/weight_stream.h"

namespace vla::lower {

/// The device memory of the windows, and host memory of the same size from which the device copies.
class WindowMemory {
 public:
  virtual ~WindowMemory() = default;
  virtual std::byte* host(int window) = 0;
  /// Notes that all work queued so far may read this window. Errors: device.
  virtual Status note_read(int window) = 0;
  /// Waits for the work that reads the device's window, copies the first bytes of the host's window to it, and waits
  /// for the copy. Errors: device.
  virtual Status upload(int window, std::size_t size) = 0;
};

/// The device's side of weight streaming: groups of matrices are copied into windows of device memory while the device
/// computes with other groups. A WeightStream fills the host's windows. One thread at a time may call it.
class DeviceWindows {
 public:
  /// place_of returns a matrix's layout in a window, size_of its bytes up to the next matrix. Errors: out_of_memory.
  static Result<std::shared_ptr<DeviceWindows>> start(std::unique_ptr<WindowMemory> memory,
                                                      std::shared_ptr<const Content> content, const WeightPlan& plan,
                                                      const std::function<MatrixPlace(const Param&)>& place_of,
                                                      const std::function<std::size_t(const Param&)>& size_of);

  /// Puts groups on the device for the work queued next; they stay until other groups are requested. Errors: bad_bundle
  /// if the file no longer has their bytes, device.
  Status bring(const Groups& groups);

 private:
  explicit DeviceWindows(std::unique_ptr<WindowMemory> memory) : memory_(std::move(memory)) { held_.fill(-1); }
  int& held(int group) { return held_[static_cast<std::size_t>(window_of(group))]; }
  static int window_of(int group) { return WeightStream::window_of(static_cast<std::size_t>(group)); }
  Status upload(int group);

  std::unique_ptr<WindowMemory> memory_;
  std::vector<std::size_t> sizes_;                // bytes of each group
  std::array<int, WeightStream::kWindows> held_;  // the group in each of the device's windows, or -1
  Groups reading_;                                // groups of the last request
  std::unique_ptr<WeightStream> stream_;          // destroyed before the memory that it writes to
};

}  // namespace vla::lower
