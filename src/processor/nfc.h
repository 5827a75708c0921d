// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace vla {

/// Normalizes valid UTF-8 to Unicode's form C (NFC): a letter and its accent become one character where one exists, and
/// marks get a fixed order. Equal to the NFC of the Hugging Face `tokenizers` library on every string: characters that
/// are missing in that library's older Unicode tables stay unchanged.
std::string nfc(std::string_view text);
/// The same in form D (NFD): letters are separated from accents, Korean syllables into parts.
std::string nfd(std::string_view text);

}  // namespace vla
