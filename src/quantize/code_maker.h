// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "quantize/quantize.h"

namespace vla {

constexpr std::int64_t kPartRows = 64;  // rows of a matrix in memory at a time

/// Makes the codes of a matrix, some rows at a time.
class CodeMaker {
 public:
  /// Makes codes of `wanted`: int8 or int4. Errors: those of `source`.
  static Result<CodeMaker> open(const Bundle& bundle, const TensorInfo& matrix, const Encoding& wanted,
                                const CodeSource& source);

  /// Codes of `n` rows starting at `first`, whose bytes are `stored`. Codes and scales [n] are valid until the next
  /// call. Errors: bad_bundle, for CodeSource::made.
  Result<const std::byte*> make(const std::byte* stored, std::int64_t first, std::int64_t n, float* scales);

 private:
  CodeMaker(const TensorInfo& matrix, const Encoding& wanted) : matrix_(&matrix), wanted_(wanted) {}
  Result<const std::byte*> copy(std::int64_t first, std::int64_t n, float* scales);

  const TensorInfo* matrix_;
  Encoding wanted_;
  const Bundle* made_ = nullptr;
  std::span<const float> feedback_;
  ReadBuffer codes_, scales_;
  std::vector<float> rows_;
};

}  // namespace vla
