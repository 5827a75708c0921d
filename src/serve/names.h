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
  bool is_flipped = false;   // the client has 1 - x, as for a gripper that counts from open to closed
  bool is_in_order = false;  // the client's numbers are in the policy's order, whatever their names

  float to_policy(float x) const;
  float to_client(float x) const;
};

/// Maps the keys of a client's observation to the policy's views, states and instruction, so that a protocol with other
/// names needs no code. A key with slashes is looked up whole, then level by level.
struct Names {
  struct Entry {
    std::string key, feature;  // the feature's full name in the bundle; empty: the key is accepted and ignored
    Convention convention;
  };
  struct Columns {
    std::size_t begin = 0, end = 0;
    Convention convention;
  };
  std::vector<Entry> views, states, ignored;  // states of the same feature are concatenated in this order
  std::vector<std::string> absent;            // views that every observation lacks
  std::string text = "prompt";                // the key of the instruction
  std::vector<Columns> actions;               // columns whose convention differs from the policy's
  std::string preset;                         // name of the preset; empty without one

  /// For people, in one line: `libero: observation/image=observation.images.image(rgb) ...`.
  std::string told() const;
  /// A chunk's values (horizon, d_action) in the client's conventions.
  void to_client(std::vector<float>& actions, std::size_t d_action) const;
};

constexpr const char* kExtension = "vla";

/// Preset names, for a message.
std::string presets();

/// Selects lines of --map: with `of_modalities` those whose keys begin with `video.` or `state.`, else the other lines.
std::vector<std::string> lines_of(const std::vector<std::string>& lines, bool of_modalities);

/// Returns the full name of a view, given any of its names; empty if no view or several views match.
std::string view_named(const std::string& given, const v1::Description& description);

/// The operator's options for a client's names.
struct Given {
  std::string preset;               // may be empty
  std::vector<std::string> lines;   // the lines of --map
  std::vector<std::string> absent;  // the views of --absent, by any of their names
};

/// Writes lines and absent views as one text for the process that speaks a protocol, and reads them back.
std::string text_of(const Given& given);
Given given_of(const std::string& text);

/// Returns the names of a preset, if one is given, with lines `KEY=FEATURE[,bgr][,degrees][,flipped][,in_order]` that
/// replace or add names. `KEY=` accepts and ignores a key, `KEY=text` gives the instruction's key, and
/// `actions=FROM:TO,...` gives the convention of action columns. Every state and every required view of the policy must
/// have a key, except absent views. `option`: the option that errors name. Errors: usage, with the keys and the
/// policy's features.
Result<Names> names_for(const Given& given, const v1::Description& description, const char* option);

/// Returns the names of a protocol whose keys are `video.VIEW` and `state.STATE`, where VIEW and STATE are the last
/// parts of the policy's names.
Result<Names> own_names(const Given& given, const v1::Description& description, const char* option);

/// The names of vla's own clients: the policy's. Errors: usage if lines or a preset are given.
Result<Names> native_names(const Given& given, const v1::Description& description);

/// An extension of the protocol's own observations: a map {seed, deadline_ms}, both optional integers, which a client
/// that knows this server may send. Errors: bad_observation.
struct Extension {
  std::optional<std::uint64_t> seed, deadline_ms;
};
Result<Extension> extension_of(const msgpack::Value* map, const char* where);

/// Reads an observation from a message with these keys; the key kExtension is allowed beside them. Errors:
/// bad_observation for an unknown key, listing the known ones, and for values that do not fit; too_large.
Result<Observation> observe(const msgpack::Value& message, const Names& names, const ActLimits& limits);

}  // namespace vla::serve
