// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

/// Text as Python's str sees it. The tables were made by asking Python 3.11, of Unicode 14; characters that are newer
/// are no letters to it.
namespace vla::python {

/// str.isspace(): bidirectional class WS, B or S, or category Zs.
bool is_space(std::uint32_t code_point);

/// str.isalnum().
bool is_alnum(std::uint32_t code_point);

/// Valid UTF-8 by str.lower(): one capital dotted I becomes two characters, and a sigma that ends a word a final one.
std::string lower(std::string_view text);

/// Valid UTF-8 without what is neither alphanumeric nor white space nor an underscore, as
/// re.sub(r"[^\w\s]", "", text) leaves it.
std::string drop_punctuation(std::string_view text);

}  // namespace vla::python
