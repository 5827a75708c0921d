// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/encoding.h"

namespace vla {

const char* dtype_name(DType type) {
  constexpr const char* kNames[] = {"f32", "f16", "bf16", "i32", "i8", "f64", "ternary", "int4"};
  return kNames[static_cast<int>(type)];
}

int dtype_bits(DType type) {
  constexpr int kBits[] = {32, 16, 16, 32, 8, 64, 2, 4};
  return kBits[static_cast<int>(type)];
}

void widen_codes(const Encoding& encoding, const std::byte* codes, const float* scales, std::int64_t n, float* to) {
  const auto* blocks = reinterpret_cast<const Int4Block*>(codes);
  for (std::int64_t i = 0; i < n; ++i) {
    const int code = encoding.type == DType::int4 ? blocks[i / Int4Block::kElements][i % Int4Block::kElements]
                                                  : std::to_integer<std::int8_t>(codes[i]);
    to[i] = static_cast<float>(code) * scales[i / encoding.group];
  }
}

}  // namespace vla
