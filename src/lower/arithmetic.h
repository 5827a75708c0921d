// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/result.h"
#include "graph/rounding.h"
#include "kernels/kernel_set.h"

namespace vla {

/// The backend that computes products, and its precision: the meaning of `--kernels`, which nothing else reads.
struct Arithmetic {
  enum class Backend { own, ggml };

  Backend backend = Backend::own;
  Features use;  // of our own kernels
  Rounding at_load = Rounding::none;

  /// On a processor: a KernelSet by name, "float32" for the best that rounds nothing, "bf16" for the best that rounds
  /// to bf16, large matrices too, "int8" or "int4" for the best with large matrices quantized, or nothing for the best.
  /// Errors: usage for an unknown name, device for one that the processor cannot run.
  static Result<Arithmetic> on_cpu(const std::string& kernels, Features machine);
  /// On a device of another kind. On CUDA our own kernels compute, with matrices as they are stored or, as on the CPU,
  /// with "float32", "bf16" or "int8"; "ggml" is ggml's backend in float32. Vulkan has ggml's alone: "float32", "ggml"
  /// or nothing, or "bf16". Errors: usage.
  static Result<Arithmetic> on_device(const std::string& kernels, const std::string& device);
};

}  // namespace vla
