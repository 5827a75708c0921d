// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <set>

#include "quantize/hessian.h"
#include "quantize/matrix_inputs.h"
#include "quantize/search.h"

namespace vla {

/// The Hessians of a bundle's matrices, from what they multiply in the acts of some observations. Those of as many
/// matrices as a gigabyte or a quarter of the budget holds are measured at a time, so matrices are best asked for in
/// the file's order.
class Hessians {
 public:
  /// Finds what is multiplied. `observations` must outlive this. Errors: those of Engine.
  static Result<Hessians> of(const std::string& bundle, std::span<const Judged> observations, EngineOptions options);

  /// What makes the errors of a matrix good, by its tensor's place in the file; empty where a value that it multiplies
  /// has no path. It stays until another one is asked for. Errors: those of Engine.
  Result<std::span<const float>> feedback(const Bundle& bundle, const TensorInfo& tensor);
  /// Of the matrices that were asked for, those with an answer, and all.
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
  std::map<std::ptrdiff_t, std::set<std::string>> inputs_;        // by Bundle::offset; those that all have paths
  std::map<std::set<std::string>, std::vector<float>> feedback_;  // by the paths of what is multiplied
  int n_known_ = 0, n_asked_ = 0;
};

}  // namespace vla
