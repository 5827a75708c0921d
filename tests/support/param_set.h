// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <optional>

#include "bundle/params.h"
#include "support/editable_bundle.h"
#include "support/stored.h"

namespace vla::test {

/// Parameters with values, as a bundle gives them to modules.
class ParamSet {
 public:
  struct Piece {
    std::string name;
    std::vector<std::int64_t> shape;  // fastest dimension first
    std::vector<float> values;
    DType type = DType::f32;
  };

  explicit ParamSet(const std::vector<Piece>& pieces, const Keys& keys = {}) {
    EditableBundle bundle;
    for (const auto& [key, value] : keys.all()) bundle.set(key, value);
    for (const char* key : {"vla.arch", "vla.source.name", "vla.source.revision", "vla.source.converter"})
      bundle.set(key, Value(std::string("test")));
    bundle.set("vla.dtype", Value(std::string("f32")));
    bundle.set("vla.bundle_version", Value(std::int64_t{1}));
    for (Piece piece : pieces) {
      const auto stored = store_as(piece.type, piece.values);
      const bool is_ternary = piece.type == DType::ternary;
      if (is_ternary) piece.shape[0] /= 4;
      bundle.tensors.push_back({piece.name,
                                is_ternary ? DType::i8 : piece.type,
                                piece.shape,
                                {reinterpret_cast<const char*>(stored.data()), stored.size()}});
    }
    bytes_ = bundle.bytes();
    auto parsed = Bundle::parse(std::as_bytes(std::span(bytes_)), "test");
    REQUIRE_MESSAGE(parsed.ok(), (parsed ? "" : parsed.error().message()));
    bundle_ = std::move(*parsed);
    list_.emplace(bundle_->keys(), &*bundle_);
  }
  ParamSet(const ParamSet&) = delete;
  ParamSet& operator=(const ParamSet&) = delete;

  Scope scope(const std::string& path = "") { return {*list_, path}; }
  /// Everything that was declared, all of which the bundle must have.
  const ParamList& list() const {
    const Status fits = list_->report("test", [](const std::string&) { return false; });
    REQUIRE_MESSAGE(fits.ok(), (fits.ok() ? "" : fits.error().message()));
    return *list_;
  }

 private:
  std::string bytes_;
  std::optional<Bundle> bundle_;
  std::optional<ParamList> list_;
};

}  // namespace vla::test
