// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/ggml_packing.h"

#include <cstring>

namespace vla {
namespace {

using kernels::MatrixDesc;

std::size_t size_of(const MatrixDesc& desc) { return dtype_size(desc.type, desc.d_in * desc.d_out); }
void copy(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  std::memcpy(packed, stored, size_of(desc));
}

std::size_t widened_size(const MatrixDesc& desc) { return dtype_size(DType::f32, desc.d_in * desc.d_out); }
void widen_ternary(const MatrixDesc& desc, const std::byte* stored, std::byte* packed) {
  auto* const values = reinterpret_cast<float*>(packed);
  for (std::int64_t i = 0; i < desc.d_in * desc.d_out; ++i)
    values[i] = static_cast<float>(std::to_integer<int>(stored[i / 4]) >> 2 * (i % 4) & 3) - 1.0f;
}

}  // namespace

ggml_type type_of(DType type) {
  switch (type) {
    case DType::bf16:
      return GGML_TYPE_BF16;
    case DType::f16:
      return GGML_TYPE_F16;
    case DType::i32:
      return GGML_TYPE_I32;
    case DType::i8:
    case DType::ternary:  // codes are bytes
    case DType::int4:
      return GGML_TYPE_I8;
    case DType::f64:  // f64 occurs in statistics only, which no graph reads
    case DType::f32:
      break;
  }
  return GGML_TYPE_F32;
}

lower::MatrixPlace place_of(const Param& matrix, ggml_type type) {
  if (matrix.encoding.type == DType::ternary)
    return {.encoding = matrix.encoding, .packing = {widened_size, widen_ternary}};
  const DType wanted = type == GGML_TYPE_BF16 ? DType::bf16 : type == GGML_TYPE_F16 ? DType::f16 : DType::f32;
  return {.encoding = {wanted}, .packing = {size_of, copy}};
}

}  // namespace vla
