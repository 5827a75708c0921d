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

/// Removes white space at both ends of valid UTF-8, as Python's str.strip() does; Python counts some control characters
/// that other definitions do not.
std::string_view strip(std::string_view text);

/// Longest prompt in bytes: views and an instruction.
inline constexpr std::size_t kMaxPrompt = kMaxViewsText + Tokenizer::kMaxText;

/// Limits a text that ops produce: four replacements of a letter by a thousand would make a terabyte. Errors:
/// bad_observation.
Status check_prompt(std::size_t size);

/// Counts non-overlapping occurrences of the non-empty `part` from left to right.
std::size_t occurrences(std::string_view text, std::string_view part);

/// Replaces every occurrence of the non-empty `from`, from left to right, as Python's str.replace does.
std::string replace_all(std::string_view text, std::string_view from, std::string_view to);

/// Whether a template has `{instruction}` once, `{state}` at most once, and no other braces.
bool is_template(std::string_view text);

/// Fills in a template; values of the state are separated by single spaces. Source: lerobot
/// policies/pi05/processor_pi05.py (Pi05PrepareStateTokenizerProcessorStep).
std::string fill_template(std::string_view text, std::string_view instruction, std::span<const int> state);

/// Whether a text has `{i}` at most once and no other braces.
bool is_numbered(std::string_view text);

/// Adds `count` pieces before or after the text, one for each view: `open`, with the piece's number from 1 for `{i}`,
/// then `token` `repeat` times, then `close`. Source: lerobot policies/evo1/internvl3_embedder.py
/// (_build_multimodal_prompts).
struct ViewsOp final : TextOp {
  int count = 0;
  int repeat = 0;
  bool behind = false;
  std::string open, token, close;

  std::string places() const;
  Result<std::string> apply(std::string text, std::span<const int> state) const override;
};

}  // namespace vla
