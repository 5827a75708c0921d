// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/policies.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "base/printable.h"

namespace vla::serve {
namespace {

/// The part of a description that clients rely on between two acts.
std::string interface_of(v1::Description description) {
  description.clear_bundle();
  description.clear_runtime();
  for (v1::Description& robot : *description.mutable_embodiments()) {
    robot.clear_bundle();
    robot.clear_runtime();
  }
  return description.SerializeAsString();
}

}  // namespace

Result<std::shared_ptr<ServedPolicy>> Policies::find(const std::string& name) const {
  const std::string& wanted = name.empty() ? default_name_ : name;
  if (wanted.empty() && policies_.size() == 1) return policies_.begin()->second;
  const auto found = policies_.find(wanted);
  if (found != policies_.end()) return found->second;
  return Error{Code::bad_observation, "policy", fmt::format("one of {}", fmt::join(names(), ", ")),
               name.empty() ? "none" : printable(name)};
}

Result<std::shared_ptr<ServedPolicy>> Policies::put(std::shared_ptr<ServedPolicy> policy) {
  std::shared_ptr<ServedPolicy>& place = policies_[policy->name];
  if (place != nullptr && interface_of(place->description) != interface_of(policy->description))
    return Error{Code::incompatible, policy->name, "the views, states, actions, rate and noise of the version before",
                 "others", "clients were told those: load it under another name"};
  return std::exchange(place, std::move(policy));
}

Result<std::shared_ptr<ServedPolicy>> Policies::remove(const std::string& name) {
  const auto found = policies_.find(name);
  if (name.empty() || found == policies_.end()) return find(name.empty() ? "''" : name).error();
  if (policies_.size() == 1 || name == default_name_)
    return Error{Code::usage, name, "one of several policies, and not the default", "the one that answers",
                 "load another version in its place, or drain the server"};
  std::shared_ptr<ServedPolicy> policy = std::move(found->second);
  policies_.erase(found);
  return policy;
}

std::vector<std::shared_ptr<ServedPolicy>> Policies::all() const {
  std::vector<std::shared_ptr<ServedPolicy>> all;
  for (const auto& [name, policy] : policies_) all.push_back(policy);
  return all;
}

std::vector<std::string> Policies::names() const {
  std::vector<std::string> names;
  for (const auto& [name, policy] : policies_) names.push_back(name);
  return names;
}

}  // namespace vla::serve
