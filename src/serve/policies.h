// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "engine/engine.h"
#include "serve/chunk_limits.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// Errors: usage for a name that no policy may have.
Status check_policy_name(const std::string& name);
/// The name and the bundle of `NAME=FILE`; a file alone has the name that it has without folders and `.gguf`.
std::pair<std::string, std::string> named_bundle(const std::string& text);

/// A policy that the server answers with. It lives as long as one of its acts.
struct ServedPolicy {
  std::string name;
  std::shared_ptr<Engine> engine;
  v1::Description description;
  std::map<const Robot*, ChunkLimits> limits;  // of each robot; none without --limits
  std::array<EncodedObservation, 2> encoded;   // one is prepared while the other is computed
};

/// The policies that acts may name. One thread at a time.
class Policies {
 public:
  explicit Policies(std::string default_name) : default_name_(std::move(default_name)) {}

  /// From now on this one is the default: who names none keeps what it was told, whatever else is loaded.
  void keep_default(const std::string& name) { default_name_ = name; }

  /// Without a name the default, or the only one. Errors: bad_observation, with the names that there are.
  Result<std::shared_ptr<ServedPolicy>> find(const std::string& name) const;
  /// Adds a policy, or replaces the one of the same name and returns that. Errors: incompatible if the new one differs
  /// in views, states, actions, rate or noise, which clients of the old one rely on.
  Result<std::shared_ptr<ServedPolicy>> put(std::shared_ptr<ServedPolicy> policy);
  /// Takes one out. Errors: bad_observation where there is none of that name; usage for the last one and the default.
  Result<std::shared_ptr<ServedPolicy>> remove(const std::string& name);

  std::vector<std::shared_ptr<ServedPolicy>> all() const;
  std::vector<std::string> names() const;

 private:
  Error unknown(const std::string& name) const;

  std::string default_name_;
  std::map<std::string, std::shared_ptr<ServedPolicy>> policies_;
};

}  // namespace vla::serve
