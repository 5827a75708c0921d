// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "bundle/params.h"
#include "graph/cache.h"
#include "modules/timestep_embedding.h"

namespace vla {

/// How a text divides into sentences and padding. A policy may need a different graph for each layout. An empty list of
/// sentences means one sentence without padding.
struct TextLayout {
  int n_seen = 0;              // tokens before the padding
  std::vector<int> sentences;  // tokens of each, padding included; a token attends to its own sentence only
  auto operator<=>(const TextLayout&) const = default;
};

/// One observation, as the processor encodes it and the prefix reads it: without absent views, and without padding of
/// the text unless the recipe adds it.
struct PrefixInputs {
  Tensor images;            // [width, height, 3, n_view], in the image recipe's range; none if the policy has no views
  Tensor tokens;            // [n_text] i32; none if the policy reads no instruction
  Tensor state;             // [d_state, 1], normalized and padded; none if policy.d_state is 0
  std::uint64_t views = 0;  // bit i: view i of the bundle is present; 0 if only the number of views matters
  TextLayout text = {};
};

/// The sizes of PrefixInputs. There is one plan for each.
struct InputShape {
  int width = 0, height = 0, n_view = 0, n_text = 0, d_state = 0;
  std::uint64_t views = 0;  // PrefixInputs::views
  bool steered = false;     // whether the solver continues a previous chunk
  TextLayout text = {};
  auto operator<=>(const InputShape&) const = default;
};

/// How the reference continues rows of the previous chunk that are not executed yet.
struct RealTimeChunking {
  enum class Kind { none, guided, inpainted };
  Kind kind = Kind::none;
  double ramp_rate = 0;  // inpainted: how fast the rows after the frozen ones become free
};

/// An architecture: which modules run, in which order and at which of the three rates. It owns no loop, memory or file.
/// The constructor declares every parameter and cannot fail: ParamList records its problems.
class Policy {
 public:
  virtual ~Policy() = default;

  /// Checks at load that the network is defined for inputs of this size. Errors: bad_bundle, unsupported;
  /// bad_observation for a layout that no text has.
  virtual Status check(const InputShape& shape) const = 0;

  /// Load rate: computes the values that depend only on time, one column per solver step: [d, times.size()]. None if
  /// the network reads no time.
  virtual Tensor condition(Graph& g, std::span<const SolverTime> times) const {
    static_cast<void>(g), static_cast<void>(times);
    return {};
  }

  /// Whether it matters which views are present, or only how many.
  virtual bool depends_on_which_views() const { return false; }

  /// The layout of the text that the graph depends on; empty if the graph depends only on the number of tokens.
  virtual TextLayout text_layout(std::span<const std::int32_t> tokens) const {
    static_cast<void>(tokens);
    return {};
  }

  virtual RealTimeChunking real_time_chunking() const { return {}; }

  /// Load rate: puts the values that depend only on weights into the cache with which every prefix starts.
  /// `absent_view` returns the preprocessed image of an absent view: [width, height, 3, 1].
  virtual void constants(Graph& g, const std::function<Tensor()>& absent_view, Cache& cache) const {
    static_cast<void>(g), static_cast<void>(absent_view), static_cast<void>(cache);
  }

  /// Observation rate: encodes images, text and state into the cache.
  virtual void prefix(Graph& g, const PrefixInputs& in, Cache& cache) const = 0;

  /// Step rate: the velocity at x_t, [d_action, horizon] -> the same shape. `condition` is this step's column, [d, 1].
  /// Not called if the solver is `greedy`.
  virtual Tensor velocity(Graph& g, Tensor x_t, Tensor condition, const Cache& cache) const {
    static_cast<void>(g), static_cast<void>(x_t), static_cast<void>(condition), static_cast<void>(cache);
    return {};
  }

  /// Step rate, for the solver `greedy`: the logits [n_vocab] of the token after `token` [1] i32. `k` [1] i32 is the
  /// index of `token` in the answer, from 0; an act reads at most `n_token` tokens of it. The prefix puts the logits of
  /// the first token into the cache as `logits`.
  virtual Tensor decode(Graph& g, Tensor token, Tensor k, int n_token, Cache& cache) const {
    static_cast<void>(g), static_cast<void>(token), static_cast<void>(k), static_cast<void>(n_token);
    static_cast<void>(cache);
    return {};
  }
};

/// Checks that memory can hold a prefix of `n_view` views of `n_token` tokens each and `n_other` other tokens. Errors:
/// unsupported.
Status check_prefix(int n_view, int n_token, int n_other);

/// Checks that the network has places for `n_view` views. `key` is the bundle key that states `max_views`. Errors:
/// bad_bundle.
Status check_views(const char* key, int n_view, int max_views);

/// A registered policy.
struct PolicyEntry {
  std::string name;
  std::unique_ptr<Policy> (*make)(ParamList& list);
  /// The published model's keys, for manifests and for random weights of its size.
  Keys (*published)();
};

template <class P>
PolicyEntry policy_entry(std::string name) {
  const auto make = [](ParamList& list) -> std::unique_ptr<Policy> { return std::make_unique<P>(Scope(list, "")); };
  return {std::move(name), make, P::published};
}

/// Every architecture of src/policies/registry.inc.
const std::vector<PolicyEntry>& policy_registry();
/// Errors: unsupported, with the list of architectures.
Result<PolicyEntry> find_policy(const std::string& name);

}  // namespace vla
