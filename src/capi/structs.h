// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fmt/format.h>
#include <vla/vla.h>

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <string>
#include <vector>

#include "base/result.h"

namespace vla::capi {

/// No struct of the interface will ever be this large. Catches sizes that were never set.
inline constexpr std::size_t kMaxStruct = 4096;
/// Most entries in a caller's array, and most bytes in a name.
inline constexpr std::size_t kMaxEntry = 256, kMaxName = 4096;

inline Error usage(std::string where, std::string expected, std::string found, std::string hint = {}) {
  return {Code::usage, std::move(where), std::move(expected), std::move(found), std::move(hint)};
}

/// Copies a caller's struct into this library's version of it. Fields that the caller was compiled without are zero.
/// Bytes that this library does not know must be zero: otherwise a request would be ignored silently.
template <class T>
Result<T> read_struct(const void* given, const std::string& where) {
  if (given == nullptr) return usage(where, "a pointer", "NULL");
  std::size_t size;
  std::memcpy(&size, given, sizeof size);
  if (size < sizeof size || size > kMaxStruct)
    return usage(where + ".struct_size", "the struct's sizeof", std::to_string(size), "start from its ..._INIT");
  T known{};
  std::memcpy(static_cast<void*>(&known), given, std::min(size, sizeof known));
  const auto* bytes = static_cast<const unsigned char*>(given);
  if (size > sizeof known && std::any_of(bytes + sizeof known, bytes + size, [](unsigned char b) { return b != 0; }))
    return Error{Code::unsupported, where, fmt::format("fields within {} bytes", sizeof known),
                 "a field that this library does not know", "use a newer library"};
  return known;
}

/// Reads an array of such structs. The first one's size is the stride.
template <class T>
Result<std::vector<T>> read_structs(const T* given, std::size_t count, const std::string& where) {
  if (count > kMaxEntry) return usage(where, fmt::format("at most {} entries", kMaxEntry), std::to_string(count));
  if (given == nullptr && count > 0) return usage(where, fmt::format("{} entries", count), "NULL");
  std::vector<T> known;
  const auto* at = reinterpret_cast<const unsigned char*>(given);
  for (std::size_t i = 0; i < count; ++i) {
    const std::string entry = fmt::format("{}[{}]", where, i);
    VLA_TRY(T one, read_struct<T>(at, entry));
    if (i > 0 && one.struct_size != known.front().struct_size)
      return usage(entry + ".struct_size", std::to_string(known.front().struct_size), std::to_string(one.struct_size));
    at += one.struct_size;
    known.push_back(one);
  }
  return known;
}

/// Reads a name that ends with NUL.
inline Result<std::string> read_name(const char* given, const std::string& where) {
  if (given == nullptr) return usage(where, "a name", "NULL");
  const std::size_t size = ::strnlen(given, kMaxName + 1);
  if (size == 0 || size > kMaxName)
    return usage(where, fmt::format("1 to {} bytes", kMaxName), size == 0 ? "empty text" : "more");
  return std::string(given, size);
}

}  // namespace vla::capi
