// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/names.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

namespace vla {
namespace {

std::string_view last_part(std::string_view name) { return name.substr(name.rfind('.') + 1); }

}  // namespace

FeatureNames::FeatureNames(std::string kind, std::vector<std::string> names, std::vector<std::string> aliases)
    : kind_(std::move(kind)), names_(std::move(names)), aliases_(std::move(aliases)) {}

Result<int> FeatureNames::find(std::string_view given) const {
  std::vector<int> whole, part;
  for (std::size_t i = 0; i < names_.size() && !given.empty(); ++i) {
    if (given == names_[i] || given == aliases_[i]) whole.push_back(static_cast<int>(i));
    if (given == last_part(names_[i]) || given == last_part(aliases_[i])) part.push_back(static_cast<int>(i));
  }
  const std::vector<int>& found = whole.empty() ? part : whole;
  if (found.size() == 1) return found[0];
  const std::string where = fmt::format("{} \"{}\"", kind_, given);
  if (found.empty()) return Error{Code::bad_observation, where, "one of " + listed(), "no such " + kind_};
  return Error{Code::bad_observation, where, "one of " + listed(), "a name that several of them share",
               "give the full name"};
}

std::string FeatureNames::place(std::string_view given) const {
  const auto index = find(given);
  return index ? names_[static_cast<std::size_t>(*index)] : index.error().where;
}

std::string FeatureNames::listed() const {
  constexpr std::size_t kShown = 50;
  if (names_.size() <= kShown) return fmt::format("{}", fmt::join(names_, ", "));
  return fmt::format("{} and {} more", fmt::join(names_.begin(), names_.begin() + kShown, ", "),
                     names_.size() - kShown);
}

}  // namespace vla
