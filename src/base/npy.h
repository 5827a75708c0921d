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
  std::vector<std::size_t> shape;  // slowest dimension first, as NumPy has it
  std::variant<std::vector<std::uint8_t>, std::vector<float>> values;
};

/// Whether bytes begin like a .npy file.
bool is_npy(std::span<const std::byte> bytes);
/// Parses a .npy file, versions 1 to 3. Errors: bad_observation with `where`.
/// Source: numpy/lib/format.py.
Result<NpyArray> parse_npy(std::span<const std::byte> bytes, const std::string& where);
/// Writes float32 values (rows, columns). Errors: io.
Status write_npy(const std::string& path, std::span<const float> values, std::size_t rows, std::size_t columns);

}  // namespace vla
