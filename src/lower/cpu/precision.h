// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "graph/rounding.h"
#include "kernels/kernel_set.h"

namespace vla {

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
