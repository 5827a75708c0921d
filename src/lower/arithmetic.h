// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/result.h"
#include "graph/rounding.h"
#include "kernels/kernel_set.h"

namespace vla {

/// The backend and precision of products. Parses `--kernels`.
struct Arithmetic {
  enum class Backend { own, ggml };

  Backend backend = Backend::own;
  Features use;  // features that our own kernels may use
  Rounding at_load = Rounding::none;

  /// Parses `--kernels` for a CPU: the name of a KernelSet; "float32" for the fastest kernels that round nothing;
  /// "bf16" for the fastest kernels, with large matrices rounded to bf16; "int8" or "int4" for the fastest kernels,
  /// with large matrices quantized; empty for the fastest. Errors: usage for an unknown name, device for kernels that
  /// the processor cannot run.
  static Result<Arithmetic> on_cpu(const std::string& kernels, Features machine);
  /// Parses `--kernels` for another device. CUDA runs our own kernels on matrices as stored (empty) or converted
  /// ("float32", "bf16", "int8", "int4"); "ggml" selects ggml's backend in float32. Vulkan has only ggml's backend:
  /// "float32", "ggml", "bf16" or empty. Errors: usage.
  static Result<Arithmetic> on_device(const std::string& kernels, const std::string& device);
};

}  // namespace vla
