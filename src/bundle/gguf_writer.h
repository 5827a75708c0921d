// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>

#include "bundle/bundle.h"

namespace vla {

/// Tensors start at multiples of this many bytes, the format's own default.
inline constexpr std::size_t kGgufAlignment = 32;

/// All of a GGUF file that stands before the first tensor's bytes. Of the tensors' data only the sizes are looked at.
std::string write_gguf_head(const Keys& keys, std::span<const TensorInfo> tensors);

/// The bytes of a GGUF file, version 3, that `read_gguf` reads back: keys in their order, then tensors in theirs.
std::string write_gguf(const Keys& keys, std::span<const TensorInfo> tensors);

}  // namespace vla
