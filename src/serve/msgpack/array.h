// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "serve/array.h"
#include "serve/msgpack/value.h"

namespace vla::msgpack {

/// How an array is laid out in msgpack.
enum class Framing {
  openpi,  // {__ndarray__, data, dtype, shape}, of openpi_client.msgpack_numpy
  numpy,   // {nd, type, kind, shape, data}, of the package msgpack-numpy
  npy      // {__ndarray_class__, as_npy}: a .npy file
};

using serve::Array;

/// The layout of a map that carries the marker of an array, or of a scalar; none for another value. Keys may be text or
/// bytes.
std::optional<Framing> framing_of(const Value& value);

/// Reads an array, or a NumPy scalar as one without dimensions. Errors: bad_observation for anything else, and as
/// ElementType::read and Array::make.
Result<Array> array_of(const Value& value, const std::string& where);

/// The elements as float32: of an array, a scalar, a number or a list of numbers. Errors: bad_observation.
Result<std::vector<float>> floats_of(const Value& value, const std::string& where);

/// Reads text that was sent as text, as bytes in UTF-8 or as a NumPy string. Errors: bad_observation.
Result<std::string> text_of(const Value& value, const std::string& where);

}  // namespace vla::msgpack
