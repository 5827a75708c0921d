// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "base/result.h"
#include "graph/rounding.h"

namespace vla {

/// What became of the matrices of one module, the first level of their paths.
struct QuantizedModule {
  std::string path;
  int n_matrix = 0;                    // that were quantized
  std::int64_t before = 0, after = 0;  // bytes in the files, of all that the module has
  double error = 0;                    // root mean square of what quantization moved, of that of the matrices
};

struct QuantizeProgress {
  std::int64_t done, all;  // bytes
};

/// Writes a bundle whose large matrices are int8 or int4 codes with a scale for each row: those that `--kernels int8`
/// or `int4` makes at every load, so that the chunk is the same to the bit. Norms, biases, tables, and matrices from or
/// to fewer than 144 elements stay as they are (graph/rounding.h), and so does a tensor that something else reads too.
/// Errors: those of Bundle::open and of the policy's manifest; unsupported where no matrix is worth it; io.
Result<std::vector<QuantizedModule>> quantize(const std::string& from, const std::string& to, Rounding codes,
                                              const std::function<void(QuantizeProgress)>& report);

}  // namespace vla
