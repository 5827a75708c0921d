// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/processor.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <new>

#include "processor/image_codecs.h"
#include "processor/ops/text.h"
#include "processor/unicode.h"

namespace vla {
namespace {

Error bad_observation(std::string where, std::string expected, std::string found, std::string hint = {}) {
  return {Code::bad_observation, std::move(where), std::move(expected), std::move(found), std::move(hint)};
}

/// Index of the first value that is not finite, or the size.
std::size_t first_bad(std::span<const float> values) {
  const auto found = std::find_if(values.begin(), values.end(), [](float value) { return !std::isfinite(value); });
  return static_cast<std::size_t>(found - values.begin());
}

/// Rows of a view that are preprocessed together. At 512 pixels per row they take 196 KB, which fits into a core's L2
/// cache.
constexpr int kBand = 32;

std::size_t view_size(const Recipe& recipe) {
  return std::size_t{3} * static_cast<std::size_t>(recipe.width) * static_cast<std::size_t>(recipe.height);
}

bool is_latin(std::uint32_t code_point) {
  constexpr std::uint32_t kEndOfLatin = 0x370, kMoreLatin = 0x1E00, kEndOfMore = 0x1F00;
  return code_point < kEndOfLatin || (code_point >= kMoreLatin && code_point < kEndOfMore);
}

/// Whether valid UTF-8 has a letter of another script than the Latin one.
bool has_foreign_letter(std::string_view text) {
  while (!text.empty()) {
    const unicode::Char c = unicode::first(text);
    if (!is_latin(c.code_point) && (unicode::classes(c.code_point) & unicode::kLetter) != 0) return true;
    text.remove_prefix(c.size);
  }
  return false;
}

/// Arranges values given by name in the bundle's order; null for a feature without a value.
template <class T>
Result<std::vector<const T*>> by_feature(const FeatureNames& features, const std::map<std::string, T>& given) {
  std::vector<const T*> ordered(features.names().size());
  for (const auto& [name, value] : given) {
    VLA_TRY(const int index, features.find(name));
    const T*& slot = ordered[static_cast<std::size_t>(index)];
    const std::string& feature = features.names()[static_cast<std::size_t>(index)];
    if (slot != nullptr) return bad_observation(feature, "one value", fmt::format("a second one, under \"{}\"", name));
    slot = &value;
  }
  return ordered;
}

}  // namespace

Result<Inputs> Processor::encode(const Observation& observation) const {
  Inputs inputs;
  VLA_CHECK(encode_images(observation, inputs));
  VLA_CHECK(encode_state(observation, inputs));
  VLA_CHECK(encode_text(observation, inputs));
  return inputs;
}

Result<std::vector<Processor::PresentView>> Processor::present_views(const Observation& observation) const {
  VLA_TRY(const auto given, by_feature(views_, observation.views));
  std::vector<PresentView> present;
  for (std::size_t i = 0; i < given.size(); ++i) {
    const std::string& name = views_.names()[i];
    if (given[i] == nullptr && view_optional_[i] == 0)
      return bad_observation(name, "an image, or the view declared absent", "neither",
                             "the bundle's views are " + views_.listed() + "; --absent says what the robot lacks");
    if (given[i] != nullptr && *given[i] && view_absent_[i])
      return bad_observation(name, "no image: the view was declared absent with --absent", "an image");
    if (given[i] != nullptr && *given[i]) present.push_back({i, &name, &**given[i]});
  }
  if (present.size() < static_cast<std::size_t>(min_views_))
    return bad_observation("views", fmt::format("at least {} of the views {}", min_views_, views_.listed()),
                           fmt::format("{} present", present.size()));
  return present;
}

Status Processor::declare_absent(const std::string& view) {
  const auto index = views_.find(view);
  if (!index) return Error{Code::usage, "--absent", "a view of the policy: " + views_.listed(), view};
  view_absent_[static_cast<std::size_t>(*index)] = true;
  view_optional_[static_cast<std::size_t>(*index)] = 1;
  const auto n_left = std::count(view_absent_.begin(), view_absent_.end(), false);
  if (n_left >= min_views_) return {};
  return Error{Code::usage, "--absent", fmt::format("at least {} views left of {}", min_views_, views_.listed()),
               std::to_string(n_left)};
}

Status Processor::encode_images(const Observation& observation, Inputs& inputs, const RunItems& run) const {
  inputs.notes.clear();  // notes of the previous observation; images are encoded first
  VLA_TRY(const std::vector<PresentView> present, present_views(observation));
  inputs.n_view = static_cast<int>(present.size());
  inputs.views = 0;
  inputs.width = recipe_.width;
  inputs.height = recipe_.height;
  const std::size_t size = view_size(recipe_);
  inputs.pixels.resize(present.size() * size);
  for (const auto& [index, name, frame] : present) {
    inputs.views |= std::uint64_t{1} << index;
    VLA_CHECK(check_frame(*frame, *name));
    if (frame->orientation != 1)
      inputs.notes.push_back(
          fmt::format("{}: EXIF orientation {} is not followed: the frame is taken as it is stored; turn its pixels if "
                      "the camera is mounted so",
                      *name, frame->orientation));
    if (const auto note = codecs::suspicious(*frame)) inputs.notes.push_back(fmt::format("{}: {}", *name, *note));
  }
  if (present.empty()) return {};
  const int n_row = recipe_.fit->makes_rows() ? std::min(kBand, recipe_.height) : recipe_.height;
  const auto n_band = static_cast<std::size_t>((recipe_.height + n_row - 1) / n_row);
  std::vector<Status> made(present.size() * n_band);
  run(made.size(), [&](std::size_t item) {
    const std::size_t i = item / n_band;
    const auto& [index, name, frame] = present[i];
    const int first = static_cast<int>(item % n_band) * n_row;
    made[item] = encode_rows(*frame, *name, static_cast<int>(index), {first, std::min(first + n_row, recipe_.height)},
                             {inputs.pixels.data() + i * size, size});
  });
  for (const Status& status : made) VLA_CHECK(status);
  return {};
}

/// Applies all image ops to some rows of a view while these are in the cache. It may run on a thread that must not see
/// an exception.
Status Processor::encode_rows(const Frame& frame, const std::string& name, int view, Rows rows,
                              std::span<float> out) const noexcept try {
  VLA_CHECK(recipe_.fit->makes_rows() ? recipe_.fit->apply_rows(frame, rows, out, name)
                                      : recipe_.fit->apply(frame, view, out, name));
  const auto width = static_cast<std::size_t>(recipe_.width);
  apply_ops(recipe_, view, out, static_cast<std::size_t>(rows.first) * width,
            static_cast<std::size_t>(rows.end - rows.first) * width);
  return {};
} catch (const std::bad_alloc&) {
  return Error{Code::out_of_memory, "act", "", "no memory left", "free memory"};
}

std::vector<float> Processor::absent_view() const {
  std::vector<float> pixels(view_size(recipe_));
  const Frame black{recipe_.width, recipe_.height, std::vector<std::uint8_t>(pixels.size())};
  (void)encode_rows(black, "absent view", PlaneOp::kEveryView, {0, recipe_.height},
                    pixels);  // bytes of the expected size are never refused
  return pixels;
}

Result<std::string> Processor::fill_prompt(const std::string& instruction, std::span<const int> state) const {
  std::string text = instruction;
  for (const auto& op : recipe_.text) {
    VLA_TRY(text, op->apply(std::move(text), state));
    VLA_CHECK(check_prompt(text.size()));
  }
  return text;
}

Status Processor::encode_text(const Observation& observation, Inputs& inputs) const {
  if (recipe_.max_tokens == 0) {
    inputs.tokens.clear();
    if (!observation.text.value_or("").empty())
      inputs.notes.push_back("instruction: not read, since this policy knows one task");
    return {};
  }
  if (!observation.text) return bad_observation("instruction", "a text", "none", "give an empty one if that is meant");
  const std::string& text = *observation.text;
  if (text.size() > Tokenizer::kMaxText || unicode::valid_prefix(text) < text.size())
    return tokenizer_->encode(text).error();  // checked before any op reads it as characters
  if (recipe_.discretizes_state && inputs.discretized_state.size() != n_state_)
    return Error{Code::internal, "instruction", "the state to be encoded before the text", "no state"};
  VLA_TRY(const std::string prompt, fill_prompt(text, inputs.discretized_state));
  if (text.empty()) inputs.notes.push_back("instruction: empty");
  // Punctuation is dropped, so a full stop has the same prompt as an empty text.
  if (recipe_.drops_punctuation && !text.empty() && prompt == *fill_prompt(".", inputs.discretized_state))
    return bad_observation("instruction", "a letter, digit or white space",
                           "nothing but punctuation, which is dropped");
  if (has_foreign_letter(text))
    inputs.notes.push_back("instruction: letters of another script than the Latin one, in which policies are trained");
  VLA_TRY(inputs.tokens, tokenizer_->encode(prompt, kMaxPrompt));
  const auto own = recipe_.limits.find(observation.text);
  const auto limit = static_cast<std::size_t>(own != recipe_.limits.end() ? own->second : recipe_.max_tokens);
  if (inputs.tokens.size() > limit) {
    inputs.notes.push_back(fmt::format("instruction: {} tokens, cut to the {} {}", inputs.tokens.size(),
                                       recipe_.keep_last ? "last" : "first", limit));
    cut_tokens(inputs.tokens, limit);
  }
  if (recipe_.pad_id) inputs.tokens.resize(limit, *recipe_.pad_id);
  return view_tokens_.empty() ? Status() : check_view_places(inputs.tokens);
}

/// The network puts images at the places that the bundle states: the prompt must have its image tokens there.
Status Processor::check_view_places(std::span<const std::int32_t> tokens) const {
  const std::size_t n = view_tokens_.size(), n_rest = tokens.size() - std::min(n, tokens.size());
  const auto placed = views_behind_ ? tokens.subspan(n_rest) : tokens.first(tokens.size() - n_rest);
  if (!std::equal(placed.begin(), placed.end(), view_tokens_.begin(), view_tokens_.end()))
    return bad_observation("instruction", "text that leaves the places of the views as they are",
                           "text that changes or cuts them", "shorten the instruction");
  const auto rest = views_behind_ ? tokens.first(n_rest) : tokens.subspan(n);
  if (std::find(rest.begin(), rest.end(), view_token_) == rest.end()) return {};
  return bad_observation("instruction", "text without " + view_token_text_, "such a token",
                         "the places of the views are made by the runtime; remove it from the text");
}

/// Cuts the tokens to `limit`, at the end that the recipe states. The ids that stand before or after every text stay.
void Processor::cut_tokens(std::vector<std::int32_t>& tokens, std::size_t limit) const {
  const std::size_t n_cut = tokens.size() - limit;
  const std::size_t first = recipe_.keep_last ? std::min(tokenizer_->prefix().size(), limit)
                                              : limit - std::min(tokenizer_->suffix().size(), limit);
  const auto cut = tokens.begin() + static_cast<std::ptrdiff_t>(first);
  tokens.erase(cut, cut + static_cast<std::ptrdiff_t>(n_cut));
}

Status Processor::gather_states(const Observation& observation, std::vector<float>& state) const {
  VLA_TRY(const auto given, by_feature(states_, observation.states));
  state.clear();
  for (std::size_t i = 0; i < given.size(); ++i) {
    const std::string& name = states_.names()[i];
    const std::string expected = fmt::format("{} numbers", state_dims_[i]);
    if (given[i] == nullptr)
      return bad_observation(name, expected, "nothing", "the bundle's states are " + states_.listed());
    const std::vector<float>& values = *given[i];
    if (values.size() != static_cast<std::size_t>(state_dims_[i]))
      return bad_observation(name, expected, std::to_string(values.size()));
    if (const std::size_t bad = first_bad(values); bad < values.size())
      return bad_observation(fmt::format("{}[{}]", name, bad), "a finite number", fmt::format("{}", values[bad]));
    state.insert(state.end(), values.begin(), values.end());
  }
  return {};
}

/// Names value i of the concatenated states by its feature and its own name.
std::string Processor::state_place(std::size_t i) const {
  std::size_t first = 0, feature = 0;
  for (; i - first >= static_cast<std::size_t>(state_dims_[feature]); ++feature)
    first += static_cast<std::size_t>(state_dims_[feature]);
  return fmt::format("{}[{}] (\"{}\")", states_.names()[feature], i - first, state_names_[i]);
}

/// Adds a note, or refuses the observation, if normalized state values are far outside the training range.
Status Processor::check_bound(const StateOp& op, bool reject, Inputs& inputs) const {
  std::vector<std::size_t> beyond;
  for (std::size_t i = 0; i < inputs.state.size(); ++i)
    if (op.normalizes(i) && std::abs(static_cast<double>(inputs.state[i])) > state_bound_) beyond.push_back(i);
  if (beyond.empty()) return {};
  const std::size_t i = beyond.front(), n_other = beyond.size() - 1;
  const std::string found = fmt::format("{}, which is {:.3g} when normalized{}", inputs.raw_state[i], inputs.state[i],
                                        n_other > 0 ? fmt::format(", and {} more such numbers", n_other) : "");
  if (reject)
    return bad_observation(state_place(i), fmt::format("at most {} when normalized", state_bound_), found,
                           "are its units those of the training data?");
  inputs.out_of_range = true;
  inputs.notes.push_back(
      fmt::format("{}: {}; more than {} is far from what the policy has seen", state_place(i), found, state_bound_));
  return {};
}

Status Processor::encode_state(const Observation& observation, Inputs& inputs) const {
  using Stage = StateOp::Stage;
  inputs.out_of_range = false;
  for (const std::string& feature : degraded_)
    inputs.notes.push_back("DEGRADED: " + feature +
                           " passes unnormalized, as --identity-stats allowed when converting");
  VLA_CHECK(gather_states(observation, inputs.state));
  bool raw = true;
  for (const auto& op : recipe_.state) {
    if (raw && op->stage() != Stage::convention) {
      inputs.raw_state = inputs.state;
      raw = false;
    }
    op->apply(inputs.state);
    VLA_CHECK(check_bound(*op, observation.reject_out_of_range, inputs));
  }
  if (raw) inputs.raw_state = inputs.state;
  if (const std::size_t bad = first_bad(inputs.state); bad < inputs.state.size())
    return bad_observation(state_place(bad), "a number that stays finite when normalized",
                           fmt::format("{}", inputs.state[bad]));
  inputs.discretized_state.clear();
  for (const auto& op : recipe_.state) VLA_CHECK(op->finish(inputs.state, inputs.discretized_state));
  return {};
}

Result<std::vector<float>> Processor::decode(std::span<const float> chunk, int horizon, int d_action,
                                             std::span<const float> raw_state) const {
  if (d_action != d_action_ || horizon < std::max(1, first_row_ + n_row_) || raw_state.size() != n_state_ ||
      chunk.size() != static_cast<std::size_t>(horizon) * static_cast<std::size_t>(d_action))
    return Error{Code::internal, "action chunk", fmt::format("({}, {}) and {} states", horizon, d_action_, n_state_),
                 fmt::format("{} numbers in rows of {} and {} states", chunk.size(), d_action, raw_state.size())};
  const std::size_t width = action_names_.size();
  std::vector<float> actions;
  std::vector<double> row;
  actions.reserve(static_cast<std::size_t>(n_row(horizon)) * width);
  for (int i = 0; i < n_row(horizon); ++i) {
    const auto numbers = chunk.subspan(static_cast<std::size_t>(first_row_ + i) * static_cast<std::size_t>(d_action),
                                       static_cast<std::size_t>(d_action));
    row.assign(numbers.begin(), numbers.end());
    for (const auto& op : recipe_.action) op->apply(row, {static_cast<std::size_t>(i), raw_state});
    actions.insert(actions.end(), row.begin(), row.end());
    if (const std::size_t bad = first_bad(std::span(actions).last(width)); bad < width)
      return Error{Code::bad_action, fmt::format("actions[{}][\"{}\"]", i, action_names_[bad]), "a finite number",
                   fmt::format("{}", row[bad])};
    // Ops such as a gripper's threshold can turn NaN into a number, so the network's values are checked, too. Padded
    // columns do not matter.
    if (const std::size_t n = std::min(width, numbers.size()), bad = first_bad(numbers.first(n)); bad < n)
      return Error{Code::bad_action, fmt::format("actions[{}]", i), "finite numbers of the network",
                   fmt::format("{} in column {}", numbers[bad], bad)};
  }
  return actions;
}

std::optional<std::string> Processor::far_action(std::span<const float> rows) const {
  const std::size_t width = action_names_.size();
  std::size_t far = rows.size(), n_far = 0;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const auto has_statistics = [&](const auto& op) { return op->unnormalizes(i % width); };
    if (std::abs(static_cast<double>(rows[i])) <= kStateBound ||
        std::none_of(recipe_.action.begin(), recipe_.action.end(), has_statistics))
      continue;
    if (n_far++ == 0 || std::abs(rows[i]) > std::abs(rows[far])) far = i;
  }
  if (n_far == 0) return {};
  return fmt::format("[{}][\"{}\"] is {:.3g} when normalized{}", far / width, action_names_[far % width], rows[far],
                     n_far > 1 ? fmt::format(", and {} more are far", n_far - 1) : "");
}

bool Processor::reads(const std::string& tensor) const {
  const auto read_by = [&](const auto& op) { return op->reads(tensor); };
  return std::any_of(recipe_.state.begin(), recipe_.state.end(), read_by) ||
         std::any_of(recipe_.action.begin(), recipe_.action.end(), read_by);
}

}  // namespace vla
