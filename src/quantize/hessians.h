// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <set>

#include "quantize/hessian.h"
#include "quantize/matrix_inputs.h"
#include "quantize/search.h"

namespace vla {

/// The Hessians of a bundle's matrices, measured in the acts of some observations. As many as fit into a gigabyte, or a
/// quarter of the budget, are measured at a time, so ask for matrices in file order.
class Hessians {
 public:
  /// Finds what each matrix multiplies. `observations` must outlive this. Errors: those of Engine.
  static Result<Hessians> of(const std::string& bundle, std::span<const Judged> observations, EngineOptions options);

  /// The compensation for a matrix, by its tensor's offset in the file; empty if a value that it multiplies has no
  /// path. Valid until the next call. Errors: those of Engine.
  Result<std::span<const float>> feedback(const Bundle& bundle, const TensorInfo& tensor);
  /// For how many requested matrices a compensation is known, and how many were requested.
  int n_known() const { return n_known_; }
  int n_asked() const { return n_asked_; }

 private:
  Hessians(std::string bundle, std::span<const Judged> observations, EngineOptions options)
      : bundle_(std::move(bundle)), observations_(observations), options_(std::move(options)) {}
  const std::set<std::string>* inputs_of(const Bundle& bundle, const TensorInfo& tensor) const;
  Status measure(const Bundle& bundle, const TensorInfo& first);

  std::string bundle_;
  std::span<const Judged> observations_;
  EngineOptions options_;
  std::map<std::ptrdiff_t, std::set<std::string>> inputs_;  // by Bundle::offset; matrices whose inputs all have paths
  std::map<std::set<std::string>, std::vector<float>> feedback_;  // by the paths of the inputs
  int n_known_ = 0, n_asked_ = 0;
};

}  // namespace vla
