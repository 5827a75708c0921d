// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace vla {

/// Valid UTF-8 in Unicode's normalization form C: a letter followed by its accent becomes one character where there is
/// one, and marks come in a fixed order. Equal to the NFC of the Hugging Face `tokenizers` library on every string.
/// That library's tables are older than any system's: characters that they do not know stay as and where they are.
std::string nfc(std::string_view text);
/// The same in normalization form D: every letter apart from its accents, Korean syllables in their parts.
std::string nfd(std::string_view text);

}  // namespace vla
