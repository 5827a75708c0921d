// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/printable.h"

#include <fmt/format.h>

#include <cstdint>

namespace vla {
namespace {

struct Character {
  std::size_t size = 1;  // bytes
  std::uint32_t code = kNotUtf8;
  static constexpr std::uint32_t kNotUtf8 = 0xffffffff;
};

/// The first code point of a text that is not empty.
Character first_of(std::string_view text) {
  const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(text[i]); };
  const unsigned lead = byte(0);
  if (lead < 0x80) return {1, lead};
  const std::size_t size = lead >= 0xf0 ? 4 : lead >= 0xe0 ? 3 : 2;
  constexpr std::uint32_t kLeast[] = {0, 0, 0x80, 0x800, 0x10000};  // refuses overlong encodings
  if (lead < 0xc2 || lead > 0xf4 || text.size() < size) return {};
  std::uint32_t code = lead & (0x7fu >> size);
  for (std::size_t i = 1; i < size; ++i) {
    if ((byte(i) & 0xc0) != 0x80) return {};
    code = code << 6 | (byte(i) & 0x3fu);
  }
  if (code < kLeast[size] || code > 0x10ffff || (code >= 0xd800 && code < 0xe000)) return {};
  return {size, code};
}

/// Control characters, line separators and marks of text direction.
bool moves_the_cursor(std::uint32_t code) {
  return code < 0x20 || (code >= 0x7f && code < 0xa0) || code == 0x200e || code == 0x200f ||
         (code >= 0x2028 && code <= 0x202e) || (code >= 0x2066 && code <= 0x2069);
}

}  // namespace

std::string printable(std::string_view text) {
  std::string out;
  while (!text.empty()) {
    const Character character = first_of(text);
    if (character.code == Character::kNotUtf8) {
      out += fmt::format("\\x{:02x}", static_cast<unsigned char>(text[0]));
    } else if (moves_the_cursor(character.code)) {
      out += character.code < 0x80 ? fmt::format("\\x{:02x}", character.code)
                                   : fmt::format("\\u{{{:04x}}}", character.code);
    } else {
      out += text.substr(0, character.size);
    }
    text.remove_prefix(character.size);
  }
  return out;
}

bool is_printable(std::string_view text) {
  for (; !text.empty(); text.remove_prefix(first_of(text).size)) {
    const Character character = first_of(text);
    if (character.code == Character::kNotUtf8 || moves_the_cursor(character.code)) return false;
  }
  return true;
}

}  // namespace vla
