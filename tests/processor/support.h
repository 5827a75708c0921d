// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <nlohmann/json.hpp>
#include <span>
#include <string>

#include "bundle/keys.h"
#include "processor/image.h"
#include "support/editable_bundle.h"
#include "support/tokenizer_keys.h"

/// Helpers of this room's tests. The data files are written by tests/reference/make_processor_data.py.
namespace vla::test {

inline std::string data_path(const std::string& name) { return source_path("tests/processor/data/" + name); }

inline nlohmann::json data_json(const std::string& name) { return nlohmann::json::parse(read_text(data_path(name))); }

inline std::span<const std::byte> bytes_of(const std::string& text) { return std::as_bytes(std::span(text)); }

inline Result<Frame> decode_data(const std::string& name, const ImageLimits& limits = {}) {
  const std::string file = read_text(data_path("images/" + name));
  return decode_image(bytes_of(file), name, limits);
}

/// The tokenizer.* keys of a data file.
inline Keys tokenizer_keys(const std::string& name) { return keys_of(data_json("tokenizer_" + name + ".json")); }

inline bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

/// The message of an error of this class; fails the test when there is none.
template <class T>
std::string refusal(const Result<T>& result, Code code) {
  REQUIRE_FALSE(result.ok());
  CHECK(result.error().code == code);
  return result.error().message();
}

}  // namespace vla::test
