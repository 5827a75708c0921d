// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/byte_fallback_bpe.h"

#include <fmt/format.h>

#include "processor/unicode.h"

namespace vla {

Result<ByteFallbackBpe> ByteFallbackBpe::create(const std::vector<std::string>& tokens,
                                                const std::vector<std::string>& merges) {
  ByteFallbackBpe bpe;
  VLA_TRY(const TokenIds ids, index_tokens(tokens));
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    const unicode::Char c = unicode::first(tokens[i]);
    if (c.size > 0 && c.size == tokens[i].size()) bpe.char_ids_.emplace(c.code_point, static_cast<std::int32_t>(i));
  }
  for (std::uint32_t byte = 0; byte < bpe.byte_ids_.size(); ++byte) {
    const auto found = ids.find(fmt::format("<0x{:02X}>", byte));
    if (found != ids.end()) {
      bpe.byte_ids_[byte] = found->second;
    } else if (byte > 0x7F || bpe.char_ids_.count(byte) == 0) {  // the character's own token takes precedence
      return Error{Code::bad_bundle, "tokenizer.tokens", "a token for each of the 256 bytes",
                   fmt::format("none for <0x{:02X}>", byte)};
    }
  }
  VLA_TRY(bpe.merges_, Merges::create(ids, merges));
  return bpe;
}

std::string ByteFallbackBpe::mark_blanks(std::string_view text) {
  std::string marked;
  marked.reserve(text.size() + text.size() / 2);
  for (const char c : text) c == ' ' ? marked.append("\xE2\x96\x81") : marked.append(1, c);
  return marked;
}

std::string ByteFallbackBpe::mark_blanks_and_first(std::string_view text) {
  return text.empty() ? std::string() : mark_blanks(" ") + mark_blanks(text);
}

void ByteFallbackBpe::encode(std::string_view piece, std::vector<std::int32_t>& ids) const {
  std::vector<std::int32_t> symbols;
  symbols.reserve(piece.size());
  while (!piece.empty()) {
    const unicode::Char c = unicode::first(piece);
    if (const auto found = char_ids_.find(c.code_point); found != char_ids_.end()) {
      symbols.push_back(found->second);
    } else {
      for (const char byte : piece.substr(0, c.size)) symbols.push_back(byte_ids_[static_cast<std::uint8_t>(byte)]);
    }
    piece.remove_prefix(c.size);
  }
  merges_.apply(symbols, ids);
}

}  // namespace vla
