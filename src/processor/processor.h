// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"
#include "bundle/bundle.h"
#include "processor/action_tokens.h"
#include "processor/image.h"
#include "processor/names.h"
#include "processor/pixels.h"
#include "processor/recipe.h"
#include "processor/tokenizer.h"

namespace vla {

/// An observation, by name; `FeatureNames` describes the accepted names.
struct Observation {
  std::map<std::string, std::optional<Frame>> views;  // nullopt: declared absent
  std::map<std::string, std::vector<float>> states;   // world units
  std::optional<std::string> text = {};               // the instruction, UTF-8, which may be empty; nullopt: not given
  std::string embodiment = {};                        // the robot's tag; empty if the policy is for one robot
  bool reject_out_of_range = false;  // refuse a state or leftover beyond its bound, instead of a note in the answer
};

/// One observation as the network reads it, encoded by the host. Vectors keep their memory when refilled.
struct Inputs {
  int n_view = 0;
  std::uint64_t views = 0;  // bit i: view i of the bundle's order is present
  int height = 0, width = 0;
  Pixels pixels;                       // (n_view, 3, height, width), present views only, in the bundle's order
  std::vector<std::int32_t> tokens;    // at most `recipe().max_tokens`
  std::vector<float> state;            // normalized, padded; empty if the network reads none
  std::vector<int> discretized_state;  // only if the prompt contains the state
  std::vector<float> raw_state;        // the state before normalization; actions may be relative to it
  bool out_of_range = false;           // state or leftover has a value beyond its bound; a note names it
  std::vector<std::string> notes;      // warnings, e.g. that the instruction was truncated
};

/// An answer has a note if a normalized action exceeds this bound, or a normalized state value the bundle's bound, for
/// which this is the default. The bound is ten standard deviations, or five times the range of the training data.
/// Degrees in place of radians exceed it.
inline constexpr double kStateBound = 10.0;

/// Calls `item` with each number below `n`, in any order and on any threads.
using RunItems = std::function<void(std::size_t n, const std::function<void(std::size_t)>& item)>;
inline void one_by_one(std::size_t n, const std::function<void(std::size_t)>& item) {
  for (std::size_t i = 0; i < n; ++i) item(i);
}

/// Turns observations into inputs and chunks into actions, by the recipe and statistics of a bundle.
class Processor {
 public:
  /// Reads `processor.*`, `observation.*`, `action.names`, `action_tokens.*`, `tokenizer.*` and `lm.n_vocab` if the
  /// recipe has a text, `stats.*`, `policy.d_state`, `policy.d_action`, `policy.view_starts*` if the text has places
  /// for views, `policy.horizon` if the recipe drops rows, and checks that they fit each other. The bundle may be
  /// closed afterwards. Errors: bad_bundle. `tokenizer`: shared with a processor of the same `tokenizer.*` and
  /// `lm.n_vocab`; null makes one.
  static Result<Processor> create(const Bundle& bundle, std::shared_ptr<const Tokenizer> tokenizer = nullptr);

  /// Calls the three functions below. Errors: bad_observation.
  Result<Inputs> encode(const Observation& observation) const;

  /// Each fills its own fields of `inputs`, and is timed on its own. A prompt may contain the state, so `encode_text`
  /// comes after `encode_state`.
  Status encode_images(const Observation& observation, Inputs& inputs, const RunItems& run = one_by_one) const;
  Status encode_text(const Observation& observation, Inputs& inputs) const;
  Status encode_state(const Observation& observation, Inputs& inputs) const;

  /// Pixels (3, height, width) of a black frame, which some references substitute for an absent view.
  std::vector<float> absent_view() const;

  /// The number of rows that are actions in a chunk of `horizon` rows: all of them, or those that the recipe keeps,
  /// from first_row() on.
  int n_row(int horizon) const { return n_row_ > 0 ? n_row_ : horizon; }
  int first_row() const { return first_row_; }

  /// Whether actions are relative to the state of the observation.
  bool relative_actions() const { return relative_actions_; }

