// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <memory>
#include <string>
#include <vector>

#include "graph/device.h"
#include "lower/cpu/table_rows.h"
#include "lower/host/weight_stream.h"

namespace vla::lower {

/// The embedding tables of a policy's bundle.
using Tables = std::map<const Param*, std::unique_ptr<TableRows>>;

/// Addresses of parameters, by Param::id. Programs look matrices up when a run begins; between runs a matrix may move.
struct WeightTable {
  struct Entry {
    std::byte* data = nullptr;
    float* scales = nullptr;  // scales of a quantized matrix
  };
  std::vector<Entry> entries;
  std::uint64_t version = 1;  // changes with every move

  const Entry& at(const Param* param) const { return entries[static_cast<std::size_t>(param->id)]; }
};

/// The parameters of a policy for the CPU's kernels. Matrices are packed into panels, encoded as in the bundle or
/// rounded, and resident or streamed. Vectors are copied. Embedding tables stay in the bundle; a row is widened exactly
/// when it is looked up.
class CpuWeights {
 public:
  struct Options {
    Features use;
    Rounding rounding;
    int n_thread;
    bool fill = true;  // false: reserves addresses and touches no memory
  };
  /// Every parameter must have a source. Errors: out_of_memory; device; bad_bundle if the file has changed since it was
  /// opened; unsupported if no matrix is large enough to round (graph/rounding.h).
  static Result<CpuWeights> load(const ParamList& list, const Options& options, const WeightPlan& plan);

  std::byte* data(const Param* param) const { return table_->at(param).data; }
  const float* floats(const Param* vector) const { return reinterpret_cast<const float*>(data(vector)); }
  /// The encoding of a parameter in memory.
  const Encoding& encoding(const Param* param) const { return place(param).encoding; }
  /// Returns the kernel that multiplies by a matrix.
  const kernels::LinearKernel* kernel(const Param* matrix) const { return place(matrix).kernel; }
  /// Bytes of a matrix.
  std::size_t size_of(const Param& matrix) const { return place(&matrix).size_of(matrix); }
  /// The streamed group of each parameter, by Param::id; -1 if it is resident.
  const std::vector<int>& groups() const { return groups_; }
  /// The stream of the groups; null if there are none or the weights were not read.
  const std::shared_ptr<WeightStream>& stream() const { return stream_; }
  /// The address table of all parameters, which programs keep.
  const std::shared_ptr<WeightTable>& table() const { return table_; }
  /// All embedding tables that have a source.
  const std::shared_ptr<const Tables>& tables() const { return tables_; }
  /// The rows of one table; null if it has no source.
  TableRows* rows(const Param* table) const {
    const auto found = tables_->find(table);
    return found != tables_->end() ? found->second.get() : nullptr;
  }
  /// Whether any matrix is int8 or int4 codes in memory.
  bool has_int8() const;
  /// Bytes in memory, including the row caches of tables and the windows for streamed matrices.
  std::size_t size() const { return memory_.size() + table_size_; }
  /// The kernels, and how many matrices each multiplies, for display: `avx2 (98 bf16)`.
  const std::string& text() const { return text_; }

 private:
  struct Place : MatrixPlace {
    const kernels::LinearKernel* kernel = nullptr;  // null unless a matrix
  };
  const Place& place(const Param* param) const { return places_[static_cast<std::size_t>(param->id)]; }
  Place& place(const Param* param) { return places_[static_cast<std::size_t>(param->id)]; }
  bool is_streamed(const Param& param) const { return groups_[static_cast<std::size_t>(param.id)] >= 0; }
  Status choose(const ParamList& list, const Options& options);
  Status give_places(const ParamList& list, const Options& options, const WeightPlan& plan);
  Status fill(const ParamList& list, const WeightPlan& plan, int n_thread) const;
  Status start_stream(const ParamList& list, const WeightPlan& plan, int n_thread);

  Memory memory_;
  std::shared_ptr<WeightTable> table_;
  std::shared_ptr<const Tables> tables_;
  std::size_t table_size_ = 0;
  std::vector<Place> places_;
  std::vector<int> groups_;
  std::string text_;
  std::shared_ptr<WeightStream> stream_;  // destroyed before the memory that it writes to
};

}  // namespace vla::lower
