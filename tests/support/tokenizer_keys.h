// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "bundle/keys.h"

namespace vla::test {

/// Keys of a bundle, written as one JSON object. A whole number is an integer of the bundle, any other one in double
/// precision.
inline Keys keys_of(const nlohmann::json& document) {
  Keys keys;
  for (const auto& item : document.items()) {
    if (item.value().is_boolean()) keys.set(item.key(), item.value().get<bool>());
    if (item.value().is_string()) keys.set(item.key(), item.value().get<std::string>());
    if (item.value().is_number_float()) keys.set(item.key(), item.value().get<double>());
    if (item.value().is_number_integer()) keys.set(item.key(), item.value().get<std::int64_t>());
    if (!item.value().is_array()) continue;
    if (item.key().ends_with("_ids")) {
      keys.set(item.key(), item.value().get<std::vector<std::int64_t>>());
    } else {
      keys.set(item.key(), item.value().get<std::vector<std::string>>());
    }
  }
  return keys;
}

}  // namespace vla::test
