// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "bundle/bundle.h"
#include "graph/rounding.h"

namespace vla {

/// The outcome for the matrices of one module, the first level of their paths.
struct QuantizedModule {
  std::string path;
  int n_matrix = 0;                    // that were quantized
  std::int64_t before = 0, after = 0;  // bytes in the files, of all that the module has
  double error = 0;                    // root mean square of what quantization moved, of that of the matrices
};

struct QuantizeProgress {
  std::int64_t done, all;  // bytes
};

/// Chooses what the matrix of a tensor becomes: int8, int4, or none.
using Choice = std::function<Rounding(const std::string& tensor)>;
/// The same for every matrix.
inline Choice all_as(Rounding codes) {
  return [codes](const std::string&) { return codes; };
}

/// A large matrix of floats, and its bytes as stored, as int8 and as int4, scales included.
struct Quantizable {
  std::string tensor;
  std::int64_t stored = 0, int8 = 0, int4 = 0;
};
/// In the order of the file. Errors: those of Bundle::open and of the policy's manifest; unsupported where there is
/// none.
Result<std::vector<Quantizable>> quantizable(const std::string& bundle);

/// Codes of int4 that are not made of a matrix alone.
struct Int4Codes {
  /// What makes the errors of a matrix good (hessian.h); empty where nothing is known of it. Asked in the file's order.
  std::function<Result<std::span<const float>>(const Bundle& bundle, const TensorInfo& tensor)> feedback;
  /// The same bundle with all of them made, from which they are copied; may be null.
  const Bundle* made = nullptr;
};

/// Writes a bundle whose large matrices are int8 or int4 codes with a scale for each row: where all are of one kind,
/// those that `--kernels int8` or `int4` makes at every load, so that the chunk is the same to the bit. Norms, biases,
/// tables, and matrices from or to fewer than 144 elements stay as they are (graph/rounding.h), and so does a tensor
/// that something else reads too. `why`, which the bundle keeps as vla.quantization, says what chose; it may be empty.
/// Errors: those of `quantizable` and of `int4`; unsupported where nothing is chosen; io.
Result<std::vector<QuantizedModule>> quantize(const std::string& from, const std::string& to, const Choice& choice,
                                              const std::string& why,
                                              const std::function<void(QuantizeProgress)>& report,
                                              const Int4Codes& int4 = {});

}  // namespace vla
