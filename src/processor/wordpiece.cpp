// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/wordpiece.h"

#include <algorithm>

#include "processor/nfc.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr std::string_view kWithin = "##";
constexpr std::size_t kMaxWord = 100;  // characters

struct Range {
  std::uint32_t first, last;
};

/// The reference's ranges of Chinese characters. Its range of extension E starts 256 code points late.
constexpr Range kChinese[] = {{0x3400, 0x4DBF},   {0x4E00, 0x9FFF},   {0xF900, 0xFAFF},  {0x20000, 0x2A6DF},
                              {0x2A700, 0x2B81F}, {0x2B920, 0x2CEAF}, {0x2F800, 0x2FA1F}};

bool is_chinese(std::uint32_t c) {
  return std::any_of(std::begin(kChinese), std::end(kChinese),
                     [c](const Range& range) { return c >= range.first && c <= range.last; });
}

template <class Use>
void each_char(std::string_view text, Use use) {
  for (unicode::Char c; !text.empty(); text.remove_prefix(c.size)) {
    c = unicode::first(text);
    use(c.code_point, text.substr(0, c.size));
  }
}

std::string cleaned(std::string_view text) {
  std::string out;
  out.reserve(text.size());
  each_char(text, [&](std::uint32_t c, std::string_view bytes) {
    if (unicode::is(c, unicode::kControl)) return;
    if (unicode::is(c, unicode::kSpace)) bytes = " ";
    is_chinese(c) ? out.append(" ").append(bytes).append(" ") : out.append(bytes);
  });
  return out;
}

/// Length of the first `kMaxWord` characters, in bytes.
std::size_t word_limit(std::string_view word) {
  std::size_t size = 0;
  for (std::size_t i = 0; i < kMaxWord && size < word.size(); ++i) size += unicode::first(word.substr(size)).size;
  return size;
}

}  // namespace

Result<WordPiece> WordPiece::create(const std::vector<std::string>& tokens, const std::vector<bool>& is_added,
                                    std::int32_t unknown) {
  WordPiece model;
  model.unknown_ = unknown;
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    if (is_added[i]) continue;
    const bool is_tail = tokens[i].starts_with(kWithin);
    const std::string text = is_tail ? tokens[i].substr(kWithin.size()) : tokens[i];
    if (!(is_tail ? model.tails_ : model.heads_).emplace(text, static_cast<std::int32_t>(i)).second)
      return Error{Code::bad_bundle, "tokenizer.tokens", "every token once", tokens[i]};
    model.longest_ = std::max(model.longest_, text.size());
  }
  return model;
}

std::string WordPiece::normalize(std::string_view text) {
  const std::string parts = nfd(cleaned(text));
  std::string out;
  out.reserve(parts.size());
  each_char(parts, [&](std::uint32_t c, std::string_view) {
    if (!unicode::is(c, unicode::kMark)) unicode::append(out, unicode::lower(c));
  });
  return out;
}

void WordPiece::encode(std::string_view text, std::vector<std::int32_t>& ids) const {
  std::size_t start = 0, at = 0;  // start of the word; bytes read so far
  const auto end_word = [&] {
    if (at > start) encode_word(text.substr(start, at - start), ids);
  };
  each_char(text, [&](std::uint32_t c, std::string_view bytes) {
    const bool is_mark = unicode::is(c, unicode::kPunctuation);
    if (is_mark || c == ' ') {
      end_word();
      if (is_mark) encode_word(bytes, ids);
      start = at + bytes.size();
    }
    at += bytes.size();
  });
  end_word();
}

void WordPiece::encode_word(std::string_view word, std::vector<std::int32_t>& ids) const {
  const std::size_t n_before = ids.size();
  if (word_limit(word) < word.size()) return ids.push_back(unknown_);
  const Pieces* pieces = &heads_;
  while (!word.empty()) {
    std::size_t size = std::min(word.size(), longest_);
    auto found = pieces->end();
    for (; size > 0 && found == pieces->end(); --size) found = pieces->find(word.substr(0, size));
    if (found == pieces->end()) {
      ids.resize(n_before);
      return ids.push_back(unknown_);
    }
    ids.push_back(found->second);
    word.remove_prefix(found->first.size());
    pieces = &tails_;
  }
}

}  // namespace vla
