// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <vector>

#include "processor/image.h"

namespace vla::serve {

/// The type of an array's elements: one of those that `read` lists.
class ElementType {
 public:
  /// Reads NumPy's type string: a byte order and b1, i1, i2, i4, i8, u1, u2, u4, u8, f2, f4, f8 or, for text, U with a
  /// number of characters. The order is `<` or `>`; elements of one byte may have `|`. Errors: bad_observation.
  static Result<ElementType> read(std::string_view text, const std::string& where);

  char kind() const { return kind_; }         // NumPy's letter
  std::size_t size() const { return size_; }  // bytes of an element, at least 1
  bool is_swapped() const { return order_ == '>' && size_ > 1; }
  bool is_text() const { return kind_ == 'U'; }
  std::string name() const;  // the type string, in the form that `read` accepts

 private:
  ElementType() = default;
  char order_ = '|', kind_ = 'u';
  std::size_t size_ = 1;
};

/// A NumPy array over the bytes of its message, in C order. Type and shape always account for exactly these bytes.
class Array {
 public:
  static constexpr std::size_t kMaxRank = 8;
  /// Errors: bad_observation for more than kMaxRank dimensions, a negative or overflowing size, or a number of bytes
  /// that does not fit type and shape.
  static Result<Array> make(ElementType type, std::vector<std::int64_t> shape, std::string_view data,
                            const std::string& where);

  const ElementType& type() const { return type_; }
  const std::vector<std::int64_t>& shape() const { return shape_; }
  std::string_view data() const { return data_; }
  std::size_t count() const { return data_.size() / type_.size(); }  // elements

  /// Calls `visit` with the elements in their C++ type, as Elements<T>. A boolean is true if its byte is not 0. Text is
  /// passed as its bytes.
  template <class Visit>
  auto visit(Visit visit) const;

 private:
  Array(ElementType type, std::vector<std::int64_t> shape, std::string_view data)
      : type_(type), shape_(std::move(shape)), data_(data) {}

  ElementType type_;
  std::vector<std::int64_t> shape_;
  std::string_view data_;
};

/// A NumPy float16. Its conversion to float is exact.
struct Half {
  std::uint16_t bits;
  operator float() const {  // NOLINT: as the built-in types convert
    const int exponent = bits >> 10 & 0x1F, fraction = bits & 0x3FF;
    const float size = exponent == 31  ? (fraction != 0 ? NAN : INFINITY)
                       : exponent == 0 ? std::ldexp(static_cast<float>(fraction), -24)
                                       : std::ldexp(static_cast<float>(fraction + 0x400), exponent - 25);
    return (bits & 0x8000) != 0 ? -size : size;
  }
};

/// The elements of an array, of a known type.
template <class T>
struct Elements {
  std::string_view data;
  bool is_swapped = false;  // the most significant byte comes first

  std::size_t size() const { return data.size() / sizeof(T); }
  T operator[](std::size_t i) const {
    char bytes[sizeof(T)];
    std::memcpy(bytes, data.data() + i * sizeof(T), sizeof(T));
    if constexpr (std::is_same_v<T, bool>) return bytes[0] != 0;
    if (is_swapped) std::reverse(bytes, bytes + sizeof(T));
    T value;
    std::memcpy(&value, bytes, sizeof(T));
    return value;
  }
};

/// Returns the numbers of a one-row array as float32; leading dimensions of one are dropped. Errors: bad_observation.
Result<std::vector<float>> row_of(const Array& array, const std::string& where);

/// Reads a camera frame of shape (height, width, 3) or (3, height, width); leading dimensions of one are dropped.
/// Elements are uint8, or float16, float32 or float64 in [0, 1]. Floats become uint8 as in the references: multiplied
/// by 255 in the array's own precision, then truncated. `is_bgr`: blue comes first. Errors: bad_observation, and
/// `limits.over` for too many pixels.
Result<Frame> frame_of(const Array& array, const std::string& where, const ImageLimits& limits, bool is_bgr);

/// Returns the text of an array with one element. Errors: bad_observation.
Result<std::string> text_of(const Array& array, const std::string& where);

template <class Visit>
auto Array::visit(Visit visit) const {
  const bool swap = type_.is_swapped();
  switch (type_.kind()) {
    case 'b':
      return visit(Elements<bool>{data_, swap});
    case 'f':
      if (type_.size() == 2) return visit(Elements<Half>{data_, swap});
      if (type_.size() == 4) return visit(Elements<float>{data_, swap});
      return visit(Elements<double>{data_, swap});
    case 'i':
      if (type_.size() == 1) return visit(Elements<std::int8_t>{data_, swap});
      if (type_.size() == 2) return visit(Elements<std::int16_t>{data_, swap});
      if (type_.size() == 4) return visit(Elements<std::int32_t>{data_, swap});
      return visit(Elements<std::int64_t>{data_, swap});
    default:
      if (type_.size() == 2) return visit(Elements<std::uint16_t>{data_, swap});
      if (type_.size() == 4 && !type_.is_text()) return visit(Elements<std::uint32_t>{data_, swap});
      if (type_.size() == 8 && !type_.is_text()) return visit(Elements<std::uint64_t>{data_, swap});
      return visit(Elements<std::uint8_t>{data_, swap});
  }
}

}  // namespace vla::serve
