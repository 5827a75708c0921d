// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>

#include "bundle/bundle.h"

namespace vla {

/// Tensors start at multiples of this many bytes, the format's own default.
inline constexpr std::size_t kGgufAlignment = 32;

/// Everything of a GGUF file before the first tensor's bytes. Only the sizes of the tensors' data are used.
std::string write_gguf_head(const Keys& keys, std::span<const TensorInfo> tensors);

/// The bytes of a GGUF file, version 3, that `read_gguf` reads back: keys in their order, then tensors in theirs.
std::string write_gguf(const Keys& keys, std::span<const TensorInfo> tensors);

}  // namespace vla
