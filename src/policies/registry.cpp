// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <fmt/format.h>
#include <fmt/ranges.h>

#include "policies/policy.h"

namespace vla {

// Each line of registry.inc declares the entry that src/policies/<name>.cpp defines, and puts it into the table.
#define POLICY(name) PolicyEntry name##_policy();
#include "policies/registry.inc"
#undef POLICY

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
