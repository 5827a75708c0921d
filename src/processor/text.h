// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <string_view>

#include "processor/recipe.h"

namespace vla {

/// Valid UTF-8 without the white space at its ends, as Python's str.strip() sees white space: some control characters
/// that other definitions leave out are among it.
std::string_view strip(std::string_view text);

/// How often the non-empty `part` is found in `text` from left to right, without overlaps.
std::size_t occurrences(std::string_view text, std::string_view part);

/// Every occurrence of the non-empty `from` replaced, from left to right, as Python's str.replace does.
std::string replace_all(std::string_view text, std::string_view from, std::string_view to);

/// Whether a template names `{instruction}` once, `{state}` once at most, and has no other braces.
bool is_template(std::string_view text);

/// The template with its places filled; `words` with single blanks between them.
/// Source: lerobot policies/pi05/processor_pi05.py (Pi05PrepareStateTokenizerProcessorStep).
std::string fill_template(std::string_view text, std::string_view instruction, std::span<const int> words);

/// Whether a text names `{i}` once at most and has no other braces.
bool is_numbered(std::string_view text);

/// What a views op adds. Source: lerobot policies/evo1/internvl3_embedder.py (_build_multimodal_prompts).
std::string view_places(const ViewsOp& op);

}  // namespace vla
