// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>

#include "bundle/bundle.h"

namespace vla {

/// The bytes of a GGUF file, version 3, that `read_gguf` reads back: keys in their order, then tensors in theirs.
std::string write_gguf(const Keys& keys, std::span<const TensorInfo> tensors);

}  // namespace vla
