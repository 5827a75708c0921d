// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// Embeds the kernels' PTX and machine code in the library; the build writes the list of files, embedded_modules.inc.
#include "cuda/driver/modules.h"

#define IMAGE(name, file)                                                                                        \
  asm(".section .rodata\n.balign 16\n.global vla_image_" #name "\n.hidden vla_image_" #name "\nvla_image_" #name \
      ":\n.incbin \"" VLA_KERNELS_FOLDER "/" file "\"\n.global vla_end_" #name "\n.hidden vla_end_" #name        \
      "\nvla_end_" #name ":\n.text");                                                                            \
  extern "C" __attribute__((visibility("hidden"))) const char vla_image_##name[], vla_end_##name[];
#include "cuda/embedded_modules.inc"
#undef IMAGE

std::vector<std::string> vla::cuda::kernel_modules() {
  return {
#define IMAGE(name, file) {vla_image_##name, vla_end_##name},
#include "cuda/embedded_modules.inc"
#undef IMAGE
  };
}
