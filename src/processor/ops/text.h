// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>

#include "processor/ops/op.h"
#include "processor/tokenizer.h"

namespace vla {

/// Valid UTF-8 without the white space at its ends, as Python's str.strip() sees white space: some control characters
/// that other definitions leave out are among it.
std::string_view strip(std::string_view text);

/// Bytes of the longest prompt: the places for views and an instruction.
inline constexpr std::size_t kMaxPrompt = kMaxViewsText + Tokenizer::kMaxText;

/// Bounds what ops may make of a sentence: four that replace a letter by a thousand make a terabyte of one. Errors:
/// bad_observation.
Status check_prompt(std::size_t size);

/// How often the non-empty `part` is found in `text` from left to right, without overlaps.
std::size_t occurrences(std::string_view text, std::string_view part);

/// Every occurrence of the non-empty `from` replaced, from left to right, as Python's str.replace does.
std::string replace_all(std::string_view text, std::string_view from, std::string_view to);

/// Whether a template names `{instruction}` once, `{state}` once at most, and has no other braces.
bool is_template(std::string_view text);

/// The template with its places filled; the values of the state with single blanks between them.
/// Source: lerobot policies/pi05/processor_pi05.py (Pi05PrepareStateTokenizerProcessorStep).
std::string fill_template(std::string_view text, std::string_view instruction, std::span<const int> state);

/// Whether a text names `{i}` once at most and has no other braces.
bool is_numbered(std::string_view text);

/// `count` pieces in front of the text so far, or behind it, one for each view that the network has a place for: `open`
/// with the number of the piece, from 1, for `{i}` if present, then `token` `repeat` times, then `close`.
/// Source: lerobot policies/evo1/internvl3_embedder.py (_build_multimodal_prompts).
struct ViewsOp final : TextOp {
  int count = 0;
  int repeat = 0;
  bool behind = false;
  std::string open, token, close;

  std::string places() const;
  Result<std::string> apply(std::string text, std::span<const int> state) const override;
};

}  // namespace vla
