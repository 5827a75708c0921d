// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/pretokenizer.h"

#include <algorithm>

#include "processor/json_fields.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr const char* kPreKey = "tokenizer.pre";
constexpr std::size_t kMaxSteps = 8;  // no real tokenizer has more than two
constexpr std::uint8_t kLetterNumberSpace = unicode::kLetter | unicode::kNumber | unicode::kSpace;

/// The class of a character in the splitting expressions; 0 is `[^\s\p{L}\p{N}]`.
std::uint8_t kind(std::uint32_t code_point) {
  return static_cast<std::uint8_t>(unicode::classes(code_point) & kLetterNumberSpace);
}

/// Length of the longest prefix of one class, in bytes.
std::size_t run(std::string_view text, std::uint8_t wanted) {
  std::size_t size = 0;
  while (size < text.size()) {
    const unicode::Char c = unicode::first(text.substr(size));
    if (kind(c.code_point) != wanted) break;
    size += c.size;
  }
  return size;
}

/// Length of the longest prefix of at most `most` numbers, in bytes.
std::size_t numbers(std::string_view text, int most) {
  std::size_t size = 0;
  for (int i = 0; i < most && size < text.size(); ++i) {
    const unicode::Char c = unicode::first(text.substr(size));
    if (kind(c.code_point) != unicode::kNumber) break;
    size += c.size;
  }
  return size;
}

constexpr std::string_view kContractions[] = {"'s", "'t", "'re", "'ve", "'m", "'ll", "'d"};

std::size_t contraction(std::string_view text) {
  for (const std::string_view end : kContractions)
    if (text.starts_with(end)) return end.size();
  return 0;
}

/// The same for either case. The reference's expressions treat the long s, U+017F, as a lower-case s.
std::size_t contraction_of_any_case(std::string_view text) {
  constexpr std::string_view kLongS = "'\u017F";
  if (text.starts_with(kLongS)) return kLongS.size();
  std::string lower(text.substr(0, 3));
  for (char& c : lower)
    if (c >= 'A' && c <= 'Z') c = static_cast<char>(c - 'A' + 'a');
  return contraction(lower);
}

using OnPiece = std::function<void(std::string_view)>;

void split_words(std::size_t (*word)(std::string_view), std::string_view text, const OnPiece& on_word) {
  while (!text.empty()) {
    const std::size_t size = word(text);
    on_word(text.substr(0, size));
    text.remove_prefix(size);
  }
}

/// Splits into numbers and the text between them; `individual`: into single digits.
void split_digits(bool individual, std::string_view text, const OnPiece& on_piece) {
  std::size_t start = 0;
  bool numeric = false;  // class of the piece that begins at `start`
  for (std::size_t at = 0; at < text.size();) {
    const unicode::Char c = unicode::first(text.substr(at));
    const bool digit = (unicode::classes(c.code_point) & unicode::kDigit) != 0;
    if (at > start && (digit != numeric || (digit && individual))) {
      on_piece(text.substr(start, at - start));
      start = at;
    }
    numeric = digit;
    at += c.size;
  }
  if (start < text.size()) on_piece(text.substr(start));
}

/// `\s+(?!\S)|\s+`: the last of several white space characters before a word belongs to the word.
std::size_t white_space(std::string_view text) {
  const std::size_t spaces = run(text, unicode::kSpace);
  if (spaces == text.size()) return spaces;
  const std::size_t before_last = spaces - unicode::last(text.substr(0, spaces)).size;
  return before_last > 0 ? before_last : spaces;
}

}  // namespace

std::size_t gpt2_word(std::string_view text) {
  if (const std::size_t size = contraction(text)) return size;
  const std::size_t blank = text[0] == ' ' ? 1 : 0;
  if (blank < text.size()) {
    const std::uint8_t next = kind(unicode::first(text.substr(blank)).code_point);
    if (next != unicode::kSpace) return blank + run(text.substr(blank), next);
  }
  return white_space(text);
}

