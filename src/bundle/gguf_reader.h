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

/// Parses GGUF version 3 (ggml docs/gguf.md). A reader of our own instead of ggml's, because a bundle may be hostile:
/// here every count and length is compared with the bytes that are left before anything is allocated or read, and the
/// refusal names the key or tensor. `show` is asked for the first so many bytes before they are read; those of tensors
/// are not. Errors: bad_bundle, and those of `show`.
Result<GgufContent> read_gguf(std::span<const std::byte> bytes, const std::string& name,
                              const std::function<Status(std::size_t n)>& show = {});

}  // namespace vla
