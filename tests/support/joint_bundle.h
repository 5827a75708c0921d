// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <utility>

#include "support/editable_bundle.h"

namespace vla::test {

/// A bundle for several robots from their bundles, of which the first says what is not `is_own`, by name of a key or
/// tensor.
inline EditableBundle joint_bundle(const std::vector<std::pair<std::string, EditableBundle>>& robots,
                                   const std::function<bool(const std::string&)>& is_own) {
  EditableBundle joint = robots.front().second;
  std::erase_if(joint.tensors, [&](const auto& tensor) { return is_own(tensor.name); });
  for (const auto& [key, value] : robots.front().second.keys.all())
    if (is_own(key)) joint.remove_key(key);
  std::vector<std::string> tags;
  for (const auto& [tag, robot] : robots) {
    const std::string own = "embodiment." + tag + ".";
    for (const auto& [key, value] : robot.keys.all())
      if (is_own(key)) joint.set(own + key, value);
    for (EditableBundle::Piece tensor : robot.tensors)
      if (is_own(tensor.name)) tensor.name = own + tensor.name, joint.tensors.push_back(tensor);
    tags.push_back(tag);
  }
  joint.set("embodiments", Value(tags));
  return joint;
}

/// What is a robot's own in the bundles that vla-convert makes of GR00T, more or less.
inline bool is_robots_own(const std::string& name) {
  for (const char* prefix : {"state_", "action_in", "decode_", "stats.", "observation.state", "processor.recipe"})
    if (name.starts_with(prefix)) return true;
  return false;
}

}  // namespace vla::test