namespace {

/// `n_digit`: the maximum number of digits in one word.
std::size_t word_of(std::string_view text, int n_digit) {
  constexpr std::string_view kLineEnds = "\r\n";
  if (const std::size_t size = contraction_of_any_case(text)) return size;
  const unicode::Char first = unicode::first(text);
  const std::uint8_t first_kind = kind(first.code_point);
  if (first_kind == unicode::kLetter) return run(text, unicode::kLetter);
  if (first_kind == unicode::kNumber) return numbers(text, n_digit);
  if (kLineEnds.find(text[0]) == std::string_view::npos)
    if (const std::size_t letters = run(text.substr(first.size), unicode::kLetter)) return first.size + letters;
  const std::size_t blank = text[0] == ' ' ? 1 : 0;
  if (const std::size_t others = run(text.substr(blank), 0))
    return std::min(text.find_first_not_of(kLineEnds, blank + others), text.size());
  const std::string_view spaces = text.substr(0, run(text, unicode::kSpace));
  if (const std::size_t end = spaces.find_last_of(kLineEnds); end != std::string_view::npos) return end + 1;
  return white_space(text);
}

}  // namespace

std::size_t qwen2_word(std::string_view text) { return word_of(text, 1); }
std::size_t llama3_word(std::string_view text) { return word_of(text, 3); }

Result<Pretokenizer> Pretokenizer::parse(const std::string& json) {
  VLA_TRY(const Json list, parse_json_list(json, kPreKey));
  if (list.size() > kMaxSteps)
    return Error{Code::bad_bundle, kPreKey, "at most " + std::to_string(kMaxSteps) + " steps",
                 std::to_string(list.size())};
  Pretokenizer pretokenizer;
  bool closed = false;
  for (std::size_t i = 0; i < list.size(); ++i) {
    const std::string where = std::string(kPreKey) + "[" + std::to_string(i) + "]";
    if (closed) return Error{Code::bad_bundle, where, "nothing after byte_level", "another step"};
    VLA_TRY(JsonFields fields, JsonFields::open(list[i], where));
    VLA_TRY(const int type, fields.choice("type", {"digits", "split", "byte_level"}));
    if (type == 0) {
      VLA_TRY(const bool individual, fields.boolean("individual"));
      pretokenizer.steps_.push_back(individual ? Step::digits_individual : Step::digits_together);
    } else if (type == 1) {
      VLA_TRY(const int words, fields.choice("pattern", {kQwen2Words, kLlama3Words}));
      pretokenizer.steps_.push_back(words == 0 ? Step::qwen2_words : Step::llama3_words);
    } else {
      VLA_TRY(pretokenizer.add_prefix_space_, fields.boolean("add_prefix_space"));
      VLA_TRY(pretokenizer.use_regex_, fields.boolean("use_regex"));
      closed = true;
    }
    VLA_CHECK(fields.done());
  }
  if (!closed) return Error{Code::bad_bundle, kPreKey, "a last step of type byte_level", "none"};
  return pretokenizer;
}

void Pretokenizer::split(std::string_view text, const std::function<void(std::string_view)>& on_word) const {
  split_from(0, text, on_word);
}

void Pretokenizer::split_from(std::size_t step, std::string_view text,
                              const std::function<void(std::string_view)>& on_word) const {
  if (step == steps_.size()) return split_bytes(text, on_word);
  const auto emit = [&](std::string_view piece) { split_from(step + 1, piece, on_word); };
  if (steps_[step] == Step::qwen2_words) return split_words(qwen2_word, text, emit);
  if (steps_[step] == Step::llama3_words) return split_words(llama3_word, text, emit);
  split_digits(steps_[step] == Step::digits_individual, text, emit);
}

void Pretokenizer::split_bytes(std::string_view text, const std::function<void(std::string_view)>& on_word) const {
  std::string prefixed;
  if (add_prefix_space_ && !text.starts_with(' ')) {
    prefixed = std::string(1, ' ').append(text);
    text = prefixed;
  }
  if (use_regex_) return split_words(gpt2_word, text, on_word);
  if (!text.empty()) on_word(text);
}

}  // namespace vla
