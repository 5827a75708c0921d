// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/code_maker.h"

#include <algorithm>
#include <cstring>

#include "kernels/quantize_weights.h"
#include "lower/host/recode.h"

namespace vla {

Result<CodeMaker> CodeMaker::open(const Bundle& bundle, const TensorInfo& matrix, const Encoding& wanted,
                                  const CodeSource& source) {
  CodeMaker maker(matrix, wanted);
  for (const Bundle* made : source.made) {
    const TensorInfo& codes = *made->find(matrix.name);
    const auto row = static_cast<std::int64_t>(dtype_size(wanted.type, matrix.shape[0]));
    if (codes.type == DType::i8 && codes.shape[0] == row) maker.made_ = made;
  }
  if (source.feedback) {
    VLA_TRY(maker.feedback_, source.feedback(bundle, matrix));
  }
  return maker;
}

Result<const std::byte*> CodeMaker::make(const std::byte* stored, std::int64_t first, std::int64_t n, float* scales) {
  if (made_ != nullptr) return copy(first, n, scales);
  const std::int64_t d_in = matrix_->shape[0];
  if (feedback_.empty()) return lower::Recode{{matrix_->type}, wanted_}(stored, nullptr, n * d_in, codes_, scales);
  rows_.resize(static_cast<std::size_t>(n * d_in));
  std::byte* const codes = codes_.take(wanted_.size(n * d_in));
  const auto make = [&](auto* to) {
    kernels::quantize_weights(matrix_->type, stored, d_in, n, feedback_.data(), to, scales, rows_.data());
  };
  wanted_.type == DType::int4 ? make(reinterpret_cast<Int4Block*>(codes)) : make(codes);
  return static_cast<const std::byte*>(codes);
}

/// Copies codes and scales from the bundle that has them.
Result<const std::byte*> CodeMaker::copy(std::int64_t first, std::int64_t n, float* to) {
  const auto rows = [&](const std::string& tensor, std::size_t row) {
    return made_->find(tensor)->data.subspan(static_cast<std::size_t>(first) * row, static_cast<std::size_t>(n) * row);
  };
  VLA_TRY(const auto scales, made_->read(rows(scales_name(matrix_->name, wanted_), sizeof(float)), scales_));
  std::memcpy(to, scales.data(), scales.size());
  VLA_TRY(const auto codes, made_->read(rows(matrix_->name, dtype_size(wanted_.type, matrix_->shape[0])), codes_));
  return codes.data();
}

}  // namespace vla
