// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <fstream>
#include <span>
#include <string>

#include "processor/recipe.h"
#include "processor/tokenizer.h"
#include "processor/unicode.h"
#include "support/tokenizer_keys.h"

namespace vla::fuzz {

constexpr int kVocab = 4096;

inline Tokenizer load_tokenizer(const std::string& name) {
  std::ifstream file(VLA_SOURCE_DIR "/tests/processor/data/tokenizer_" + name + ".json");
  auto tokenizer = Tokenizer::create(test::keys_of(nlohmann::json::parse(file, nullptr, false)), kVocab);
  if (!tokenizer) std::abort();
  return std::move(*tokenizer);
}

/// Text is refused exactly when it is not UTF-8 or too long; every id is of the vocabulary.
inline void check_ids(const Tokenizer& tokenizer, const std::string& text) {
  const auto ids = tokenizer.encode(text);
  const bool sound = unicode::valid_prefix(text) == text.size() && text.size() <= Tokenizer::kMaxText;
  if (ids.ok() != sound) std::abort();
  if (!ids.ok()) return;
  for (const std::int32_t id : *ids)
    if (id < 0 || id >= kVocab) std::abort();
}

/// The first byte says what the others are: text for one of the tokenizers, or the JSON of a pre-tokenizer, of added
/// tokens or of a recipe. From 8 on it is text for a tokenizer with byte fallback, from 32
/// on for one that composes characters.
inline void check_tokenizer(std::string_view input) {
  static const Tokenizer tokenizers[] = {load_tokenizer("smol"), load_tokenizer("awkward"), load_tokenizer("whole"),
                                         load_tokenizer("tangled")};
  static const Tokenizer fallback[] = {load_tokenizer("gemma"), load_tokenizer("gemma_awkward"),
                                       load_tokenizer("gemma_tangled")};
  static const Tokenizer composing[] = {load_tokenizer("qwen"), load_tokenizer("qwen_awkward")};
  if (input.empty()) return;
  const int kind = input[0] & 7;
  const int n_fallback = input[0] >> 3 & 3;
  const int n_composing = input[0] >> 5 & 3;
  const std::string text(input.substr(1));
  if (n_composing > 0) {
    check_ids(composing[n_composing & 1], text);
  } else if (n_fallback > 0) {
    check_ids(fallback[n_fallback - 1], text);
  } else if (kind == 4 || kind == 7) {
    const auto pretokenizer = Pretokenizer::parse(text);
    if (pretokenizer) pretokenizer->split("one 2 three", [](std::string_view) {});
  } else if (kind == 5) {
    (void)parse_added_tokens(text, kVocab).ok();
  } else if (kind == 6) {
    (void)parse_recipe(text).ok();
  } else {
    check_ids(tokenizers[kind], text);
  }
}

}  // namespace vla::fuzz
