// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "bundle/bundle.h"

namespace vla {

/// The contents of a GGUF file. Tensor data points into the parsed bytes.
struct GgufContent {
  Keys keys;
  std::vector<TensorInfo> tensors;
};

/// Parses GGUF version 3 (ggml docs/gguf.md). We do not use ggml's reader because a bundle may be hostile: this one
/// compares every count and length with the bytes that are left before it allocates or reads, and names the key or
/// tensor that it refuses. It calls `show` with the number of leading bytes that it is about to read; tensor data are
/// not read. Errors: bad_bundle, and those of `show`.
Result<GgufContent> read_gguf(std::span<const std::byte> bytes, const std::string& name,
                              const std::function<Status(std::size_t n)>& show = {});

}  // namespace vla
