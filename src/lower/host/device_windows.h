// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <functional>
#include <memory>

#include "lower/host/segments.h"
#include "lower/host/weight_stream.h"

namespace vla::lower {

/// Memory of a device for its windows, and of the host for as many, from which the device takes what comes to its own.
class WindowMemory {
 public:
  virtual ~WindowMemory() = default;
  virtual std::byte* host(int window) = 0;
  /// What was asked of the device until now may read this window. Errors: device.
  virtual Status note_read(int window) = 0;
  /// Copies the first bytes of the host's window to the device's, once what may read that has ended, and waits until
  /// they are there. Errors: device.
  virtual Status upload(int window, std::size_t size) = 0;
};

/// The device's half of matrices that have no place of their own: windows that groups of them come to while the device
/// computes with others. A WeightStream has the groups ready in the windows of the host. One thread at a time may call
/// this.
class DeviceWindows {
 public:
  /// place_of: how a matrix lies in a window; size_of: bytes from its begin to that of the next. Errors: out_of_memory.
  static Result<std::shared_ptr<DeviceWindows>> start(std::unique_ptr<WindowMemory> memory,
                                                      std::shared_ptr<const Content> content, const WeightPlan& plan,
                                                      const std::function<MatrixPlace(const Param&)>& place_of,
                                                      const std::function<std::size_t(const Param&)>& size_of);

  /// Has groups on the device for what is asked of it next, until others are wanted. Errors: bad_bundle where the file
  /// has not their bytes any more, device.
  Status bring(const Groups& groups);

 private:
  explicit DeviceWindows(std::unique_ptr<WindowMemory> memory) : memory_(std::move(memory)) { held_.fill(-1); }
  int& held(int group) { return held_[static_cast<std::size_t>(window_of(group))]; }
  static int window_of(int group) { return WeightStream::window_of(static_cast<std::size_t>(group)); }
  Status upload(int group);

  std::unique_ptr<WindowMemory> memory_;
  std::vector<std::size_t> sizes_;                // of groups
  std::array<int, WeightStream::kWindows> held_;  // the group in each window of the device, or -1
  Groups reading_;                                // by what was asked last
  std::unique_ptr<WeightStream> stream_;          // goes before the memory that it writes to
};

}  // namespace vla::lower
