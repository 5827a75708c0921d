// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "base/result.h"

namespace vla {

/// The features of one kind that a bundle has, and the names under which a user may give them: the full name
/// (`observation.images.top`), the alias of the checkpoint's rename step, or the last part of either (`top`).
class FeatureNames {
 public:
  FeatureNames() = default;
  /// `kind` is `view` or `state`; `aliases` has one entry per name, empty where there is none.
  FeatureNames(std::string kind, std::vector<std::string> names, std::vector<std::string> aliases);

  const std::vector<std::string>& names() const { return names_; }
  /// Index of the feature. A whole name goes before a last part. Errors: bad_observation for a name that the bundle
  /// does not have or that several features share.
  Result<int> find(std::string_view given) const;
  /// The place to name in an error about what was given under this name: the feature's full name, or `view "x"` where
  /// there is none.
  std::string place(std::string_view given) const;
  /// `observation.images.top`, in words for a message: the first 50 names that the bundle has.
  std::string listed() const;

 private:
  std::string kind_;
  std::vector<std::string> names_, aliases_;
};

}  // namespace vla
