// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/msgpack/array.h"

#include <fmt/format.h>

#include "base/npy.h"
#include "processor/unicode.h"

namespace vla::msgpack {
namespace {

using serve::ElementType;
using Type = Value::Type;

Error bad(const std::string& where, std::string expected, std::string found) {
  return {Code::bad_observation, where, std::move(expected), std::move(found)};
}

Result<std::vector<std::int64_t>> read_shape(const Value* shape, const std::string& where) {
  if (shape == nullptr || !shape->is_list()) return bad(where, "a shape", "another value, or none");
  std::vector<std::int64_t> sizes;
  for (const Value& size : shape->items) {
    if (size.type != Type::integer) return bad(where, "sizes from 0 up in a shape", "others");
    sizes.push_back(size.integer);
  }
  return sizes;
}

std::string_view data_of(const Value* value) { return value == nullptr ? std::string_view() : value->data; }

Result<Array> of_npy(const Value& value, const std::string& where) {
  const std::string_view file = data_of(value.find("as_npy"));
  VLA_TRY(const NpyHeader header, read_npy_header(std::as_bytes(std::span(file)), where));
  if (header.is_fortran_order && header.shape.size() > 1)
    return bad(where, "an array in C order", "Fortran order: send numpy.ascontiguousarray of it");
  VLA_TRY(const ElementType type, ElementType::read(header.descr, where));
  return Array::make(type, {header.shape.begin(), header.shape.end()}, file.substr(header.data_at), where);
}

/// Reads a plain number. A scalar in openpi's framing contains one.
Result<float> plain_number(const Value& value, const std::string& where) {
  if (value.type == Type::integer) return static_cast<float>(value.integer);
  if (value.type == Type::real) return static_cast<float>(value.real);
  if (value.type == Type::boolean) return value.boolean ? 1.0f : 0.0f;
  return bad(where, "numbers", "another type");
}

}  // namespace

std::optional<Framing> framing_of(const Value& value) {
  const auto has = [&](const char* key) { return value.find(key) != nullptr; };
  if (has("__ndarray_class__")) return Framing::npy;
  if (has("nd")) return Framing::numpy;
  if (has("__ndarray__") || has("__npgeneric__")) return Framing::openpi;
  return std::nullopt;
}

Result<Array> array_of(const Value& value, const std::string& where) {
  const std::optional<Framing> framing = framing_of(value);
  if (!framing) return bad(where, "a NumPy array", "another value");
  if (framing == Framing::npy) return of_npy(value, where);
  const bool is_numpy = framing == Framing::numpy;
  const bool is_scalar = is_numpy ? !value.find("nd")->is_true() : value.find("__npgeneric__") != nullptr;
  VLA_TRY(const ElementType type, ElementType::read(data_of(value.find(is_numpy ? "type" : "dtype")), where));
  std::vector<std::int64_t> shape;
  if (!is_scalar) {
    VLA_TRY(shape, read_shape(value.find("shape"), where));
  }
  return Array::make(type, std::move(shape), data_of(value.find("data")), where);
}

Result<std::vector<float>> floats_of(const Value& value, const std::string& where) {
  std::vector<float> out;
  if (value.is_list()) {
    for (const Value& item : value.items) {
      VLA_TRY(const float number, plain_number(item, where));
      out.push_back(number);
    }
    return out;
  }
  const Value* scalar = value.find("__npgeneric__") != nullptr ? value.find("data") : nullptr;
  if (scalar != nullptr || !value.is_map()) {
    VLA_TRY(const float number, plain_number(scalar != nullptr ? *scalar : value, where));
    return std::vector<float>{number};
  }
  VLA_TRY(const Array array, array_of(value, where));
  return row_of(array, where);
}

Result<std::string> text_of(const Value& value, const std::string& where) {
  if (value.is_text()) return std::string(value.data);
  if (value.type == Type::bytes) {
    if (value.data.size() > serve::kMostText)
      return Error{Code::too_large, where, fmt::format("at most {} bytes", serve::kMostText),
                   fmt::format("{} bytes", value.data.size())};
    if (unicode::valid_prefix(value.data) < value.data.size()) return bad(where, "text in UTF-8", "other bytes");
    return std::string(value.data);
  }
  if (value.find("__npgeneric__") != nullptr && value.find("data") != nullptr)
    return text_of(*value.find("data"), where);
  if (!framing_of(value)) return bad(where, "text", "another type");
  VLA_TRY(const Array array, array_of(value, where));
  return serve::text_of(array, where);
}

}  // namespace vla::msgpack
