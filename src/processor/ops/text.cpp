// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/ops/text.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>

#include "processor/json_fields.h"
#include "processor/python_text.h"
#include "processor/recipe.h"
#include "processor/tokenizer.h"
#include "processor/unicode.h"

namespace vla {
namespace {

constexpr std::string_view kInstruction = "{instruction}";
constexpr std::string_view kNumber = "{i}";
constexpr std::string_view kState = "{state}";

}  // namespace

Status check_prompt(std::size_t size) {
  if (size <= kMaxPrompt) return {};
  return Error{Code::bad_observation, "instruction",
               fmt::format("text that makes a prompt of at most {} bytes", kMaxPrompt), std::to_string(size)};
}

std::size_t occurrences(std::string_view text, std::string_view part) {
  std::size_t count = 0;
  for (std::size_t at = text.find(part); at != std::string_view::npos; at = text.find(part, at + part.size())) ++count;
  return count;
}

std::string_view strip(std::string_view text) {
  while (!text.empty()) {
    const unicode::Char c = unicode::first(text);
    if (!python::is_space(c.code_point)) break;
    text.remove_prefix(c.size);
  }
  while (!text.empty()) {
    const unicode::Char c = unicode::last(text);
    if (!python::is_space(c.code_point)) break;
    text.remove_suffix(c.size);
  }
  return text;
}

std::string replace_all(std::string_view text, std::string_view from, std::string_view to) {
  std::string out;
  std::size_t done = 0;
  for (std::size_t at = text.find(from); at != std::string_view::npos; at = text.find(from, done)) {
    out.append(text.substr(done, at - done)).append(to);
    done = at + from.size();
  }
  return out.append(text.substr(done));
}

bool is_template(std::string_view text) {
  const std::size_t n_state = occurrences(text, kState);
  return occurrences(text, kInstruction) == 1 && n_state <= 1 && occurrences(text, "{") == 1 + n_state &&
         occurrences(text, "}") == 1 + n_state;
}

bool is_numbered(std::string_view text) {
  const std::size_t n_number = occurrences(text, kNumber);
  return n_number <= 1 && occurrences(text, "{") == n_number && occurrences(text, "}") == n_number;
}

std::string ViewsOp::places() const {
  std::string out;
  for (int i = 1; i <= count; ++i) {
    out += replace_all(open, kNumber, std::to_string(i));
    for (int k = 0; k < repeat; ++k) out += token;
    out += close;
  }
  return out;
}

Result<std::string> ViewsOp::apply(std::string text, std::span<const int>) const {
  return behind ? text + places() : places() + text;
}

std::string fill_template(std::string_view text, std::string_view instruction, std::span<const int> state) {
  std::string out;
  while (!text.empty()) {
    if (text.starts_with(kInstruction)) {
      out.append(instruction);
      text.remove_prefix(kInstruction.size());
    } else if (text.starts_with(kState)) {
      out.append(fmt::format("{}", fmt::join(state, " ")));
      text.remove_prefix(kState.size());
    } else {
      out.push_back(text.front());
      text.remove_prefix(1);
    }
  }
  return out;
}

namespace {

/// An op without fields.
template <std::string (*edit)(std::string_view)>
struct EditOp final : TextOp {
  Result<std::string> apply(std::string text, std::span<const int>) const override { return edit(text); }
};

std::string stripped(std::string_view text) { return std::string(strip(text)); }

struct ReplaceOp final : TextOp {
  std::string from, to;
  Result<std::string> apply(std::string text, std::span<const int>) const override {
    const std::size_t n = occurrences(text, from);
    VLA_CHECK(check_prompt(text.size() + n * to.size() - n * from.size()));
    return replace_all(text, from, to);
  }
};

/// Refuses an instruction that contains a text. It runs before ops that add text, so an empty instruction passes.
struct RefuseOp final : TextOp {
  std::string text;
  bool refuses() const override { return true; }
  Result<std::string> apply(std::string given, std::span<const int>) const override {
    if (given.find(text) == std::string::npos) return given;
    return Error{Code::bad_observation, "instruction", "text without " + text, "such a text",
                 "the prompt's own tokens tell the network where to look; remove it from the text"};
  }
};

/// An empty text becomes `text`.
struct IfEmptyOp final : TextOp {
  std::string text;
  Result<std::string> apply(std::string given, std::span<const int>) const override {
    return given.empty() ? text : given;
  }
};

/// The text as Python prints a list that contains it.
struct PythonListOp final : TextOp {
  Result<std::string> apply(std::string text, std::span<const int>) const override {
    std::string out = python::list_of(text);
    VLA_CHECK(check_prompt(out.size()));
    return out;
  }
};

struct EnsureSuffixOp final : TextOp {
  std::string suffix;
  Result<std::string> apply(std::string text, std::span<const int>) const override {
    return text.ends_with(suffix) ? text : text + suffix;
  }
};

/// `{instruction}` is replaced by the text so far, `{state}` by the discretized state.
struct TemplateOp final : TextOp {
  std::string text;
  Result<std::string> apply(std::string instruction, std::span<const int> state) const override {
    return fill_template(text, instruction, state);
  }
};

Result<std::string> read_text(JsonFields& fields, const char* name) {
  VLA_TRY(std::string text, fields.string(name));
  if (text.size() <= kMaxOpText) return text;
  return fields.wrong(name, fmt::format("at most {} bytes of text", kMaxOpText));
}

template <std::string (*edit)(std::string_view)>
Status read(JsonFields&, EditOp<edit>&, Recipe& recipe) {
  recipe.drops_punctuation |= edit == python::drop_punctuation;
  return {};
}

Status read(JsonFields& fields, ReplaceOp& op, Recipe&) {
  VLA_TRY(op.from, read_text(fields, "from"));
  VLA_TRY(op.to, read_text(fields, "to"));
  return op.from.empty() ? fields.wrong("from", "text to look for") : Status();
}

Status read(JsonFields& fields, RefuseOp& op, Recipe& recipe) {
  if (!std::all_of(recipe.text.begin(), recipe.text.end(), [](const auto& before) { return before->refuses(); }))
    return misplaced(fields, "refuse before other ops");
  VLA_TRY(op.text, read_text(fields, "text"));
  return op.text.empty() ? fields.wrong("text", "text to look for") : Status();
}

Status read(JsonFields& fields, IfEmptyOp& op, Recipe&) {
  VLA_TRY(op.text, read_text(fields, "text"));
  return op.text.empty() ? fields.wrong("text", "a text that is not empty") : Status();
}

Status read(JsonFields&, PythonListOp&, Recipe&) { return {}; }

Status read(JsonFields& fields, EnsureSuffixOp& op, Recipe&) {
  VLA_TRY(op.suffix, read_text(fields, "suffix"));
  return {};
}

Status read(JsonFields& fields, TemplateOp& op, Recipe& recipe) {
  VLA_TRY(op.text, read_text(fields, "text"));
  if (!is_template(op.text))
    return fields.wrong("text", "text with {instruction} once, {state} once at most and no other braces");
  recipe.prompt_takes_state |= op.text.find(kState) != std::string::npos;
  return {};
}

Status read(JsonFields& fields, ViewsOp& op, Recipe& recipe) {
  VLA_TRY(op.count, fields.integer("count", 1, kMaxViews));
  VLA_TRY(op.open, fields.string("open"));
  VLA_TRY(op.token, fields.string("token"));
  VLA_TRY(op.repeat, fields.integer("repeat", 1, kMaxVector));
  VLA_TRY(op.close, fields.string("close"));
  if (fields.has("place")) {
    VLA_TRY(const int place, fields.choice("place", {"front", "back"}));
    op.behind = place == 1;
  }
  if (op.token.empty()) return fields.wrong("token", "the text of a token");
  if (!is_numbered(op.open)) return fields.wrong("open", "text with {i} once at most and no other braces");
  const std::size_t longest = kMaxViewsText / static_cast<std::size_t>(op.count);
  if (op.open.size() > longest || op.close.size() > longest ||
      op.token.size() > longest / static_cast<std::size_t>(op.repeat))
    return fields.wrong("repeat", "less than a mebibyte of text");
  recipe.views = &op;
  return {};
}

template <class Op>
Status parse_text(JsonFields& fields, Recipe& recipe) {
  constexpr bool is_template_op = std::is_same_v<Op, TemplateOp>;
  if (recipe.max_tokens > 0) return misplaced(fields, "nothing after tokenize");
  if (recipe.views != nullptr && (!is_template_op || recipe.text.back().get() != recipe.views))
    return misplaced(fields, "tokenize after views, or one template and tokenize");
  auto op = std::make_unique<Op>();
  VLA_CHECK(read(fields, *op, recipe));
  recipe.text.push_back(std::move(op));
  return {};
}

/// Limits of single instructions, as the client sends them.
Status parse_limit(JsonFields& fields, Recipe& recipe) {
  if (recipe.max_tokens > 0) return misplaced(fields, "nothing after tokenize");
  VLA_TRY(const int limit, fields.integer("max_tokens", 1, kMaxVector));
  VLA_TRY(std::vector<std::string> instructions, fields.strings("instructions"));
  for (std::string& instruction : instructions)
    if (!recipe.limits.emplace(std::move(instruction), limit).second)
      return fields.wrong("instructions", "instructions that no other limit names");
  return {};
}

Status parse_tokenize(JsonFields& fields, Recipe& recipe) {
  if (recipe.max_tokens > 0) return misplaced(fields, "nothing after tokenize");
  VLA_TRY(recipe.max_tokens, fields.integer("max_tokens", 1, kMaxVector));
  VLA_TRY(const int truncate, fields.choice("truncate", {"right", "left"}));
  recipe.keep_last = truncate == 1;
  if (fields.has("pad_id")) {
    VLA_TRY(recipe.pad_id, fields.integer("pad_id", 0, 1 << 24));
  }
  for (const int limit : recipe.text_limits())
    if (limit > recipe.max_tokens) return fields.wrong("max_tokens", fmt::format("at least the limit {}", limit));
  if (recipe.views != nullptr && (recipe.pad_id || !recipe.limits.empty()))
    return misplaced(fields, "tokenize without pad_id and limits after views");
  return {};
}

}  // namespace

Ops text_ops() {
  return {{"text", "strip", parse_text<EditOp<stripped>>},
          {"text", "lower", parse_text<EditOp<python::lower>>},
          {"text", "drop_punctuation", parse_text<EditOp<python::drop_punctuation>>},
          {"text", "replace", parse_text<ReplaceOp>},
          {"text", "refuse", parse_text<RefuseOp>},
          {"text", "if_empty", parse_text<IfEmptyOp>},
          {"text", "python_list", parse_text<PythonListOp>},
          {"text", "ensure_suffix", parse_text<EnsureSuffixOp>},
          {"text", "template", parse_text<TemplateOp>},
          {"text", "views", parse_text<ViewsOp>},
          {"text", "limit", parse_limit},
          {"text", "tokenize", parse_tokenize}};
}

}  // namespace vla
