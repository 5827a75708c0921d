// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"

namespace vla {

/// Splits text into the words inside which tokens are formed.
/// Source: tokenizers pre_tokenizers/digits.rs, split.rs and byte_level.rs.
class Pretokenizer {
 public:
  /// Reads `tokenizer.pre`: digits and split steps in any number, then one byte_level step. Errors: bad_bundle.
  static Result<Pretokenizer> parse(const std::string& json);

  /// Calls `on_word` for every word of valid UTF-8 `text`, in order. With `add_prefix_space` a word may start with a
  /// space that the text does not have.
  void split(std::string_view text, const std::function<void(std::string_view)>& on_word) const;

 private:
  enum class Step { digits_together, digits_individual, qwen2_words, llama3_words };

  void split_from(std::size_t step, std::string_view text, const std::function<void(std::string_view)>& on_word) const;
  void split_bytes(std::string_view text, const std::function<void(std::string_view)>& on_word) const;

  std::vector<Step> steps_;
  bool add_prefix_space_ = false;
  bool use_regex_ = true;
};

/// Length in bytes of the first match of the GPT-2 splitting expression `'s|'t|'re|'ve|'m|'ll|'d| ?\p{L}+| ?\p{N}+|
/// ?[^\s\p{L}\p{N}]+|\s+(?!\S)|\s+` at the start of non-empty, valid UTF-8. It matches everywhere.
std::size_t gpt2_word(std::string_view text);

/// The splitting expressions of Qwen2 and Llama 3, which a split step may name. They differ in the number of digits per
/// word.
inline constexpr const char* kQwen2Words =
    R"((?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+)";
inline constexpr const char* kLlama3Words =
    R"((?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}{1,3}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+)";

/// Length in bytes of their first match at the start of non-empty, valid UTF-8. Both match everywhere.
std::size_t qwen2_word(std::string_view text);
std::size_t llama3_word(std::string_view text);

}  // namespace vla
