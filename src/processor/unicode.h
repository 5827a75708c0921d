// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

/// UTF-8 and character classes as the reference tokenizer sees them.
///
/// The classes come from a table that was made by asking the reference about every code point. A system's own Unicode
/// library is of another Unicode version on each system, and one more letter changes how a sentence splits into tokens;
/// the same bundle and text must give the same ids everywhere.
namespace vla::unicode {

/// Bits of `classes`.
enum Class : std::uint16_t {
  kLetter = 1,         // \p{L} of the splitting expression
  kNumber = 2,         // \p{N} of the splitting expression
  kSpace = 4,          // \s of the splitting expression and of added tokens
  kDigit = 8,          // what the digits step calls numeric; a few code points newer than kNumber
  kWord = 16,          // \w of added tokens
  kNormal = 32,        // takes part in the normalization NFC: composes, decomposes or is put in order
  kControl = 64,       // what BERT's cleaning removes; the three that it keeps as blanks are not among them
  kPunctuation = 128,  // a word of its own for BERT
  kMark = 256,         // an accent that BERT's normalization removes
};

std::uint16_t classes(std::uint32_t code_point);

/// The small letter of a character as BERT's normalization makes it, or the character itself. U+0130, whose small
/// letter is two characters, decomposes before it is asked for.
std::uint32_t lower(std::uint32_t code_point);

struct Char {
  std::uint32_t code_point = 0;
  std::size_t size = 0;  // bytes; 0 when the text is empty or not UTF-8 at this place
};

/// The first character. Refuses, by size 0, what RFC 3629 does: overlong forms, surrogates, beyond U+10FFFF,
/// truncation.
Char first(std::string_view text);

/// The last character of valid, non-empty UTF-8.
Char last(std::string_view text);

/// Appends the UTF-8 of a code point.
void append(std::string& out, std::uint32_t code_point);

/// Bytes before the first place that is not UTF-8; `text.size()` when all of it is.
std::size_t valid_prefix(std::string_view text);

}  // namespace vla::unicode
