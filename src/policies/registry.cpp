// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "policies/policy.h"

namespace vla {

// Each line of registry.inc declares the entry that src/policies/<name>.cpp defines, and adds it to the table.
#define POLICY(name) PolicyEntry name##_policy();
#include "policies/registry.inc"
#undef POLICY

namespace {

/// The prefix's memory grows with the square of its tokens. The mask of this many takes 256 MB; published policies have
/// about a thousand at most.
constexpr int kMaxPrefix = 8192;

}  // namespace

Status check_prefix(int n_view, int n_token, int n_other) {
  const std::int64_t n_prefix = std::int64_t{n_view} * n_token + n_other;
  if (n_prefix <= kMaxPrefix) return {};
  return Error{Code::unsupported, "prefix", fmt::format("at most {} tokens of views, text and state", kMaxPrefix),
               std::to_string(n_prefix), "use smaller images or fewer views"};
}

Status check_views(const char* key, int n_view, int max_views) {
  if (n_view <= max_views) return {};
  return Error{Code::bad_bundle, key, fmt::format("{} or more, one for each view", n_view), std::to_string(max_views)};
}

const std::vector<PolicyEntry>& policy_registry() {
  static const std::vector<PolicyEntry> entries = {
#define POLICY(name) name##_policy(),
#include "policies/registry.inc"
#undef POLICY
  };
  return entries;
}

Result<PolicyEntry> find_policy(const std::string& name) {
  std::vector<std::string> names;
  for (const PolicyEntry& entry : policy_registry()) {
    if (entry.name == name) return entry;
    names.push_back(entry.name);
  }
  return Error{Code::unsupported, "vla.arch", fmt::format("one of {}", fmt::join(names, ", ")), name,
               "this build does not know the architecture"};
}

}  // namespace vla
