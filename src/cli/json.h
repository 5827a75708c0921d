// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nlohmann/json.hpp>

#include "bundle/bundle.h"

namespace vla::cli {

/// JSON with members in insertion order and floats in the shortest form that reads back to the same float32.
using Json =
    nlohmann::basic_json<nlohmann::ordered_map, std::vector, std::string, bool, std::int64_t, std::uint64_t, float>;

/// Prints one line, or indented lines. Bytes that are not UTF-8, which a path may have, become U+FFFD.
inline std::string text_of(const Json& json, int indent = -1) {
  return json.dump(indent, ' ', true, Json::error_handler_t::replace);
}

/// Identifies the bundle: path, architecture, dtype, source and checksum.
inline Json identity_json(const Bundle& bundle) {
  Json identity;
  identity["path"] = bundle.path();
  if (!bundle.embodiment().empty()) identity["embodiment"] = bundle.embodiment();
  for (const char* key :
       {"vla.arch", "vla.dtype", "vla.checksum", "vla.source.name", "vla.source.revision", "vla.source.converter"})
    identity[std::string(key).substr(4)] = *bundle.keys().string(key);
  return identity;
}

}  // namespace vla::cli
