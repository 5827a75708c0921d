// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/policies.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cctype>

#include "base/printable.h"
#include "wire/interface.h"

namespace vla::serve {

Status check_policy_name(const std::string& name) {
  const auto is_plain = [](unsigned char c) { return std::isalnum(c) != 0 || c == '.' || c == '_' || c == '-'; };
  if (!name.empty() && name.size() <= 64 && std::all_of(name.begin(), name.end(), is_plain)) return {};
  return Error{Code::usage, "policy", "a name of 1 to 64 letters, digits, '.', '_' and '-'", printable(name),
               "NAME=FILE gives a bundle another name"};
}

std::pair<std::string, std::string> named_bundle(const std::string& text) {
  const std::size_t equals = text.find('=');
  if (equals != std::string::npos && check_policy_name(text.substr(0, equals)))
    return {text.substr(0, equals), text.substr(equals + 1)};
  std::string name = text.substr(text.rfind('/') + 1);
  if (name.ends_with(".gguf")) name.resize(name.size() - 5);
  return {name, text};
}

Result<std::shared_ptr<ServedPolicy>> Policies::find(const std::string& name) const {
  const std::string& wanted = name.empty() ? default_name_ : name;
  if (wanted.empty() && policies_.size() == 1) return policies_.begin()->second;
  const auto found = policies_.find(wanted);
  return found != policies_.end() ? Result(found->second) : unknown(name.empty() ? "none" : name);
}

Error Policies::unknown(const std::string& name) const {
  return {Code::bad_observation, "policy", fmt::format("one of {}", fmt::join(names(), ", ")), printable(name)};
}

Result<std::shared_ptr<ServedPolicy>> Policies::put(std::shared_ptr<ServedPolicy> policy) {
  std::shared_ptr<ServedPolicy>& place = policies_[policy->name];
  if (place != nullptr && wire::interface_of(place->description) != wire::interface_of(policy->description))
    return Error{Code::incompatible, policy->name, "the views, states, actions, rate and noise of the version before",
                 "others", "clients were told those: load it under another name"};
  return std::exchange(place, std::move(policy));
}

Result<std::shared_ptr<ServedPolicy>> Policies::remove(const std::string& name) {
  const auto found = policies_.find(name);
  if (found == policies_.end()) return unknown(name);
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
