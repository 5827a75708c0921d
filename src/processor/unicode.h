// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

/// UTF-8 and character classes as the reference tokenizer sees them.
///
/// The classes come from a table made by asking the reference about every code point. A system's own Unicode library
/// has another Unicode version on each system, and one more letter changes how a sentence splits into tokens; the same
/// bundle and text must give the same ids everywhere.
namespace vla::unicode {

/// Bits of `classes`.
enum Class : std::uint16_t {
  kLetter = 1,         // \p{L} in the splitting expression
  kNumber = 2,         // \p{N} in the splitting expression
  kSpace = 4,          // \s in the splitting expression and for added tokens
  kDigit = 8,          // numeric for the digits step; has a few code points that are newer than kNumber's
  kWord = 16,          // \w for added tokens
  kNormal = 32,        // takes part in NFC: composes, decomposes or is reordered
  kControl = 64,       // removed by BERT's cleaning, except the three that it keeps as spaces
  kPunctuation = 128,  // a word of its own for BERT
  kMark = 256,         // an accent that BERT's normalization removes
};

std::uint16_t classes(std::uint32_t code_point);
inline bool is(std::uint32_t code_point, Class wanted) { return (classes(code_point) & wanted) != 0; }

/// BERT's small letter of a character, or the character itself. U+0130, whose small letter has two characters, is
/// decomposed before.
std::uint32_t lower(std::uint32_t code_point);

struct Char {
  std::uint32_t code_point = 0;
  std::size_t size = 0;  // bytes; 0 if the text is empty or not UTF-8 here
};

/// Decodes the first character. Size 0 for what RFC 3629 refuses: overlong forms, surrogates, code points above
/// U+10FFFF, truncation.
Char first(std::string_view text);

/// Decodes the last character of valid, non-empty UTF-8.
Char last(std::string_view text);

/// Appends the UTF-8 of a code point.
void append(std::string& out, std::uint32_t code_point);

/// Length of the longest prefix that is valid UTF-8, in bytes.
std::size_t valid_prefix(std::string_view text);

}  // namespace vla::unicode