  /// chunk (horizon, d_action), normalized -> (n_row(horizon), action_names().size()) in world units.
  /// `raw_state`: Inputs::raw_state of the chunk's observation. Errors: bad_action for a number that is not
  /// finite, naming its row and column.
  Result<std::vector<float>> decode(std::span<const float> chunk, int horizon, int d_action,
                                    std::span<const float> raw_state) const;

  /// Describes, for a note or an error, the value of normalized actions (n, action_names().size()) that exceeds
  /// kStateBound the most; nullopt if none does. Ignores columns without statistics.
  std::optional<std::string> far_action(std::span<const float> rows) const;

  /// Whether a step of the recipe reads this tensor; any other statistics in a bundle are a mistake.
  bool reads(const std::string& tensor) const;

  /// Declares that the robot lacks this view: observations need not mention it and must not contain it. Errors: usage
  /// if no view has this name, or if fewer views would be left than the policy needs.
  Status declare_absent(const std::string& view);

  const FeatureNames& views() const { return views_; }
  /// Whether an observation may omit this view, which declares it absent.
  bool is_optional(std::size_t view) const { return view_optional_[view] != 0; }
  bool is_absent(std::size_t view) const { return view_absent_[view]; }
  int min_views() const { return min_views_; }
  const FeatureNames& states() const { return states_; }
  const std::vector<int>& state_dims() const { return state_dims_; }
  const std::vector<std::string>& action_names() const { return action_names_; }
  /// The number of tokens that every prompt shares, from its start to the last place of a view, or from the first place
  /// to its end; 0 if the text has no places for views.
  int n_view_tokens() const { return static_cast<int>(view_tokens_.size()); }
  const Recipe& recipe() const { return recipe_; }
  /// Null if the policy reads no instruction.
  const std::shared_ptr<const Tokenizer>& tokenizer() const { return tokenizer_; }
  /// Set if the network answers with tokens, which are decoded to a chunk.
  const std::optional<ActionTokens>& action_tokens() const { return action_tokens_; }
  /// Features that --identity-stats left unnormalized, which every answer reports.
  const std::vector<std::string>& degraded() const { return degraded_; }

 private:
  Status read_features(const Bundle& bundle);
  Status check_descriptions(const Keys& keys) const;
  Status bind_state(const Bundle& bundle);
  Status bind_action(const Bundle& bundle);
  Status read_view_places(const Keys& keys);
  struct PresentView {
    std::size_t index;
    const std::string* name;
    const Frame* frame;
  };
  Result<std::vector<PresentView>> present_views(const Observation& observation) const;
  Result<std::string> fill_prompt(const std::string& instruction, std::span<const int> state) const;
  Status encode_rows(const Frame& frame, const std::string& name, int view, Rows rows,
                     std::span<float> out) const noexcept;
  Status check_view_places(std::span<const std::int32_t> tokens) const;
  void cut_tokens(std::vector<std::int32_t>& tokens, std::size_t limit) const;
  Status read_degraded(const Keys& keys);
  std::string state_place(std::size_t i) const;
  Status check_bound(const StateOp& op, bool reject, Inputs& inputs) const;
  Status gather_states(const Observation& observation, std::vector<float>& state) const;

  FeatureNames views_, states_;
  std::vector<int> view_optional_;  // 1 for each view that an observation may omit
  std::vector<bool> view_absent_;   // views that this robot lacks
  int min_views_ = 0;
  std::vector<int> state_dims_;
  std::vector<std::string> state_names_, action_names_, degraded_;
  double state_bound_ = kStateBound;
  Recipe recipe_;
  std::shared_ptr<const Tokenizer> tokenizer_;
  std::optional<ActionTokens> action_tokens_;
  /// If the text has places for views: the tokens of every prompt up to the last place, or from the first place on,
  /// and the token that fills a place.
  std::vector<std::int32_t> view_tokens_;
  bool views_behind_ = false;
  std::int32_t view_token_ = -1;
  std::string view_token_text_;
  std::size_t n_state_ = 0;  // values of all states together
  int d_action_ = 0;         // columns of the network's chunk
  int first_row_ = 0;
  int n_row_ = 0;  // rows that the recipe keeps; 0: all
  bool relative_actions_ = false;
};

}  // namespace vla
