// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>

#include "serve/msgpack/array.h"

namespace vla::msgpack {

/// Writes one message, value by value. After a map of n entries write n alternating keys and values.
class Writer {
 public:
  Writer& map(std::size_t n);
  Writer& list(std::size_t n);
  Writer& text(std::string_view value);
  Writer& bytes(std::string_view value);
  Writer& real(double value);
  Writer& integer(std::int64_t value);
  Writer& boolean(bool value);
  Writer& nil();
  /// A float32 array.
  Writer& array(Framing framing, std::span<const std::size_t> shape, std::span<const float> values);

  std::string take() { return std::move(out_); }
  void write(const char* data, std::size_t size) { out_.append(data, size); }  // interface that the library expects

 private:
  std::string out_;
};

}  // namespace vla::msgpack
