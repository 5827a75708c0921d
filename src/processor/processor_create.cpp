// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
//
// The load-rate half of Processor: reading a bundle and checking that its parts fit each other.
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <numeric>
#include <set>

#include "bundle/run_keys.h"
#include "processor/ops/text.h"
#include "processor/processor.h"

namespace vla {
namespace {

Status check_names(const std::string& key, const std::vector<std::string>& names) {
  const std::set<std::string> unique(names.begin(), names.end());
  if (unique.size() != names.size()) return misfit(key, "distinct names", "a name twice");
  if (unique.contains("")) return misfit(key, "names", "an empty one");
  return {};
}

template <class T>
Status check_size(const std::string& key, const std::vector<T>& list, std::size_t expected) {
  if (list.size() == expected) return {};
  return misfit(key, fmt::format("{} entries", expected), std::to_string(list.size()));
}

std::int64_t total_dims(std::span<const int> dims) {
  return std::accumulate(dims.begin(), dims.end(), std::int64_t{0});
}

struct Run {
  int start, size;
};

/// Finds runs of `token`. A run has at most `longest` tokens; the next token begins another run.
std::vector<Run> runs_of(std::int32_t token, std::span<const std::int32_t> tokens, int longest) {
  std::vector<Run> runs;
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    if (tokens[i] != token) continue;
    if (i == 0 || tokens[i - 1] != token || runs.back().size == longest) runs.push_back({static_cast<int>(i), 0});
    ++runs.back().size;
  }
  return runs;
}

}  // namespace

Result<Processor> Processor::create(const Bundle& bundle, std::shared_ptr<const Tokenizer> tokenizer) {
  const Keys& keys = bundle.keys();
  Processor processor;
  VLA_TRY(const std::string recipe, keys.string("processor.recipe"));
  VLA_TRY(processor.recipe_, parse_recipe(recipe));
  VLA_CHECK(processor.read_features(bundle));
  VLA_CHECK(processor.bind_state(bundle));
  VLA_CHECK(processor.bind_action(bundle));
  VLA_TRY(processor.action_tokens_, ActionTokens::read(keys));
  processor.tokenizer_ = std::move(tokenizer);
  const bool has_text = processor.recipe_.max_tokens > 0;
  if (keys.has("lm.n_vocab") != has_text)
    return misfit("processor.recipe.text", has_text ? "none, without lm.n_vocab" : "tokenize as the last op",
                  has_text ? "tokenize" : "none");
  int n_vocab = 0;
  if (has_text) {
    VLA_TRY(n_vocab, keys.integer("lm.n_vocab", {1, 1 << 24}));
  }
  if (has_text && processor.tokenizer_ == nullptr) {
    VLA_TRY(Tokenizer read, Tokenizer::create(keys, n_vocab));
    processor.tokenizer_ = std::make_shared<const Tokenizer>(std::move(read));
  }
  const int n_around =
      has_text ? static_cast<int>(processor.tokenizer_->prefix().size() + processor.tokenizer_->suffix().size()) : 0;
  for (const int limit : processor.recipe_.text_limits())
    if (limit < n_around)
      return misfit("processor.recipe.text", fmt::format("{} tokens or more, which stand around every text", n_around),
                    std::to_string(limit));
  if (const int pad = processor.recipe_.pad_id.value_or(0); has_text && pad >= n_vocab)
    return misfit("processor.recipe.text", fmt::format("a pad_id below {} (lm.n_vocab)", n_vocab), std::to_string(pad));
  VLA_TRY(const int max_text_tokens,
          keys.integer("observation.max_text_tokens", {has_text ? 1.0 : 0.0, has_text ? kMaxVector : 0.0}));
  if (processor.recipe_.max_tokens > max_text_tokens)
    return misfit("processor.recipe.text",
                  fmt::format("at most {} tokens (observation.max_text_tokens)", max_text_tokens),
                  std::to_string(processor.recipe_.max_tokens));
  VLA_CHECK(processor.read_view_places(keys));
  VLA_CHECK(processor.check_descriptions(keys));
  VLA_CHECK(processor.read_degraded(keys));
  return processor;
}

