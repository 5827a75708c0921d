// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace vla {

/// Escapes a text for a terminal. Characters that move the cursor, change colours, change the text direction or start a
/// line, and bytes that are not UTF-8, become `\xNN` or `\u{NNNN}`. Letters of all languages stay as they are.
std::string printable(std::string_view text);

/// Whether `printable` would return the text unchanged.
bool is_printable(std::string_view text);

}  // namespace vla
