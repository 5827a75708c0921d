// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace vla {

/// Text as a terminal may show it: what would move the cursor, change colours, turn the direction of writing or begin a
/// line, and bytes that are no UTF-8, come out as `\xNN` or `\u{NNNN}`. Letters of all languages stay.
std::string printable(std::string_view text);

/// Whether `printable` would leave all of it as it is.
bool is_printable(std::string_view text);

}  // namespace vla
