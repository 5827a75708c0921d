// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "base/result.h"

namespace vla::msgpack {

/// A value of a message. Text and bytes stay in the message, which outlives the value.
struct Value {
  enum class Type { nil, boolean, integer, real, text, bytes, list, map };

  Type type = Type::nil;
  bool boolean = false;
  std::int64_t integer = 0;
  double real = 0;
  std::string_view data;     // of text and bytes
  std::vector<Value> items;  // of a list; of a map its keys and values by turns, keys being text or bytes

  bool is_text() const { return type == Type::text; }
  bool is_map() const { return type == Type::map; }
  bool is_list() const { return type == Type::list; }
  bool is_true() const { return type == Type::boolean && boolean; }
  /// The value at a key, which may have come as text or as bytes; null where there is none or this is no map.
  const Value* find(std::string_view key) const;
};

constexpr std::size_t kMaxValues = 4096;  // of a message: those of arrays are bytes
constexpr std::size_t kMaxDepth = 8;

/// Reads one message whole. Errors: bad_request for what is cut off, has bytes left over, an extension type, a key that
/// is neither text nor bytes or comes twice, text that is not UTF-8, or more values or levels than the bounds.
Result<Value> read(std::span<const std::byte> message);

}  // namespace vla::msgpack
