// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <zlib.h>

#include <cstdlib>
#include <span>
#include <string>

#include "fuzz/budget.h"
#include "processor/image.h"
#include "processor/ops/letterbox.h"

namespace vla::fuzz {

/// The bytes with checksums that fit the chunks of a PNG, so that what lies behind them is reached. Others stay as they
/// are.
inline std::string sealed_png(std::string bytes) {
  constexpr std::size_t kSignature = 8, kAround = 12;
  if (!bytes.starts_with("\x89PNG")) return bytes;
  for (std::size_t at = kSignature; at + kAround <= bytes.size();) {
    std::size_t length = 0;
    for (std::size_t i = 0; i < 4; ++i) length = length << 8 | static_cast<std::uint8_t>(bytes[at + i]);
    if (length > bytes.size() - at - kAround) break;
    const auto sum = crc32(0, reinterpret_cast<const Bytef*>(bytes.data()) + at + 4, static_cast<uInt>(length + 4));
    for (std::size_t i = 0; i < 4; ++i) bytes[at + 8 + length + i] = static_cast<char>(sum >> (24 - 8 * i) & 0xFF);
    at += length + kAround;
  }
  return bytes;
}

inline void check_decoded(std::span<const std::byte> bytes) {
  const Budget budget(10, 512);
  constexpr ImageLimits kLimits{1 << 18};  // small, so that the time goes into the decoders and not into memory
  const auto frame = decode_image(bytes, "input", kLimits);
  if (!frame) return;
  if (!check_frame(*frame, "input", kLimits)) std::abort();
  std::vector<float> out(3 * 20 * 16, -1.0f);
  if (!letterbox(*frame, {20, 16, 0.0f}, out, "input")) return;
  for (const float value : out)
    if (!(value >= 0.0f && value <= 1.00001f)) std::abort();  // weights sum to 1 within rounding
}

/// Decodes bytes as an image, as they are and as a PNG with checksums that fit; what is accepted must be a sound frame
/// that letterboxes. Aborts when it is not, or when it takes long or much memory.
inline void check_image(std::span<const std::byte> bytes) {
  check_decoded(bytes);
  const std::string fitted = sealed_png({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
  check_decoded(std::as_bytes(std::span(fitted)));
}

}  // namespace vla::fuzz
