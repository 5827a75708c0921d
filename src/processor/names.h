// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"

namespace vla {

/// The features of one kind in a bundle, and the names that users may give them: the full name
/// (`observation.images.top`), the alias of the checkpoint's rename step, or the last part of either (`top`).
class FeatureNames {
 public:
  FeatureNames() = default;
  /// `kind` is `view` or `state`; `aliases` has one entry per name, empty if there is none.
  FeatureNames(std::string kind, std::vector<std::string> names, std::vector<std::string> aliases);

  const std::vector<std::string>& names() const { return names_; }
  /// The index of a feature. Whole names take precedence over last parts. Errors: bad_observation for an unknown name,
  /// or one that several features share.
  Result<int> find(std::string_view given) const;
  /// The place to report in an error about a feature given by this name: its full name, or `view "x"` if unknown.
  std::string place(std::string_view given) const;
  /// The bundle's names as a text for messages, at most 50 of them.
  std::string listed() const;

 private:
  std::string kind_;
  std::vector<std::string> names_, aliases_;
};

}  // namespace vla
