// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/host/device_windows.h"

#include <algorithm>

#include "kernels/cores.h"

namespace vla::lower {
namespace {

/// Number of threads that read streamed matrices. A GPU leaves the cores idle, and four threads outrun most disks.
int n_reader() { return std::clamp(static_cast<int>(kernels::allowed_cores().size()) / 2, 1, 4); }

}  // namespace

Result<std::shared_ptr<DeviceWindows>> DeviceWindows::start(std::unique_ptr<WindowMemory> memory,
                                                            std::shared_ptr<const Content> content,
                                                            const WeightPlan& plan,
                                                            const std::function<MatrixPlace(const Param&)>& place_of,
                                                            const std::function<std::size_t(const Param&)>& size_of) {
  std::shared_ptr<DeviceWindows> windows(new DeviceWindows(std::move(memory)));
  std::vector<std::vector<PackPart>> groups;
  for (const std::vector<const Param*>& group : plan.streamed) {
    std::byte* const window = windows->memory_->host(WeightStream::window_of(groups.size()));
    std::vector<PackPart>& parts = groups.emplace_back();
    std::size_t& size = windows->sizes_.emplace_back(0);
    for (const Param* matrix : group) {
      MatrixPlace place = place_of(*matrix);
      place.put(*matrix, window + size);
      add_parts(*matrix, place, parts);
      size += size_of(*matrix);
    }
  }
  VLA_TRY(windows->stream_, WeightStream::start(std::move(content), std::move(groups), n_reader()));
  return windows;
}

Status DeviceWindows::bring(const Groups& groups) {
  for (int group = reading_.first; reading_.any() && group <= reading_.last; ++group)
    VLA_CHECK(memory_->note_read(window_of(group)));
  reading_ = groups;
  for (int group = groups.first; group <= groups.last; ++group)
    if (held(group) != group) VLA_CHECK(upload(group));
  return {};
}

/// On return the host's window may be overwritten by the next group, while the device still computes with earlier
/// groups.
Status DeviceWindows::upload(int group) {
  held(group) = -1;
  VLA_CHECK(stream_->bring(group, group));
  VLA_CHECK(memory_->upload(window_of(group), sizes_[static_cast<std::size_t>(group)]));
  stream_->release(group);
  held(group) = group;
  return {};
}

}  // namespace vla::lower
