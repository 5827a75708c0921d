// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "graph/rounding.h"

#include <algorithm>

namespace vla {

Encoding resident_encoding(const Param& param, Rounding rounding) {
  constexpr std::int64_t kMinRounded = 144;
  if (rounding == Rounding::float32) return param.encoding.type == DType::i8 ? Encoding{DType::f32} : param.encoding;
  const bool keeps = rounding == Rounding::none || param.storage != Storage::matrix || !is_float(param.encoding.type) ||
                     std::min(param.shape[0], param.shape[1]) < kMinRounded;
  if (keeps) return param.encoding;
  return rounding == Rounding::int8 ? Encoding{DType::i8, param.shape[0]} : Encoding{DType::bf16};
}

Status check_rounding(const ParamList& list, Rounding rounding) {
  if (rounding == Rounding::none || rounding == Rounding::float32) return {};
  const bool to_int8 = rounding == Rounding::int8;
  const DType wanted = to_int8 ? DType::i8 : DType::bf16;
  for (const Param& param : list.params())
    if (param.storage == Storage::matrix && resident_encoding(param, rounding).type == wanted) return {};
  return Error{Code::unsupported, to_int8 ? "kernels int8" : "kernels bf16",
               to_int8 ? "matrices of floats that are worth quantizing" : "matrices of bf16, or others worth rounding",
               "none", "leave --kernels out"};
}

}  // namespace vla