Status Processor::read_features(const Bundle& bundle) {
  const Keys& keys = bundle.keys();
  VLA_TRY(std::vector<std::string> views, keys.strings("observation.views"));
  VLA_TRY(std::vector<std::string> aliases, keys.strings("observation.view_aliases"));
  VLA_TRY(view_optional_, keys.integers("observation.view_optional", kFlag));
  VLA_TRY(min_views_,
          keys.integer("observation.min_views", {views.empty() ? 0.0 : 1.0, static_cast<double>(views.size())}));
  VLA_CHECK(check_names("observation.views", views));
  VLA_CHECK(check_size("observation.view_aliases", aliases, views.size()));
  VLA_CHECK(check_size("observation.view_optional", view_optional_, views.size()));
  if (views.size() > static_cast<std::size_t>(kMaxViews))
    return misfit("observation.views", fmt::format("at most {} views", kMaxViews), std::to_string(views.size()));
  if (views.empty() != (recipe_.width == 0))
    return misfit("processor.recipe.image", views.empty() ? "no ops, without views" : "ops of the views",
                  views.empty() ? "ops" : "none");
  const auto is_missing = [&](const auto& op) { return op->view() >= static_cast<int>(views.size()); };
  if (std::any_of(recipe_.image.begin(), recipe_.image.end(), is_missing) ||
      recipe_.fit->n_view() > static_cast<int>(views.size()))
    return misfit("processor.recipe.image", fmt::format("ops of the {} views", views.size()), "one of a later view");
  view_absent_.assign(views.size(), false);
  views_ = FeatureNames("view", std::move(views), std::move(aliases));

  VLA_TRY(std::vector<std::string> states, keys.strings("observation.states"));
  VLA_TRY(state_dims_, keys.integers("observation.state_dims", {1, kMaxVector}));
  VLA_CHECK(check_names("observation.states", states));
  VLA_CHECK(check_size("observation.state_dims", state_dims_, states.size()));
  if (total_dims(state_dims_) > kMaxVector)
    return misfit("observation.state_dims", fmt::format("at most {} numbers in all", kMaxVector), "more");
  std::vector<std::string> no_aliases(states.size());
  states_ = FeatureNames("state", std::move(states), std::move(no_aliases));

  VLA_TRY(action_names_, keys.strings("action.names"));
  return {};
}

/// Names, units and the rate change no number, but clients rely on them.
Status Processor::check_descriptions(const Keys& keys) const {
  VLA_TRY(const auto action_units, keys.strings("action.units"));
  VLA_TRY(const auto state_names, keys.strings("observation.state_names"));
  VLA_TRY(const auto state_units, keys.strings("observation.state_units"));
  const auto n_state = static_cast<std::size_t>(total_dims(state_dims_));
  VLA_CHECK(check_size("action.units", action_units, action_names_.size()));
  VLA_CHECK(check_size("observation.state_names", state_names, n_state));
  VLA_CHECK(check_size("observation.state_units", state_units, n_state));
  if (const auto rate = keys.number("action.rate_hz", kRateHz); !rate) return rate.error();
  if (keys.has(kCameraSizes)) {
    VLA_TRY(const auto sides, keys.integers(kCameraSizes, kCameraSide));
    VLA_CHECK(check_size(kCameraSizes, sides, 2 * views_.names().size()));
  }
  if (keys.has(kActionSteps))
    if (const auto steps = keys.integer(kActionSteps, {1, kMaxVector}); !steps) return steps.error();
  if (!keys.has(kRtcHorizon)) return {};
  if (const auto horizon = keys.integer(kRtcHorizon, {1, kMaxVector}); !horizon) return horizon.error();
  if (const auto schedule = keys.string(kRtcSchedule); !schedule) return schedule.error();
  const auto guidance = keys.number(kRtcGuidance, {0, 1e9});
  return guidance ? Status() : Status(guidance.error());
}

Status Processor::read_degraded(const Keys& keys) {
  constexpr const char *kBound = "observation.state_bound", *kDegraded = "vla.degraded";
  VLA_TRY(state_names_, keys.strings("observation.state_names"));
  if (keys.has(kBound)) {
    VLA_TRY(state_bound_, keys.number(kBound, {1, 1e9}));
  }
  if (!keys.has(kDegraded)) return {};
  VLA_TRY(degraded_, keys.strings(kDegraded));
  for (const std::string& feature : degraded_)
    if (feature != "action" && std::count(states_.names().begin(), states_.names().end(), feature) == 0)
      return misfit(kDegraded, "action, " + states_.listed(), feature);
  return {};
}

