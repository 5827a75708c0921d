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

/// The result for the matrices of one module (the first level of their paths).
struct QuantizedModule {
  std::string path;
  int n_matrix = 0;                    // how many were quantized
  std::int64_t before = 0, after = 0;  // bytes in both files, of everything in the module
  double error = 0;                    // root mean square of the quantization error over that of the matrices
};

struct QuantizeProgress {
  std::int64_t done, all;  // bytes
};

/// Chooses what a tensor's matrix becomes: int8, int4, or unchanged (none).
using Choice = std::function<Rounding(const std::string& tensor)>;
/// The same choice for every matrix.
inline Choice all_as(Rounding codes) {
  return [codes](const std::string&) { return codes; };
}

/// A large matrix of floats: bytes as stored, as int8 and as int4, with scales.
struct Quantizable {
  std::string tensor;
  std::int64_t stored = 0, int8 = 0, int4 = 0;
};
/// The matrices in file order. Errors: those of Bundle::open and of the policy's manifest; unsupported if there is
/// none.
Result<std::vector<Quantizable>> quantizable(const std::string& bundle);

/// What codes are made from, besides the matrix itself.
struct CodeSource {
  /// Returns the compensation for a matrix (hessian.h); empty if unknown. Called in file order.
  std::function<Result<std::span<const float>>(const Bundle& bundle, const TensorInfo& tensor)> feedback;
  /// Bundles of the same policy, whose codes are copied if they are of the wanted kind.
  std::vector<const Bundle*> made = {};
};

/// Writes a bundle whose large matrices are int8 or int4 codes with one scale per row. If all are of one kind, the
/// codes are those that `--kernels int8` or `int4` makes at load, and the chunk is the same to the bit. Norms, biases,
/// tables, matrices with fewer than 144 inputs or outputs (graph/rounding.h), and tensors that are also read
/// unquantized stay as they are. `why`: how the codes were chosen; the bundle keeps it as vla.quantization, unless it
/// is empty. Errors: those of `quantizable` and of `source`; unsupported if nothing is chosen; io.
Result<std::vector<QuantizedModule>> quantize(const std::string& from, const std::string& to, const Choice& choice,
                                              const std::string& why,
                                              const std::function<void(QuantizeProgress)>& report,
                                              const CodeSource& source = {});

}  // namespace vla
