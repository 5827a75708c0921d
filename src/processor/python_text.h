// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

/// Text operations as Python's str defines them. The tables come from Python 3.11 with Unicode 14; newer characters are
/// not letters.
namespace vla::python {

/// str.isspace(): bidirectional class WS, B or S, or category Zs.
bool is_space(std::uint32_t code_point);

/// str.isalnum().
bool is_alnum(std::uint32_t code_point);

/// str.lower() for valid UTF-8: the dotted capital I becomes two characters, and a sigma at the end of a word becomes
/// the final form.
std::string lower(std::string_view text);

/// Removes everything from valid UTF-8 that is neither alphanumeric nor white space nor an underscore, like
/// re.sub(r"[^\w\s]", "", text).
std::string drop_punctuation(std::string_view text);

/// str([text]) of valid UTF-8: the text between brackets and quotes, with escapes for characters that are not
/// printable.
std::string list_of(std::string_view text);

}  // namespace vla::python
