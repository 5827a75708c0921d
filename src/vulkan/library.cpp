// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// libvla-vulkan.so: ggml's Vulkan backend.
#include <ggml-vulkan.h>

#include "ggml/backend_library.h"

const vla::BackendLibrary* vla_backend_library() {
  static const vla::BackendLibrary library = {VLA_BACKEND_BUILD, ggml_backend_vk_reg, ggml_log_set,
                                              ggml_set_abort_callback};
  return &library;
}
