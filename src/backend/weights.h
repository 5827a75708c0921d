// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "backend/matrix.h"
#include "backend/scratch.h"
#include "backend/store.h"
#include "bundle/params.h"

namespace vla {

/// The kernels that compute with these parameters on a device for `isa`. Tiles of bf16 round whatever they multiply,
/// attention's operands too. A bundle asks for that by storing its matrices as bf16; one matrix of another dtype, or
/// none at all, makes everything float32.
Isa isa_for(const ParamList& list, Isa isa);

/// The parameters of a policy, resident on a device. A matrix lies as the kernel that was chosen for it wants it:
///   packed      in the bundle's dtype, in panels that are made at load
///   widened     float32 for ggml's product, whose own bf16 and f16 products would round the activations first
/// Tables stay in the mapped file, since a row that is looked up is widened exactly. Vectors are copied.
///
/// The file was compared with its checksum when it was opened. Who changes it afterwards changes the tables, and who
/// makes it shorter ends the process (SIGBUS): replace a bundle by renaming a new file over it.
class Weights {
 public:
  enum class Fill { no, yes };

  /// Every parameter must have its source: call ParamList::report first. Without filling, memory is reserved and never
  /// touched, which is enough to learn sizes. `choose` says how matrices lie; without it all are widened.
  /// Errors: out_of_memory.
  static Result<Weights> load(const ParamList& list, const Device& device, Fill fill, ChooseFormat choose = nullptr);

  Tensor operator[](const Param* param) const { return places_[static_cast<std::size_t>(param->id)].tensor; }
  /// The format that was chosen for a matrix; null where it was widened.
  const MatrixFormat* format(const Param* param) const { return places_[static_cast<std::size_t>(param->id)].format; }
  /// Bytes in memory, those of the mapped file included.
  std::size_t size() const { return store_.size() + mapped_size_; }
  std::size_t count() const { return places_.size(); }
  /// Which kernel multiplies how many matrices, for people: `avx2 (98 bf16)`.
  const std::string& kernels() const { return kernels_; }

  Isa isa() const { return isa_; }
  Scratch& scratch() const { return *scratch_; }

 private:
  struct Place {
    Tensor tensor;
    const MatrixFormat* format = nullptr;
  };

  Weights(std::size_t n_param, const Device& device)
      : store_(n_param), mapped_(n_param), scratch_(device.scratch()), isa_(device.isa()) {}
  Place declare(const Param& param, ChooseFormat choose);
  void fill(const Param& param, const Bundle& bundle) const;
  void describe(const ParamList& list);

  Store store_;
  MappedStore mapped_;
  std::shared_ptr<Scratch> scratch_;
  std::shared_ptr<const void> file_;
  Isa isa_;
  std::size_t mapped_size_ = 0;
  std::vector<Place> places_;
  std::string kernels_;
};

}  // namespace vla
