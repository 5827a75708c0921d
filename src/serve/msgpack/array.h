// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "processor/image.h"
#include "serve/msgpack/value.h"

namespace vla::msgpack {

/// How an array is laid out in msgpack.
enum class Framing {
  openpi,  // {__ndarray__, data, dtype, shape}, of openpi_client.msgpack_numpy
  numpy,   // {nd, type, kind, shape, data}, of the package msgpack-numpy
  npy      // {__ndarray_class__, as_npy}: a .npy file
};

/// A NumPy array over the bytes of its message, in C order.
struct Array {
  Framing framing = Framing::openpi;
  char kind = 0;         // NumPy's: b, i, u, f or U
  std::size_t item = 0;  // bytes of an element
  bool is_big_endian = false;
  std::vector<std::int64_t> shape;
  std::string_view data;

  std::int64_t size() const;
};

/// Whether a map carries the marker of an array, or of a scalar. Keys may be text or bytes.
bool is_array(const Value& value);

/// Reads an array of at most 8 dimensions, or a NumPy scalar as one of none. Errors: bad_observation for anything else,
/// a dtype that is not listed above, and bytes that are not as many as the shape says.
Result<Array> array_of(const Value& value, const std::string& where);

/// The elements as float32: of an array, a scalar, a number or a list of numbers. Errors: bad_observation.
Result<std::vector<float>> floats_of(const Value& value, const std::string& where);

/// A camera frame of (height, width, 3) or (3, height, width), dimensions of one before them being dropped: uint8, or
/// floats in [0, 1], which become uint8 as the references make them, by 255 x and a cut. `is_bgr`: blue comes first.
/// Errors: bad_observation, and `limits.over` for too many pixels.
Result<Frame> frame_of(const Array& array, const std::string& where, const ImageLimits& limits, bool is_bgr);

/// Text that came as text, as bytes in UTF-8 or as a NumPy string. Errors: bad_observation.
Result<std::string> text_of(const Value& value, const std::string& where);

}  // namespace vla::msgpack
