// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/unicode.h"

#include <algorithm>
#include <iterator>

#include "processor/capitals.h"

namespace vla::unicode {
namespace {

struct Run {
  std::uint32_t start;
  std::uint16_t classes;
};

constexpr Run kRuns[] = {
#include "processor/unicode_classes.inc"
};

constexpr Capitals kCapitals[] = {
#include "processor/unicode_lower.inc"
};

bool continues(std::string_view text, std::size_t i) {
  return i < text.size() && (static_cast<std::uint8_t>(text[i]) & 0xC0) == 0x80;
}

std::uint32_t payload(std::string_view text, std::size_t i) { return static_cast<std::uint8_t>(text[i]) & 0x3F; }

}  // namespace

std::uint16_t classes(std::uint32_t code_point) {
  const auto after = std::upper_bound(std::begin(kRuns), std::end(kRuns), code_point,
                                      [](std::uint32_t c, const Run& run) { return c < run.start; });
  return std::prev(after)->classes;  // the first run starts at 0
}

std::uint32_t lower(std::uint32_t code_point) { return small_letter(kCapitals, code_point); }

Char first(std::string_view text) {
  if (text.empty()) return {};
  const auto lead = static_cast<std::uint8_t>(text[0]);
  if (lead < 0x80) return {lead, 1};
  if (lead >= 0xC2 && lead < 0xE0 && continues(text, 1)) return {(lead & 0x1Fu) << 6 | payload(text, 1), 2};
  if (lead >= 0xE0 && lead < 0xF0 && continues(text, 1) && continues(text, 2)) {
    const std::uint32_t c = (lead & 0x0Fu) << 12 | payload(text, 1) << 6 | payload(text, 2);
    const bool surrogate = c >= 0xD800 && c < 0xE000;
    return c >= 0x800 && !surrogate ? Char{c, 3} : Char{};
  }
  if (lead >= 0xF0 && lead < 0xF5 && continues(text, 1) && continues(text, 2) && continues(text, 3)) {
    const std::uint32_t c = (lead & 0x07u) << 18 | payload(text, 1) << 12 | payload(text, 2) << 6 | payload(text, 3);
    return c >= 0x10000 && c < 0x110000 ? Char{c, 4} : Char{};
  }
  return {};
}

Char last(std::string_view text) {
  std::size_t start = text.size() - 1;
  while (start > 0 && continues(text, start)) --start;
  return first(text.substr(start));
}

void append(std::string& out, std::uint32_t c) {
  const auto tail = [&](int shift) { out.push_back(static_cast<char>(0x80 | ((c >> shift) & 0x3F))); };
  if (c < 0x80) {
    out.push_back(static_cast<char>(c));
  } else if (c < 0x800) {
    out.push_back(static_cast<char>(0xC0 | c >> 6)), tail(0);
  } else if (c < 0x10000) {
    out.push_back(static_cast<char>(0xE0 | c >> 12)), tail(6), tail(0);
  } else {
    out.push_back(static_cast<char>(0xF0 | c >> 18)), tail(12), tail(6), tail(0);
  }
}

std::size_t valid_prefix(std::string_view text) {
  std::size_t end = 0;
  while (end < text.size()) {
    const std::size_t size = first(text.substr(end)).size;
    if (size == 0) break;
    end += size;
  }
  return end;
}

}  // namespace vla::unicode
