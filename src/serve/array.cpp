// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/array.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <charconv>
#include <cmath>

#include "base/printable.h"
#include "processor/image_codecs.h"

namespace vla::serve {
namespace {

constexpr std::string_view kNumbers[] = {"b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"};
constexpr std::size_t kMaxCharacters = 65535;

Error bad(const std::string& where, std::string expected, std::string found, std::string hint = {}) {
  return {Code::bad_observation, where, std::move(expected), std::move(found), std::move(hint)};
}

std::string text_of(const std::vector<std::int64_t>& shape) { return fmt::format("({})", fmt::join(shape, ", ")); }

template <class T>
T times_255(T value) {
  return T{255} * value;
}
/// Rounds the product to the 11 significant bits of a float16. For values in [0, 1], truncation then gives the same
/// integer as float16 arithmetic.
float times_255(Half value) {
  int exponent = 0;
  const float product = 255 * static_cast<float>(value);
  std::frexp(product, &exponent);
  return std::ldexp(std::nearbyint(std::ldexp(product, 11 - exponent)), exponent - 11);
}

/// Multiplies by 255 and truncates to an integer. Errors: bad_observation for values outside [0, 1].
template <class T>
Status cut_to_bytes(const Elements<T>& elements, const std::string& where, std::vector<std::uint8_t>& out) {
  for (std::size_t i = 0; i < out.size(); ++i) {
    const T value = elements[i];
    if (!(value >= 0 && value <= 1)) return bad(where, "floats in [0, 1]", fmt::format("{}", +value));
    out[i] = static_cast<std::uint8_t>(times_255(value));
  }
  return {};
}

/// The pixels' values in the array's own order.
Result<std::vector<std::uint8_t>> pixels_of(const Array& array, const std::string& where) {
  std::vector<std::uint8_t> values(array.count());
  const Status valid = array.visit([&]<class T>(const Elements<T>& elements) -> Status {
    if constexpr (std::is_floating_point_v<T> || std::is_same_v<T, Half>) return cut_to_bytes(elements, where, values);
    if (array.type().kind() != 'u' || array.type().size() != 1)
      return bad(where, "pixels of dtype uint8, or float16, float32 or float64 in [0, 1]",
                 "dtype " + array.type().name(), "convert them: astype(numpy.uint8)");
    std::copy(elements.data.begin(), elements.data.end(), values.begin());
    return {};
  });
  if (!valid) return valid.error();
  return values;
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

Result<ElementType> ElementType::read(std::string_view text, const std::string& where) {
  ElementType type;
  const std::string_view letters = text.substr(text.empty() ? 0 : 1);
  const char* const end = letters.data() + letters.size();
  std::size_t size = 0;
  const auto number = letters.empty() ? std::from_chars_result{end, std::errc::invalid_argument}
                                      : std::from_chars(letters.data() + 1, end, size);
  const bool is_number = std::find(std::begin(kNumbers), std::end(kNumbers), letters) != std::end(kNumbers);
  const bool is_text =
      letters.starts_with('U') && number.ec == std::errc() && number.ptr == end && size > 0 && size <= kMaxCharacters;
  const bool has_order =
      text.starts_with('<') || text.starts_with('>') || (text.starts_with('|') && size == 1 && !is_text);
  if (!has_order || (!is_number && !is_text))
    return bad(where, "a dtype of booleans, integers, float16, float32 or float64",
               "dtype " + printable(text.substr(0, 20)), "convert the array: astype(numpy.float32)");
  type.order_ = text[0];
  type.kind_ = letters[0];
  type.size_ = is_text ? 4 * size : size;
  return type;
}

std::string ElementType::name() const {
  return fmt::format("{}{}{}", size_ == 1 ? '|' : order_, kind_, is_text() ? size_ / 4 : size_);
}

Result<Array> Array::make(ElementType type, std::vector<std::int64_t> shape, std::string_view data,
                          const std::string& where) {
  if (shape.size() > kMaxRank)
    return bad(where, fmt::format("at most {} dimensions", kMaxRank), std::to_string(shape.size()));
  auto n_byte = static_cast<std::int64_t>(type.size());
  for (const std::int64_t size : shape)
    if (size < 0 || __builtin_mul_overflow(n_byte, size, &n_byte))
      return bad(where, "sizes from 0 up whose product fits", text_of(shape));
  if (static_cast<std::uint64_t>(n_byte) != data.size())
    return bad(where, fmt::format("{} bytes for the shape {} of {}", n_byte, text_of(shape), type.name()),
               fmt::format("{} bytes", data.size()));
  return Array(type, std::move(shape), data);
}

Result<std::vector<float>> row_of(const Array& array, const std::string& where) {
  for (std::size_t i = 0; i + 1 < array.shape().size(); ++i)
    if (array.shape()[i] != 1) return bad(where, "one row of numbers", text_of(array.shape()));
  if (array.type().is_text()) return bad(where, "numbers", "text");
  return array.visit([]<class T>(const Elements<T>& elements) {
    std::vector<float> row(elements.size());
    for (std::size_t i = 0; i < row.size(); ++i) row[i] = static_cast<float>(elements[i]);
    return row;
  });
}

Result<Frame> frame_of(const Array& array, const std::string& where, const ImageLimits& limits, bool is_bgr) {
  std::span<const std::int64_t> shape = array.shape();
  while (shape.size() > 3 && shape[0] == 1) shape = shape.subspan(1);
  const bool is_planar = shape.size() == 3 && shape[0] == 3;
  if (shape.size() != 3 || (!is_planar && shape[2] != 3))
    return bad(where, "an image of (height, width, 3) or (3, height, width)", text_of(array.shape()));
  const std::int64_t height = shape[is_planar ? 1 : 0], width = shape[is_planar ? 2 : 1];
  VLA_CHECK(codecs::check_size(width, height, where, limits));
  VLA_TRY(std::vector<std::uint8_t> values, pixels_of(array, where));
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

Result<std::string> text_of(const Array& array, const std::string& where) {
  if (!array.type().is_text() || array.count() != 1) return bad(where, "one text", "another array");
  const Elements<std::uint32_t> points{array.data(), array.type().is_swapped()};
  std::string out;
  for (std::size_t i = 0; i < points.size() && points[i] != 0; ++i) {  // zeros are the padding
    const std::uint32_t point = points[i];
    if (point > 0x10FFFF || (point >= 0xD800 && point < 0xE000)) return bad(where, "text in UTF-32", "other bytes");
    append_utf8(out, point);
  }
  return out;
}

}  // namespace vla::serve
