// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <google/protobuf/io/coded_stream.h>

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "base/result.h"

namespace vla::wire {

/// An error for bytes that no client sends if it follows the schema.
Error not_a_request(std::string where, std::string expected, std::string found);

/// Iterates over the fields of one serialized message without copying or allocating. A field takes two bytes on the
/// wire and a hundred as an object, so their number is limited here, before anything is parsed.
class Fields {
 public:
  static constexpr int kMax = 1 << 14;  // unpacked values of a state or of noise count as fields

  Fields(std::span<const std::byte> bytes, const char* where);

  /// The last field read: its number; its encoding: `v` varint, `b` bytes, `f` four bytes, `d` eight bytes; and its
  /// value if it is a varint or bytes.
  int number = 0;
  char type = '?';
  std::uint64_t varint = 0;
  std::span<const std::byte> value;

  /// Reads the next field. Returns false at the end of the bytes. Errors: bad_request.
  Result<bool> next();
  /// The refusal of the last field read.
  Error unknown() const;

 private:
  bool read_value(std::uint32_t wire_type);
  bool read_bytes();

  std::span<const std::byte> bytes_;
  google::protobuf::io::CodedInputStream input_;
  const char* where_;
  int count_ = 0;
};

}  // namespace vla::wire
