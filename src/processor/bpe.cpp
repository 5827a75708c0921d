// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/bpe.h"

#include <algorithm>
#include <optional>

#include "processor/unicode.h"

namespace vla {
namespace {

bool is_printable(int byte) {
  return (byte >= '!' && byte <= '~') || (byte >= 0xA1 && byte <= 0xAC) || (byte >= 0xAE && byte <= 0xFF);
}

/// Printable Latin-1 bytes are their own symbols; the other 68 bytes are U+0100 and following, in order.
std::array<std::uint32_t, 256> make_symbols() {
  std::array<std::uint32_t, 256> symbols{};
  std::uint32_t next = 0x100;
  for (int byte = 0; byte < 256; ++byte)
    symbols[static_cast<std::size_t>(byte)] = is_printable(byte) ? static_cast<std::uint32_t>(byte) : next++;
  return symbols;
}

/// The bytes that a token's text encodes; none if a character is not in the alphabet.
std::optional<std::string> bytes_of(std::string_view text) {
  std::string bytes;
  while (!text.empty()) {
    const unicode::Char c = unicode::first(text);
    const int byte = c.size > 0 ? byte_of_symbol(c.code_point) : -1;
    if (byte < 0) return std::nullopt;
    bytes.push_back(static_cast<char>(byte));
    text.remove_prefix(c.size);
  }
  return bytes;
}

std::string utf8_of_symbol(std::uint32_t symbol) {  // the alphabet ends below U+0800
  if (symbol < 0x80) return std::string(1, static_cast<char>(symbol));
  return {static_cast<char>(0xC0 | symbol >> 6), static_cast<char>(0x80 | (symbol & 0x3F))};
}

}  // namespace

int byte_of_symbol(std::uint32_t code_point) {
  static const std::array<std::uint32_t, 256> symbols = make_symbols();
  const auto found = std::find(symbols.begin(), symbols.end(), code_point);
  return found == symbols.end() ? -1 : static_cast<int>(found - symbols.begin());
}

std::string bytes_of_token(const std::string& text) { return bytes_of(text).value_or(text); }

Result<Bpe> Bpe::create(const std::vector<std::string>& tokens, const std::vector<std::string>& merges,
                        bool ignore_merges, const std::vector<bool>& is_added) {
  Bpe bpe;
  VLA_TRY(const TokenIds ids, index_tokens(tokens));
  const auto symbols = make_symbols();
  for (std::size_t byte = 0; byte < symbols.size(); ++byte) {
    const auto found = ids.find(utf8_of_symbol(symbols[byte]));
    if (found == ids.end())
      return Error{Code::bad_bundle, "tokenizer.tokens", "a token for each of the 256 bytes",
                   "none for byte " + std::to_string(byte)};
    bpe.byte_ids_[byte] = found->second;
  }
  VLA_TRY(bpe.merges_, Merges::create(ids, merges));
  if (!ignore_merges) return bpe;
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    // An added token is cut out before words are formed, so its text is never a word.
    if (is_added[i]) continue;
    if (auto bytes = bytes_of(tokens[i])) bpe.whole_words_.emplace(std::move(*bytes), static_cast<std::int32_t>(i));
  }
  return bpe;
}

void Bpe::encode(std::string_view word, std::vector<std::int32_t>& ids) const {
  if (!whole_words_.empty()) {
    if (const auto found = whole_words_.find(std::string(word)); found != whole_words_.end()) {
      ids.push_back(found->second);
      return;
    }
  }
  std::vector<std::int32_t> symbols;
  symbols.reserve(word.size());
  for (const char byte : word) symbols.push_back(byte_ids_[static_cast<std::uint8_t>(byte)]);
  merges_.apply(symbols, ids);
}

}  // namespace vla