/// Finds the places of the views in the prompt of an empty instruction. `check_view_places` refuses instructions that
/// change them.
Status Processor::read_view_places(const Keys& keys) {
  const ViewsOp* const views = recipe_.views;
  if (views == nullptr) return {};
  const auto is_views = [&](const auto& op) { return op.get() == views; };
  const auto op = std::find_if(recipe_.text.begin(), recipe_.text.end(), is_views);
  const std::string where = fmt::format("processor.recipe.text[{}]", op - recipe_.text.begin());
  views_behind_ = views->behind;
  const std::string key = views_behind_ ? "policy.view_starts_from_end" : "policy.view_starts";
  VLA_TRY(const std::vector<int> starts, keys.integers(key, kTokenIndex));
  const auto encode = [&](const std::string& text) -> Result<std::vector<std::int32_t>> {
    auto tokens = tokenizer_->encode(text, kMaxPrompt);
    if (!tokens) return misfit("processor.recipe.text", tokens.error().expected, tokens.error().found);
    return tokens;
  };
  VLA_TRY(const std::vector<std::int32_t> prefixed, encode(views->token));
  const std::size_t n_prefix = tokenizer_->prefix().size();
  if (prefixed.size() != n_prefix + 1)
    return misfit(where + ".token", "the text of one token", fmt::format("{} tokens", prefixed.size() - n_prefix));
  view_token_ = prefixed.back();
  view_token_text_ = views->token;
  const auto prompt = fill_prompt({}, {});
  if (!prompt) return misfit("processor.recipe.text", prompt.error().expected, prompt.error().found);
  VLA_TRY(const std::vector<std::int32_t> tokens, encode(*prompt));
  const std::vector<Run> runs = runs_of(view_token_, tokens, views->repeat);
  std::vector<int> found;
  const int n_token = static_cast<int>(tokens.size());
  for (const Run& run : runs) found.push_back(views_behind_ ? n_token - run.start : run.start);
  const auto is_whole = [views](const Run& run) { return run.size == views->repeat; };
  if (found.size() != static_cast<std::size_t>(views->count) || !std::all_of(runs.begin(), runs.end(), is_whole))
    return misfit(where, fmt::format("{} runs of {} tokens", views->count, views->repeat),
                  fmt::format("{} runs in the tokens of the prompt", runs.size()));
  if (found != starts)
    return misfit(key, fmt::format("{}, where the prompt has them", fmt::join(found, ", ")),
                  fmt::format("{}", fmt::join(starts, ", ")));
  const auto first = tokens.begin() + (views_behind_ ? runs.front().start : 0);
  const auto last = views_behind_ ? tokens.end() : tokens.begin() + runs.back().start + runs.back().size;
  view_tokens_.assign(first, last);
  if (view_tokens_.size() <= static_cast<std::size_t>(recipe_.max_tokens)) return {};
  return misfit("processor.recipe.text", fmt::format("at least {} tokens, which the views need", view_tokens_.size()),
                std::to_string(recipe_.max_tokens));
}

Status Processor::bind_state(const Bundle& bundle) {
  n_state_ = static_cast<std::size_t>(total_dims(state_dims_));
  StateLayout layout{bundle, states_, state_dims_, n_state_, n_state_, n_state_};
  for (std::size_t i = 0; i < recipe_.state.size(); ++i)
    VLA_CHECK(recipe_.state[i]->bind(layout, fmt::format("processor.recipe.state[{}]", i)));
  VLA_TRY(const int d_state, bundle.keys().integer("policy.d_state", {0, kMaxVector}));
  if (layout.width == static_cast<std::size_t>(d_state)) return {};
  return misfit("processor.recipe.state", fmt::format("{} numbers at the end (policy.d_state)", d_state),
                std::to_string(layout.width));
}

Status Processor::bind_action(const Bundle& bundle) {
  VLA_TRY(d_action_, bundle.keys().integer("policy.d_action", {1, kMaxVector}));
  ActionLayout layout = {.bundle = bundle, .n_state = n_state_, .width = d_action_};
  for (std::size_t i = 0; i < recipe_.action.size(); ++i)
    VLA_CHECK(recipe_.action[i]->bind(layout, fmt::format("processor.recipe.action[{}]", i)));
  first_row_ = layout.first_row, n_row_ = layout.n_row;
  relative_actions_ = layout.relative;
  if (static_cast<std::size_t>(layout.width) == action_names_.size()) return {};
  return misfit("action.names", fmt::format("one name for each of the {} columns that the recipe leaves", layout.width),
                std::to_string(action_names_.size()));
}

}  // namespace vla
