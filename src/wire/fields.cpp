// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "wire/fields.h"

#include <fmt/format.h>

namespace vla::wire {

Error not_a_request(std::string where, std::string expected, std::string found) {
  return {Code::bad_request, std::move(where), std::move(expected), std::move(found), "see docs/protocol.md"};
}

Fields::Fields(std::span<const std::byte> bytes, const char* where)
    : bytes_(bytes),
      input_(reinterpret_cast<const std::uint8_t*>(bytes.data()), static_cast<int>(bytes.size())),
      where_(where) {}

Result<bool> Fields::next() {
  const std::uint32_t tag = input_.ReadTag();
  if (tag == 0 && input_.CurrentPosition() == static_cast<int>(bytes_.size()) && input_.ConsumedEntireMessage())
    return false;
  number = static_cast<int>(tag >> 3);
  if (number == 0 || !read_value(tag & 7))
    return not_a_request(where_, "a serialized Request", "bytes that do not parse as one");
  if (++count_ > kMax) return not_a_request(where_, fmt::format("at most {} fields", kMax), "more");
  return true;
}

bool Fields::read_value(std::uint32_t wire_type) {
  switch (wire_type) {
    case 0:
      type = 'v';
      return input_.ReadVarint64(&varint);
    case 1:
      type = 'd';
      return input_.Skip(8);
    case 2:
      type = 'b';
      return read_bytes();
    case 5:
      type = 'f';
      return input_.Skip(4);
    default:  // groups do not exist in proto3
      return false;
  }
}

bool Fields::read_bytes() {
  std::uint32_t size = 0;
  if (!input_.ReadVarint32(&size)) return false;
  const auto at = static_cast<std::size_t>(input_.CurrentPosition());
  if (size > bytes_.size() - at) return false;
  value = bytes_.subspan(at, size);
  return input_.Skip(static_cast<int>(size));
}

Error Fields::unknown() const {
  return not_a_request(where_, "the fields of this protocol version",
                       fmt::format("field {} in another encoding, or unknown", number));
}

}  // namespace vla::wire
