// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/added_tokens.h"

#include <algorithm>
#include <set>

#include "processor/json_fields.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr const char* kAddedKey = "tokenizer.added";
constexpr std::size_t kMaxContent = 256;  // bytes; limits the work at each position of the text

Result<AddedToken> parse_added_token(const Json& item, std::string where, int n_vocab) {
  VLA_TRY(JsonFields fields, JsonFields::open(item, std::move(where)));
  AddedToken token;
  VLA_TRY(token.id, fields.integer("id", kNoRow, n_vocab - 1));
  VLA_TRY(token.content, fields.string("content"));
  VLA_TRY(token.single_word, fields.boolean("single_word"));
  VLA_TRY(token.lstrip, fields.boolean("lstrip"));
  VLA_TRY(token.rstrip, fields.boolean("rstrip"));
  VLA_TRY(token.normalized, fields.boolean("normalized"));
  VLA_CHECK(fields.boolean("special"));  // affects decoding of text only, which policies do not do
  VLA_CHECK(fields.done());
  if (token.content.empty() || token.content.size() > kMaxContent)
    return fields.wrong("content", "1 to " + std::to_string(kMaxContent) + " bytes");
  return token;
}

bool stands_alone(std::string_view before, std::string_view after) {
  const bool left = before.empty() || !unicode::is(unicode::last(before).code_point, unicode::kWord);
  const bool right = after.empty() || !unicode::is(unicode::first(after).code_point, unicode::kWord);
  return left && right;
}

/// Length of the white space at the end of `text`, in bytes.
std::size_t trailing_space(std::string_view text) {
  std::size_t size = 0;
  while (size < text.size()) {
    const unicode::Char c = unicode::last(text.substr(0, text.size() - size));
    if (!unicode::is(c.code_point, unicode::kSpace)) break;
    size += c.size;
  }
  return size;
}

std::size_t leading_space(std::string_view text) {
  std::size_t size = 0;
  while (size < text.size()) {
    const unicode::Char c = unicode::first(text.substr(size));
    if (!unicode::is(c.code_point, unicode::kSpace)) break;
    size += c.size;
  }
  return size;
}

}  // namespace

Result<std::vector<AddedToken>> parse_added_tokens(const std::string& json, int n_vocab) {
  VLA_TRY(const Json list, parse_json_list(json, kAddedKey));
  std::vector<AddedToken> tokens;
  std::set<std::int32_t> ids;
  std::set<std::string> contents;
  for (const Json& item : list) {
    const std::string where = std::string(kAddedKey) + "[" + std::to_string(tokens.size()) + "]";
    VLA_TRY(AddedToken token, parse_added_token(item, where, n_vocab));
    if (token.id != kNoRow && !ids.insert(token.id).second)
      return Error{Code::bad_bundle, where + ".id", "one added token per id", std::to_string(token.id) + " again"};
    if (!contents.insert(token.content).second)
      return Error{Code::bad_bundle, where + ".content", "one added token per content", token.content + " again"};
    tokens.push_back(std::move(token));
  }
  return tokens;
}

AddedTokens::AddedTokens(std::vector<AddedToken> tokens, Normalize normalize)
    : tokens_(std::move(tokens)), normalize_(normalize) {
  for (int i = 0; i < static_cast<int>(tokens_.size()); ++i) {
    const AddedToken& token = tokens_[static_cast<std::size_t>(i)];
    if (!token.normalized) {
      insert(plain_, token.content, i);
    } else {
      insert(normalized_, normalize_ != nullptr ? normalize_(token.content) : token.content, i);
    }
  }
}

void AddedTokens::insert(Trie& trie, std::string_view content, int token) {
  std::size_t node = 0;
  for (const char c : content) {
    const auto byte = static_cast<std::uint8_t>(c);
    auto& next = trie[node].next;
    const auto found = std::find_if(next.begin(), next.end(), [byte](const auto& edge) { return edge.first == byte; });
    if (found != next.end()) {
      node = static_cast<std::size_t>(found->second);
    } else {
      next.emplace_back(byte, static_cast<int>(trie.size()));
      node = trie.size();
      trie.emplace_back();
    }
  }
  trie[node].token = token;
}

AddedTokens::Match AddedTokens::longest_at(const Trie& trie, std::string_view text) {
  Match longest;
  std::size_t node = 0;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto& next = trie[node].next;
    const auto byte = static_cast<std::uint8_t>(text[i]);
    const auto found = std::find_if(next.begin(), next.end(), [byte](const auto& edge) { return edge.first == byte; });
    if (found == next.end()) break;
    node = static_cast<std::size_t>(found->second);
    if (trie[node].token >= 0) longest = {trie[node].token, i + 1};
  }
  return longest;
}

void AddedTokens::split(std::string_view text, const std::function<void(std::string_view)>& on_text,
                        const std::function<void(std::int32_t)>& on_token) const {
  const auto on_piece = [&](std::string_view piece) {
    if (normalize_ == nullptr) return split(normalized_, piece, on_text, on_token);
    split(normalized_, normalize_(piece), on_text, on_token);
  };
  split(plain_, text, on_piece, on_token);
}

void AddedTokens::split(const Trie& trie, std::string_view text, const std::function<void(std::string_view)>& on_text,
                        const std::function<void(std::int32_t)>& on_token) const {
  std::size_t done = 0;  // bytes already passed to a callback
  for (std::size_t at = 0; at < text.size();) {
    const Match match = longest_at(trie, text.substr(at));
    if (match.token < 0) {
      ++at;
      continue;
    }
    const AddedToken& token = tokens_[static_cast<std::size_t>(match.token)];
    std::size_t start = at;
    std::size_t stop = at + match.size;
    at = stop;  // skips the whole rejected match, as the reference's search does
    if (token.single_word && !stands_alone(text.substr(0, start), text.substr(stop))) continue;
    // White space that the previous token took stays with that token.
    if (token.lstrip && start > done) start -= trailing_space(text.substr(done, start - done));
    if (token.rstrip) stop = std::max(stop, done), stop += leading_space(text.substr(stop));
    if (start > done) on_text(text.substr(done, start - done));
    on_token(token.id);
    done = stop;
  }
  if (done < text.size()) on_text(text.substr(done));
}

}  // namespace vla
