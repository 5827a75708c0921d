// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <ggml-backend.h>

namespace vla {

/// What a library such as libvla-vulkan.so exports. It carries a ggml of its own, so that it needs no symbol of the
/// program that loads it, and no other program's ggml can be mistaken for ours. Objects of the one ggml are used
/// through the other: `build` makes sure that both have the same layout.
struct BackendLibrary {
  const char* build;                                        // VLA_BACKEND_BUILD
  ggml_backend_reg_t (*open)();                             // null where the driver is missing
  void (*set_log)(ggml_log_callback callback, void* data);  // of the library's ggml, as is the next
  ggml_abort_callback_t (*set_abort)(ggml_abort_callback_t callback);
  const char* (*driver)(ggml_backend_dev_t device);  // its name and version; valid until this thread's next call
};

constexpr const char* kBackendSymbol = "vla_backend_library";

}  // namespace vla

extern "C" __attribute__((visibility("default"))) const vla::BackendLibrary* vla_backend_library();
