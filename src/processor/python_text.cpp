// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/python_text.h"

#include <fmt/format.h>

#include <algorithm>
#include <iterator>

#include "processor/capitals.h"
#include "processor/unicode.h"

namespace vla::python {
namespace {

/// Flags of a run of code points. A cased character is part of a word of letters; an ignorable one, such as an
/// apostrophe, does not end the word.
enum Class : std::uint8_t { kAlnum = 1, kCased = 2, kIgnorable = 4, kPrintable = 8 };

struct Run {
  std::uint32_t start;
  std::uint8_t classes;
};

constexpr Run kRuns[] = {
#include "processor/python_classes.inc"
};

constexpr Capitals kCapitals[] = {
#include "processor/python_lower.inc"
};

constexpr std::uint32_t kSigma = 0x3A3, kDottedI = 0x130;

std::uint8_t classes(std::uint32_t c) {
  const auto after = std::upper_bound(std::begin(kRuns), std::end(kRuns), c,
                                      [](std::uint32_t code_point, const Run& run) { return code_point < run.start; });
  return std::prev(after)->classes;  // the first run starts at 0
}

/// Whether the first character that is not ignorable is cased. `before`: searches backwards from the end.
bool meets_cased(std::string_view text, bool before) {
  while (!text.empty()) {
    const unicode::Char c = before ? unicode::last(text) : unicode::first(text);
    const std::uint8_t found = classes(c.code_point);
    if ((found & kIgnorable) == 0) return (found & kCased) != 0;
    before ? text.remove_suffix(c.size) : text.remove_prefix(c.size);
  }
  return false;
}

std::string escaped(std::uint32_t c) {
  if (c == '\t') return "\\t";
  if (c == '\n') return "\\n";
  if (c == '\r') return "\\r";
  if (c <= 0xFF) return fmt::format("\\x{:02x}", c);
  return c <= 0xFFFF ? fmt::format("\\u{:04x}", c) : fmt::format("\\U{:08x}", c);
}

}  // namespace

bool is_space(std::uint32_t c) {
  return (c >= 0x09 && c <= 0x0D) || (c >= 0x1C && c <= 0x20) || c == 0x85 || c == 0xA0 || c == 0x1680 ||
         (c >= 0x2000 && c <= 0x200A) || c == 0x2028 || c == 0x2029 || c == 0x202F || c == 0x205F || c == 0x3000;
}

bool is_alnum(std::uint32_t c) { return (classes(c) & kAlnum) != 0; }

std::string lower(std::string_view text) {
  std::string out;
  out.reserve(text.size());
  for (std::size_t at = 0; at < text.size();) {
    const unicode::Char c = unicode::first(text.substr(at));
    const std::size_t next = at + c.size;
    if (c.code_point == kDottedI) {
      out += "i\u0307";
    } else if (c.code_point == kSigma) {
      const bool ends_word = meets_cased(text.substr(0, at), true) && !meets_cased(text.substr(next), false);
      out += ends_word ? "\u03c2" : "\u03c3";
    } else {
      unicode::append(out, small_letter(kCapitals, c.code_point));
    }
    at = next;
  }
  return out;
}

std::string drop_punctuation(std::string_view text) {
  std::string out;
  out.reserve(text.size());
  while (!text.empty()) {
    const unicode::Char c = unicode::first(text);
    if (is_alnum(c.code_point) || is_space(c.code_point) || c.code_point == '_') out.append(text.substr(0, c.size));
    text.remove_prefix(c.size);
  }
  return out;
}

std::string list_of(std::string_view text) {
  const bool has_apostrophe = text.find('\'') != std::string_view::npos;
  const char quote = has_apostrophe && text.find('"') == std::string_view::npos ? '"' : '\'';
  std::string out = {'[', quote};
  while (!text.empty()) {
    const unicode::Char c = unicode::first(text);
    if (c.code_point == '\\' || c.code_point == static_cast<unsigned char>(quote)) out.push_back('\\');
    out += (classes(c.code_point) & kPrintable) != 0 ? std::string(text.substr(0, c.size)) : escaped(c.code_point);
    text.remove_prefix(c.size);
  }
  return out.append({quote, ']'});
}

}  // namespace vla::python
