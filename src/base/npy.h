// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <variant>
#include <vector>

#include "base/result.h"

namespace vla {

/// An array of a NumPy file: uint8 or float32, C order.
struct NpyArray {
  std::vector<std::size_t> shape;  // slowest dimension first, as in NumPy
  std::variant<std::vector<std::uint8_t>, std::vector<float>> values;
};

/// The header of a .npy file.
struct NpyHeader {
  std::string descr;  // NumPy's type string, such as `<f4`
  bool is_fortran_order = false;
  std::vector<std::size_t> shape;
  std::size_t count = 0;    // number of elements
  std::size_t data_at = 0;  // byte offset of the first element in the file
};

/// Whether bytes begin like a .npy file.
bool is_npy(std::span<const std::byte> bytes);
/// Reads the header of a .npy file, format versions 1 to 3. Errors: bad_observation with `where`. Source:
/// numpy/lib/format.py.
Result<NpyHeader> read_npy_header(std::span<const std::byte> bytes, const std::string& where);
/// Parses a .npy file, format versions 1 to 3. Errors: bad_observation with `where`.
Result<NpyArray> parse_npy(std::span<const std::byte> bytes, const std::string& where);
/// The header of a float32 array in C order, padded so that the data start at a multiple of 64 bytes.
std::string npy_header(std::span<const std::size_t> shape);
/// Writes float32 values (rows, columns). Errors: io.
Status write_npy(const std::string& path, std::span<const float> values, std::size_t rows, std::size_t columns);

}  // namespace vla
