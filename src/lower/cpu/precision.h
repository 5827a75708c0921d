// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/rounding.h"
#include "kernels/kernel_set.h"

namespace vla {

/// The features that kernels may use to compute with these parameters, of `use`. Tiles of bf16 round whatever they
/// multiply. A bundle asks for that by storing matrices as bf16: those are multiplied so, and attention of queries that
/// they make rounds too. Matrices of another dtype, and attention of their queries, are float32, as they are in
/// PyTorch: pi0's tower beside its language model. Without any of bf16 everything is. What is rounded counts as it is
/// in memory, and int8 as bf16.
Features features_for(const ParamList& list, Features use, Rounding rounding = Rounding::none);

/// Attention over fewer keys rounds nothing on any machine: it takes little time, and each output mixes so few values
/// that their errors hardly cancel. Between ternary products they must cancel better: a number that is rounded before
/// it is quantized may get another code, which is an error of a hundredth and more of a row's greatest.
std::int64_t min_rounded_keys(const ParamList& list);

}  // namespace vla
