// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/precision.h"

#include <algorithm>

namespace vla {

Features features_for(const ParamList& list, Features use, Rounding rounding) {
  const auto& params = list.params();
  const auto rounds = [&](const Param& param) {
    const DType type = resident_encoding(param, rounding).type;
    return param.storage == Storage::matrix && (type == DType::bf16 || type == DType::i8 || type == DType::int4);
  };
  return std::any_of(params.begin(), params.end(), rounds) ? use : without_rounding(use);
}

std::int64_t min_rounded_keys(const ParamList& list) {
  const auto& params = list.params();
  const auto is_ternary = [](const Param& param) { return param.encoding.type == DType::ternary; };
  return std::any_of(params.begin(), params.end(), is_ternary) ? 512 : 128;
}

}  // namespace vla
