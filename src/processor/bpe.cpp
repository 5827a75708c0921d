// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/bpe.h"

#include <algorithm>
#include <optional>
#include <queue>

#include "processor/unicode.h"

namespace vla {
namespace {

using TokenIds = std::unordered_map<std::string_view, std::int32_t>;

bool is_printable(int byte) {
  return (byte >= '!' && byte <= '~') || (byte >= 0xA1 && byte <= 0xAC) || (byte >= 0xAE && byte <= 0xFF);
}

/// Printable Latin-1 bytes are their own symbols; the other 68 follow from U+0100 on, in order.
std::array<std::uint32_t, 256> make_symbols() {
  std::array<std::uint32_t, 256> symbols{};
  std::uint32_t next = 0x100;
  for (int byte = 0; byte < 256; ++byte)
    symbols[static_cast<std::size_t>(byte)] = is_printable(byte) ? static_cast<std::uint32_t>(byte) : next++;
  return symbols;
}

/// The bytes that a token's text stands for, or nothing when the text is not of the alphabet.
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

Result<TokenIds> index_tokens(const std::vector<std::string>& tokens) {
  TokenIds ids;
  ids.reserve(tokens.size());
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    const std::string where = "tokenizer.tokens[" + std::to_string(i) + "]";
    if (tokens[i].empty()) return Error{Code::bad_bundle, where, "a token", "an empty string"};
    const auto [other, fresh] = ids.emplace(tokens[i], static_cast<std::int32_t>(i));
    if (!fresh)
      return Error{Code::bad_bundle, where, "one id per token", "the text of token " + std::to_string(other->second)};
  }
  return ids;
}

std::uint64_t pair_key(std::int32_t left, std::int32_t right) {
  return static_cast<std::uint64_t>(static_cast<std::uint32_t>(left)) << 32 | static_cast<std::uint32_t>(right);
}

/// A part of the word while it is merged: a linked list in an array.
struct Symbol {
  std::int32_t id;
  int prev, next;  // -1 at the ends
  bool merged_away;
};

struct Candidate {
  std::int32_t rank;
  int left;  // position of the left symbol
  std::int32_t id;

  bool operator<(const Candidate& other) const {  // the queue's top is the lowest rank, leftmost first
    return rank != other.rank ? rank > other.rank : left > other.left;
  }
};

}  // namespace

int byte_of_symbol(std::uint32_t code_point) {
  static const std::array<std::uint32_t, 256> symbols = make_symbols();
  const auto found = std::find(symbols.begin(), symbols.end(), code_point);
  return found == symbols.end() ? -1 : static_cast<int>(found - symbols.begin());
}

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
  for (std::size_t rank = 0; rank < merges.size(); ++rank) {
    const std::string where = "tokenizer.merges[" + std::to_string(rank) + "]";
    const std::string_view merge = merges[rank];
    const std::size_t blank = merge.find(' ');
    if (blank == std::string_view::npos || merge.find(' ', blank + 1) != std::string_view::npos)
      return Error{Code::bad_bundle, where, "two tokens and one blank", "text of another form"};
    const std::string_view parts[] = {merge.substr(0, blank), merge.substr(blank + 1)};
    const std::string whole = std::string(parts[0]) + std::string(parts[1]);
    for (const std::string_view text : {parts[0], parts[1], std::string_view(whole)})
      if (!ids.contains(text))
        return Error{Code::bad_bundle, where, "two tokens that make a third", "a part or result without an id"};
    // Of two merges of the same pair the later one counts, as in the reference.
    bpe.merges_.insert_or_assign(pair_key(ids.at(parts[0]), ids.at(parts[1])),
                                 Merge{static_cast<std::int32_t>(rank), ids.at(whole)});
  }
  if (!ignore_merges) return bpe;
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    // An added token is found before words are formed, so its text is never a word by itself.
    if (is_added[i]) continue;
    if (auto bytes = bytes_of(tokens[i])) bpe.whole_words_.emplace(std::move(*bytes), static_cast<std::int32_t>(i));
  }
  return bpe;
}

const Bpe::Merge* Bpe::find(std::int32_t left, std::int32_t right) const {
  const auto found = merges_.find(pair_key(left, right));
  return found == merges_.end() ? nullptr : &found->second;
}

void Bpe::encode(std::string_view word, std::vector<std::int32_t>& ids) const {
  if (!whole_words_.empty()) {
    if (const auto found = whole_words_.find(std::string(word)); found != whole_words_.end()) {
      ids.push_back(found->second);
      return;
    }
  }
  const int n = static_cast<int>(word.size());
  std::vector<Symbol> symbols(word.size());
  const auto at = [&](int i) -> Symbol& { return symbols[static_cast<std::size_t>(i)]; };
  for (int i = 0; i < n; ++i)
    at(i) = {byte_ids_[static_cast<std::uint8_t>(word[static_cast<std::size_t>(i)])], i - 1, i + 1 < n ? i + 1 : -1,
             false};

  std::vector<Candidate> storage;
  storage.reserve(word.size());
  std::priority_queue queue(std::less<Candidate>{}, std::move(storage));
  const auto consider = [&](int left) {
    if (left < 0 || at(left).next < 0) return;
    if (const Merge* merge = find(at(left).id, at(at(left).next).id)) queue.push({merge->rank, left, merge->id});
  };
  for (int i = 0; i < n; ++i) consider(i);

  while (!queue.empty()) {
    const Candidate top = queue.top();
    queue.pop();
    Symbol& left = at(top.left);
    if (left.merged_away || left.next < 0) continue;
    Symbol& right = at(left.next);
    // The pair may have changed since it was queued. Like the reference, what counts is the token it becomes now.
    const Merge* merge = find(left.id, right.id);
    if (merge == nullptr || merge->id != top.id) continue;
    right.merged_away = true;
    left.id = top.id;
    left.next = right.next;
    if (left.next >= 0) at(left.next).prev = top.left;
    consider(left.prev);
    consider(top.left);
  }
  for (int i = 0; i >= 0 && i < n; i = at(i).next) ids.push_back(at(i).id);
}

}  // namespace vla
