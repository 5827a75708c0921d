// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/msgpack/array.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <charconv>
#include <cstring>

#include "base/npy.h"
#include "base/printable.h"
#include "processor/image_codecs.h"
#include "processor/unicode.h"

namespace vla::msgpack {
namespace {

using Type = Value::Type;

constexpr std::size_t kMaxRank = 8;

Error bad(const std::string& where, std::string expected, std::string found) {
  return {Code::bad_observation, where, std::move(expected), std::move(found)};
}

/// NumPy's type string, such as `<f4`.
Status read_dtype(std::string_view text, const std::string& where, Array& array) {
  constexpr std::string_view kKnown[] = {"b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"};
  const bool has_order = text.size() > 2 && std::string_view("<>|").find(text[0]) != std::string_view::npos;
  const std::string_view type = has_order ? text.substr(1) : std::string_view();
  const bool is_text = type.starts_with('U');
  std::size_t size = 0;
  const auto [end, failed] = std::from_chars(type.data() + !type.empty(), type.data() + type.size(), size);
  const bool is_known = std::find(std::begin(kKnown), std::end(kKnown), type) != std::end(kKnown);
  if (!is_known && !(is_text && failed == std::errc() && end == type.data() + type.size() && size > 0 && size < 65536))
    return bad(where, "an array of booleans, integers, float32 or float64",
               fmt::format("dtype {}", printable(text.substr(0, 20))));
  array.kind = type[0];
  array.item = is_text ? 4 * size : size;
  array.is_big_endian = text[0] == '>';
  return {};
}

Status read_shape(const Value* shape, const std::string& where, Array& array) {
  if (shape == nullptr || !shape->is_list() || shape->items.size() > kMaxRank)
    return bad(where, fmt::format("a shape of at most {} dimensions", kMaxRank), "another one, or none");
  for (const Value& size : shape->items) {
    if (size.type != Type::integer || size.integer < 0) return bad(where, "sizes from 0 up in a shape", "others");
    array.shape.push_back(size.integer);
  }
  return {};
}

Status check_bytes(const Array& array, const std::string& where) {
  std::int64_t expected = static_cast<std::int64_t>(array.item);
  for (const std::int64_t size : array.shape)
    if (__builtin_mul_overflow(expected, size, &expected)) return bad(where, "an array that fits", "a larger shape");
  if (static_cast<std::uint64_t>(expected) == array.data.size()) return {};
  return bad(where, fmt::format("{} bytes for the shape ({})", expected, fmt::join(array.shape, ", ")),
             fmt::format("{} bytes", array.data.size()));
}

std::string_view data_of(const Value* value) { return value == nullptr ? std::string_view() : value->data; }

Result<Array> of_npy(const Value& value, const std::string& where) {
  Array array;
  array.framing = Framing::npy;
  const std::string_view file = data_of(value.find("as_npy"));
  VLA_TRY(const NpyHeader header, read_npy_header(std::as_bytes(std::span(file)), where));
  if (header.is_fortran_order && header.shape.size() > 1)
    return bad(where, "an array in C order", "Fortran order: send numpy.ascontiguousarray of it");
  VLA_CHECK(read_dtype(header.descr, where, array));
  if (header.shape.size() > kMaxRank) return bad(where, fmt::format("at most {} dimensions", kMaxRank), "more");
  for (const std::size_t size : header.shape) array.shape.push_back(static_cast<std::int64_t>(size));
  array.data = file.substr(header.data_at);
  VLA_CHECK(check_bytes(array, where));
  return array;
}

/// A scalar of openpi's framing has its value as a plain one.
Result<float> plain_number(const Value& value, const std::string& where) {
  if (value.type == Type::integer) return static_cast<float>(value.integer);
  if (value.type == Type::real) return static_cast<float>(value.real);
  if (value.type == Type::boolean) return value.boolean ? 1.0f : 0.0f;
  return bad(where, "numbers", "another type");
}

template <class T>
float element(const char* at, bool swap) {
  char bytes[sizeof(T)];
  std::memcpy(bytes, at, sizeof(T));
  if (swap) std::reverse(bytes, bytes + sizeof(T));
  T value;
  std::memcpy(&value, bytes, sizeof(T));
  return static_cast<float>(value);
}

using Element = float (*)(const char*, bool);
Element element_of(const Array& array) {
  switch (array.kind) {
    case 'f':
      return array.item == 4 ? element<float> : element<double>;
    case 'i':
      return array.item == 1   ? element<std::int8_t>
             : array.item == 2 ? element<std::int16_t>
             : array.item == 4 ? element<std::int32_t>
                               : element<std::int64_t>;
    case 'U':
      return nullptr;
    default:
      return array.item == 1   ? element<std::uint8_t>
             : array.item == 2 ? element<std::uint16_t>
             : array.item == 4 ? element<std::uint32_t>
                               : element<std::uint64_t>;
  }
}

/// 255 x cut to an integer, in the array's own arithmetic.
template <class T>
Status cut_to_bytes(std::string_view data, const std::string& where, std::vector<std::uint8_t>& out) {
  for (std::size_t i = 0; i < out.size(); ++i) {
    T value;
    std::memcpy(&value, data.data() + i * sizeof(T), sizeof(T));
    if (!(value >= 0 && value <= 1)) return bad(where, "floats in [0, 1]", fmt::format("{}", value));
    out[i] = static_cast<std::uint8_t>(T{255} * value);
  }
  return {};
}

void append_utf8(std::string& out, std::uint32_t point) {
  const auto put = [&](std::uint32_t byte) { out += static_cast<char>(byte); };
  const auto rest = [&](int shift) { put(0x80 | (point >> shift & 0x3F)); };
  if (point < 0x80) return put(point);
  if (point < 0x800) return put(0xC0 | point >> 6), rest(0);
  if (point < 0x10000) return put(0xE0 | point >> 12), rest(6), rest(0);
  put(0xF0 | point >> 18), rest(12), rest(6), rest(0);
}

}  // namespace

std::int64_t Array::size() const {
  std::int64_t n = 1;
  for (const std::int64_t size : shape) n *= size;
  return n;
}

bool is_array(const Value& value) {
  const auto has = [&](const char* key) { return value.find(key) != nullptr; };
  return has("__ndarray__") || has("__npgeneric__") || has("__ndarray_class__") || has("nd");
}

Result<Array> array_of(const Value& value, const std::string& where) {
  if (!is_array(value)) return bad(where, "a NumPy array", "another value");
  if (value.find("__ndarray_class__") != nullptr) return of_npy(value, where);
  Array array;
  const Value* nd = value.find("nd");
  array.framing = nd != nullptr ? Framing::numpy : Framing::openpi;
  VLA_CHECK(read_dtype(data_of(value.find(nd != nullptr ? "type" : "dtype")), where, array));
  if (nd == nullptr ? value.find("__npgeneric__") == nullptr : nd->is_true())
    VLA_CHECK(read_shape(value.find("shape"), where, array));
  array.data = data_of(value.find("data"));
  VLA_CHECK(check_bytes(array, where));
  return array;
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
  for (std::size_t i = 0; i + 1 < array.shape.size(); ++i)
    if (array.shape[i] != 1) return bad(where, "one row of numbers", fmt::format("({})", fmt::join(array.shape, ", ")));
  const Element read = element_of(array);
  if (read == nullptr) return bad(where, "numbers", "text");
  for (std::size_t at = 0; at < array.data.size(); at += array.item)
    out.push_back(read(array.data.data() + at, array.is_big_endian));
  return out;
}

Result<Frame> frame_of(const Array& array, const std::string& where, const ImageLimits& limits, bool is_bgr) {
  const auto first = std::find_if(array.shape.begin(), array.shape.end(), [](std::int64_t size) { return size != 1; });
  const std::size_t n_lead = std::min<std::size_t>(static_cast<std::size_t>(first - array.shape.begin()),
                                                   array.shape.size() > 3 ? array.shape.size() - 3 : 0);
  const std::span<const std::int64_t> shape = std::span(array.shape).subspan(n_lead);
  const bool is_planar = shape.size() == 3 && shape[0] == 3;
  if (shape.size() != 3 || (!is_planar && shape[2] != 3))
    return bad(where, "an image of (height, width, 3) or (3, height, width)",
               fmt::format("({})", fmt::join(array.shape, ", ")));
  const std::int64_t height = shape[is_planar ? 1 : 0], width = shape[is_planar ? 2 : 1];
  VLA_CHECK(codecs::check_size(width, height, where, limits));
  std::vector<std::uint8_t> values(static_cast<std::size_t>(width * height * 3));
  if (array.kind == 'u' && array.item == 1) {
    std::memcpy(values.data(), array.data.data(), values.size());
  } else if (array.kind == 'f' && !array.is_big_endian) {
    VLA_CHECK(array.item == 4 ? cut_to_bytes<float>(array.data, where, values)
                              : cut_to_bytes<double>(array.data, where, values));
  } else {
    return bad(where, "uint8, or floats in [0, 1]", fmt::format("{}{}", array.kind, array.item));
  }
  if (is_planar) {
    std::vector<std::uint8_t> rows(values.size());
    const std::size_t n = rows.size() / 3;
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t c = 0; c < 3; ++c) rows[3 * i + c] = values[c * n + i];
    values = std::move(rows);
  }
  if (is_bgr)
    for (std::size_t i = 0; i < values.size(); i += 3) std::swap(values[i], values[i + 2]);
  return Frame{static_cast<int>(width), static_cast<int>(height), std::move(values)};
}

Result<std::string> text_of(const Value& value, const std::string& where) {
  if (value.is_text()) return std::string(value.data);
  if (value.type == Type::bytes) {
    if (unicode::valid_prefix(value.data) < value.data.size()) return bad(where, "text in UTF-8", "other bytes");
    return std::string(value.data);
  }
  if (value.find("__npgeneric__") != nullptr && value.find("data") != nullptr)
    return text_of(*value.find("data"), where);
  if (!is_array(value)) return bad(where, "text", "another type");
  VLA_TRY(const Array array, array_of(value, where));
  if (array.kind != 'U' || array.size() != 1) return bad(where, "one text", "another array");
  std::string out;
  for (std::size_t at = 0; at < array.data.size(); at += 4) {
    char code[4];
    std::memcpy(code, array.data.data() + at, 4);
    if (array.is_big_endian) std::reverse(code, code + 4);
    std::uint32_t point;
    std::memcpy(&point, code, 4);
    if (point == 0) break;  // the padding
    if (point > 0x10FFFF || (point >= 0xD800 && point < 0xE000)) return bad(where, "text in UTF-32", "other bytes");
    append_utf8(out, point);
  }
  return out;
}

}  // namespace vla::msgpack
