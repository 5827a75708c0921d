// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "serve/act.h"
#include "serve/msgpack/value.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// How a client's values and colours become the policy's, and the policy's actions the client's.
struct Convention {
  bool is_bgr = false;       // images: blue comes first
  bool is_degrees = false;   // the client has degrees where the policy has radians
  bool is_flipped = false;   // the client has 1 - x, as grippers that count from open to closed
  bool is_in_order = false;  // the client's numbers are the policy's one by one, whatever it calls them

  float to_policy(float x) const;
  float to_client(float x) const;
};

/// The meaning of the names of a client's observation, so that a protocol of other names needs no code: views, states
/// and the instruction by the client's keys. A key with slashes is looked up whole, then level by level.
struct Names {
  struct Entry {
    std::string key, feature;  // the feature by its full name in the bundle; empty: sent and not looked at
    Convention convention;
  };
  struct Columns {
    std::size_t begin = 0, end = 0;
    Convention convention;
  };
  std::vector<Entry> views, states, ignored;  // states of one feature are joined in this order
  std::vector<std::string> absent;            // views that no observation has
  std::string text = "prompt";                // the key of the instruction
  std::vector<Columns> actions;               // columns whose convention is not the policy's
  std::string preset;                         // empty where only lines say it

  /// For people, in one line: `libero: observation/image=observation.images.image(rgb) ...`.
  std::string told() const;
  /// A chunk's values (horizon, d_action) in the client's conventions.
  void to_client(std::vector<float>& actions, std::size_t d_action) const;
};

constexpr const char* kExtension = "vla";

/// Preset names, for a message.
std::string presets();

/// Picks from lines for all protocols those whose keys are `video.`, `state.` and so on, or the others.
std::vector<std::string> lines_of(const std::vector<std::string>& lines, bool of_modalities);

/// The full name of a view that is given by any of its names; empty where there is none.
std::string view_named(const std::string& given, const v1::Description& description);

/// What an operator says of a client's names.
struct Given {
  std::string preset;               // may be empty
  std::vector<std::string> lines;   // of --map
  std::vector<std::string> absent;  // of --absent: views by any of their names
};

/// Lines and views as one text, for a process that speaks a protocol, and from it.
std::string text_of(const Given& given);
Given given_of(const std::string& text);

/// The names of a preset, which may be empty, with lines `KEY=FEATURE[,bgr][,degrees][,flipped][,in_order]` that
/// replace and add to it; `KEY=` lets a key pass without being looked at, `KEY=text` is the instruction's, and
/// `actions=FROM:TO,...` says conventions of columns of an action. Every view of the policy that an observation must
/// have, and every state, has to come from a key, but for those that are absent. `option`: where errors are. Errors:
/// usage, with the keys and the policy's features.
Result<Names> names_for(const Given& given, const v1::Description& description, const char* option);

/// The names of a protocol whose keys are `video.VIEW` and `state.STATE`: the last parts of the policy's own.
Result<Names> own_names(const Given& given, const v1::Description& description, const char* option);

/// The names of vla's own clients: the policy's. Errors: usage, for lines and a preset, which they have no use for.
Result<Names> native_names(const Given& given, const v1::Description& description);

/// An extension of the protocol's own observations: a map {seed, deadline_ms}, both optional integers, which a client
/// that knows this server may send. Errors: bad_observation.
struct Extension {
  std::optional<std::uint64_t> seed, deadline_ms;
};
Result<Extension> extension_of(const msgpack::Value* map, const char* where);

/// The observation of a message with these names, beside which it may have the key kExtension. Errors: bad_observation
/// for a key that stands for nothing, with both lists, and for values that do not fit; too_large.
Result<Observation> observe(const msgpack::Value& message, const Names& names, const ActLimits& limits);

}  // namespace vla::serve
