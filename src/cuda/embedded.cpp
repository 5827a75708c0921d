// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// The kernels' PTX from the build, as bytes in the library. embedded_modules.inc lists MODULE(name).
#include "cuda/driver/modules.h"

#define MODULE(name)                                                                                       \
  asm(".section .rodata\n.balign 16\n.global vla_ptx_" #name "\n.hidden vla_ptx_" #name "\nvla_ptx_" #name \
      ":\n.incbin \"" VLA_PTX_FOLDER "/" #name ".ptx\"\n.byte 0\n.text");                                  \
  extern "C" __attribute__((visibility("hidden"))) const char vla_ptx_##name[];
#include "cuda/embedded_modules.inc"
#undef MODULE

std::vector<std::string> vla::cuda::kernel_modules() {
  return {
#define MODULE(name) vla_ptx_##name,
#include "cuda/embedded_modules.inc"
#undef MODULE
  };
}
