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

/// The tables of a policy's bundle.
using Tables = std::map<const Param*, std::unique_ptr<TableRows>>;

/// The addresses of parameters, by their ids. Programs look matrices up when a run begins: until then one may move.
struct WeightTable {
  struct Entry {
    std::byte* data = nullptr;
    float* scales = nullptr;  // of the codes of a matrix
  };
  std::vector<Entry> entries;
  std::uint64_t version = 1;  // another one after every change

  const Entry& at(const Param* param) const { return entries[static_cast<std::size_t>(param->id)]; }
};

/// The parameters of a policy for the CPU's kernels. Matrices are packed in panels, encoded as in the bundle or
/// rounded, and resident or streamed; vectors are copied. Tables stay with the bundle, since a row that is looked up is
/// widened exactly.
class CpuWeights {
 public:
  struct Options {
    Features use;
    Rounding rounding;
    int n_thread;
    bool fill = true;  // else memory is reserved and never touched
  };
  /// Every parameter must have its source. Errors: out_of_memory, device, bad_bundle where the file has been changed
  /// since it was opened, unsupported where nothing is worth rounding (graph/rounding.h).
  static Result<CpuWeights> load(const ParamList& list, const Options& options, const WeightPlan& plan);

  const std::byte* data(const Param* param) const { return table_->at(param).data; }
  const float* floats(const Param* vector) const { return reinterpret_cast<const float*>(data(vector)); }
  /// How it lies in memory.
  const Encoding& encoding(const Param* param) const { return place(param).encoding; }
  /// The kernel that multiplies by a matrix.
  const kernels::LinearKernel* kernel(const Param* matrix) const { return place(matrix).kernel; }
  /// Bytes of a matrix.
  std::size_t size_of(const Param& matrix) const { return place(&matrix).size_of(matrix); }
  /// By Param::id, its group among those of the plan that are streamed, or -1.
  const std::vector<int>& groups() const { return groups_; }
  /// The stream that reads those; null where there are none, or nothing is filled.
  const std::shared_ptr<WeightStream>& stream() const { return stream_; }
  /// The addresses of all parameters; programs keep the table.
  const std::shared_ptr<WeightTable>& table() const { return table_; }
  /// All tables that have their source.
  const std::shared_ptr<const Tables>& tables() const { return tables_; }
  /// The rows of one of them; null where it has no source.
  TableRows* rows(const Param* table) const {
    const auto found = tables_->find(table);
    return found != tables_->end() ? found->second.get() : nullptr;
  }
  /// Whether matrices of floats are int8 codes, as they are stored or rounded.
  bool has_int8() const;
  /// Bytes in memory; of tables those of the rows that may be kept, of streamed matrices those of their windows.
  std::size_t size() const { return memory_.size() + table_size_; }
  /// Which kernel multiplies how many matrices, for display: `avx2 (98 bf16)`.
  const std::string& text() const { return text_; }

 private:
  struct Place : MatrixPlace {
    const kernels::LinearKernel* kernel = nullptr;  // of a matrix
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
  std::shared_ptr<WeightStream> stream_;  // goes before the memory that it writes to
};

}  // namespace vla::lower
