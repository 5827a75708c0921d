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

/// Limits `use` to the features that kernels may use with these parameters. AMX and bf16 tiles round whatever they
/// multiply; a bundle permits that by storing matrices as bf16. Then products with these matrices round, and so does
/// attention if these products compute its queries. Other products, and attention over their queries, stay float32, as
/// in PyTorch (pi0's vision tower beside its language model). A bundle without bf16 matrices computes in float32.
/// Matrices rounded at load count with the dtype they have in memory, and int8 counts as bf16.
Features features_for(const ParamList& list, Features use, Rounding rounding = Rounding::none);

/// Fewest keys of attention that rounds, on any machine. Over few keys each output averages so few values that rounding
/// errors do not cancel, and attention takes little time anyway. Between ternary products errors must cancel better: a
/// number rounded before it is quantized may get another code, an error of 1 % or more of the row's maximum.
std::int64_t min_rounded_keys(const ParamList& list);

}  // namespace vla
