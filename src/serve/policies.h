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

/// Checks the form of a policy's name. Errors: usage.
Status check_policy_name(const std::string& name);
/// Splits `NAME=FILE` into name and bundle. The name of a FILE alone is its file name without folders and `.gguf`.
std::pair<std::string, std::string> named_bundle(const std::string& text);

/// A policy in service. Acts that use it keep it alive.
struct ServedPolicy {
  std::string name;
  std::shared_ptr<Engine> engine;
  v1::Description description;
  std::map<const Robot*, ChunkLimits> limits;  // each robot's limits; empty without --limits
  std::array<EncodedObservation, 2> encoded;   // one is prepared while the other is computed
};

/// The policies that acts may name. One thread at a time.
class Policies {
 public:
  explicit Policies(std::string default_name) : default_name_(std::move(default_name)) {}

  /// Makes this policy the default: clients that name none keep the policy whose description they got, whatever
  /// policies are loaded later.
  void keep_default(const std::string& name) { default_name_ = name; }

  /// Finds a policy by name; without a name, the default or the only one. Errors: bad_observation, listing the names.
  Result<std::shared_ptr<ServedPolicy>> find(const std::string& name) const;
  /// Adds a policy, or replaces the one of the same name and returns that. Errors: incompatible if the new one differs
  /// in views, states, actions, rate or noise, which clients of the old one rely on.
  Result<std::shared_ptr<ServedPolicy>> put(std::shared_ptr<ServedPolicy> policy);
  /// Removes a policy. Errors: bad_observation if no policy has this name; usage for the last policy and for the
  /// default.
  Result<std::shared_ptr<ServedPolicy>> remove(const std::string& name);

  std::vector<std::shared_ptr<ServedPolicy>> all() const;
  std::vector<std::string> names() const;

 private:
  Error unknown(const std::string& name) const;

  std::string default_name_;
  std::map<std::string, std::shared_ptr<ServedPolicy>> policies_;
};

}  // namespace vla::serve
