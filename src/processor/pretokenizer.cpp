// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/pretokenizer.h"

#include "processor/json_fields.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr const char* kWhere = "tokenizer.pre";
constexpr std::size_t kMaxSteps = 8;  // no real tokenizer has more than two
constexpr std::uint8_t kLetterNumberSpace = unicode::kLetter | unicode::kNumber | unicode::kSpace;

/// The one of the expression's classes that a character is in; 0 is `[^\s\p{L}\p{N}]`.
std::uint8_t kind(std::uint32_t code_point) { return unicode::classes(code_point) & kLetterNumberSpace; }

/// Bytes of the longest run of one kind at the start.
std::size_t run(std::string_view text, std::uint8_t wanted) {
  std::size_t size = 0;
  while (size < text.size()) {
    const unicode::Char c = unicode::first(text.substr(size));
    if (kind(c.code_point) != wanted) break;
    size += c.size;
  }
  return size;
}

std::size_t contraction(std::string_view text) {
  for (const std::string_view end : {"'s", "'t", "'re", "'ve", "'m", "'ll", "'d"})
    if (text.starts_with(end)) return end.size();
  return 0;
}

}  // namespace

std::size_t gpt2_word(std::string_view text) {
  if (const std::size_t size = contraction(text)) return size;
  const std::size_t blank = text[0] == ' ' ? 1 : 0;
  if (blank < text.size()) {
    const std::uint8_t next = kind(unicode::first(text.substr(blank)).code_point);
    if (next != unicode::kSpace) return blank + run(text.substr(blank), next);
  }
  const std::size_t spaces = run(text, unicode::kSpace);
  if (spaces == text.size()) return spaces;
  // `\s+(?!\S)` gives the last white space back to what follows it, unless there is only one.
  const std::size_t before_last = spaces - unicode::last(text.substr(0, spaces)).size;
  return before_last > 0 ? before_last : spaces;
}

Result<Pretokenizer> Pretokenizer::parse(const std::string& json) {
  VLA_TRY(const Json list, parse_json_list(json, kWhere));
  if (list.size() > kMaxSteps)
    return Error{Code::bad_bundle, kWhere, "at most " + std::to_string(kMaxSteps) + " steps",
                 std::to_string(list.size())};
  Pretokenizer pretokenizer;
  bool closed = false;
  for (std::size_t i = 0; i < list.size(); ++i) {
    const std::string where = std::string(kWhere) + "[" + std::to_string(i) + "]";
    if (closed) return Error{Code::bad_bundle, where, "nothing after byte_level", "another step"};
    VLA_TRY(JsonFields fields, JsonFields::open(list[i], where));
    VLA_TRY(const int type, fields.choice("type", {"digits", "byte_level"}));
    if (type == 0) {
      VLA_TRY(const bool individual, fields.boolean("individual"));
      pretokenizer.digits_.push_back(individual ? Digits::individual : Digits::together);
    } else {
      VLA_TRY(pretokenizer.add_prefix_space_, fields.boolean("add_prefix_space"));
      VLA_TRY(pretokenizer.use_regex_, fields.boolean("use_regex"));
      closed = true;
    }
    VLA_CHECK(fields.done());
  }
  if (!closed) return Error{Code::bad_bundle, kWhere, "a last step of type byte_level", "none"};
  return pretokenizer;
}

void Pretokenizer::split(std::string_view text, const std::function<void(std::string_view)>& on_word) const {
  split_digits(0, text, on_word);
}

void Pretokenizer::split_digits(std::size_t step, std::string_view text,
                                const std::function<void(std::string_view)>& on_word) const {
  if (step == digits_.size()) return split_bytes(text, on_word);
  const auto emit = [&](std::size_t start, std::size_t end) {
    if (end > start) split_digits(step + 1, text.substr(start, end - start), on_word);
  };
  std::size_t start = 0;
  bool numeric = false;  // of the piece that begins at `start`
  for (std::size_t at = 0; at < text.size();) {
    const unicode::Char c = unicode::first(text.substr(at));
    const bool digit = (unicode::classes(c.code_point) & unicode::kDigit) != 0;
    if (digit != numeric || (digit && digits_[step] == Digits::individual)) {
      emit(start, at);
      start = at;
      numeric = digit;
    }
    at += c.size;
  }
  emit(start, text.size());
}

void Pretokenizer::split_bytes(std::string_view text, const std::function<void(std::string_view)>& on_word) const {
  std::string prefixed;
  if (add_prefix_space_ && !text.starts_with(' ')) {
    prefixed = std::string(1, ' ').append(text);
    text = prefixed;
  }
  while (!text.empty()) {
    const std::size_t size = use_regex_ ? gpt2_word(text) : text.size();
    on_word(text.substr(0, size));
    text.remove_prefix(size);
  }
}

}  // namespace vla
