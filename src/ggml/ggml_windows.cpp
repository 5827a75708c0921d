// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_windows.h"

namespace vla {

Result<std::unique_ptr<GgmlWindows>> GgmlWindows::open(GgmlDevice& device, std::vector<ggml_tensor*> windows) {
  std::unique_ptr<GgmlWindows> made(new GgmlWindows(device, std::move(windows)));
  VLA_TRY(made->held_->host, device.allocate_host(made->windows_.size() * ggml_nbytes(made->window(0))));
  VLA_CHECK(device.guarded([&] {
    for (ggml_backend_event_ptr& event : made->held_->read)
      event.reset(ggml_backend_event_new(ggml_backend_get_device(device.backend())));
  }));
  return made;
}

std::byte* GgmlWindows::host(int i) {
  void* base = ggml_backend_buffer_get_base(held_->host.get());
  return static_cast<std::byte*>(base) + static_cast<std::size_t>(i) * ggml_nbytes(window(i));
}

Status GgmlWindows::note_read(int i) {
  if (read(i) == nullptr) return {};
  return device_.guarded([&] { ggml_backend_event_record(read(i), device_.backend()); });
}

Status GgmlWindows::upload(int i, std::size_t size) {
  return device_.guarded([&] {
    if (read(i) != nullptr)
      ggml_backend_event_synchronize(read(i));
    else
      ggml_backend_synchronize(device_.backend());
    ggml_backend_tensor_set(window(i), host(i), 0, size);
  });
}

}  // namespace vla
