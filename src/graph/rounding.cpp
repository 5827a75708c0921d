// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "graph/rounding.h"

#include <algorithm>

namespace vla {

Encoding resident_encoding(const Param& param, Rounding rounding) {
  constexpr std::int64_t kMinRounded = 144;
  const DType stored = param.encoding.type;
  if (rounding == Rounding::float32)
    return stored == DType::i8 || stored == DType::int4 ? Encoding{DType::f32} : param.encoding;
  const bool keeps = rounding == Rounding::none || param.storage != Storage::matrix || !is_float(stored) ||
                     std::min(param.shape[0], param.shape[1]) < kMinRounded;
  if (keeps) return param.encoding;
  if (rounding == Rounding::bf16) return Encoding{DType::bf16};
  return {rounding == Rounding::int4 ? DType::int4 : DType::i8, param.shape[0]};
}

Status check_rounding(const ParamList& list, Rounding rounding) {
  if (rounding == Rounding::none || rounding == Rounding::float32) return {};
  const bool to_bf16 = rounding == Rounding::bf16;
  const auto is_wanted = [&](DType type) { return to_bf16 ? type == DType::bf16 : !is_float(type); };
  for (const Param& param : list.params())
    if (param.storage == Storage::matrix && param.encoding.type != DType::ternary &&
        is_wanted(resident_encoding(param, rounding).type))
      return {};
  const char* name = to_bf16 ? "bf16" : rounding == Rounding::int8 ? "int8" : "int4";
  return Error{Code::unsupported, std::string("kernels ") + name,
               to_bf16 ? "matrices of bf16, or others worth rounding" : "matrices of floats that are worth quantizing",
               "none", "leave --kernels out"};
}

}  // namespace vla
