// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "base/result.h"
#include "serve/options.h"

namespace vla::msgpack {

/// A value of a message. Text and bytes point into the message, which must outlive it.
struct Value {
  enum class Type { nil, boolean, integer, real, text, bytes, list, map };

  Type type = Type::nil;
  bool boolean = false;
  std::int64_t integer = 0;
  double real = 0;
  std::string_view data;     // content of text or bytes
  std::vector<Value> items;  // items of a list; alternating keys and values of a map, whose keys are text or bytes

  bool is_text() const { return type == Type::text; }
  bool is_map() const { return type == Type::map; }
  bool is_list() const { return type == Type::list; }
  bool is_true() const { return type == Type::boolean && boolean; }
  /// The value at a key, sent as text or as bytes; null if it is missing or this is not a map.
  const Value* find(std::string_view key) const;
};

constexpr std::size_t kMaxValues = 4096;  // values of a message; an array's data is one value, its bytes
constexpr std::size_t kMaxDepth = 8;
constexpr std::size_t kMaxTexts = 2 * serve::kMostText;  // bytes of all texts together: an instruction, and names

/// Parses one whole message. Errors: bad_request if it is truncated, has bytes left over, an extension type, a key that
/// is not text or bytes or occurs twice, text that is not UTF-8, or more values, levels or text than the limits.
Result<Value> read(std::span<const std::byte> message);

}  // namespace vla::msgpack
