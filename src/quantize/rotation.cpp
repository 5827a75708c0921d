// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "quantize/rotation.h"

#include <algorithm>

#include "quantize/graphs.h"
#include "quantize/rotation_places.h"
#include "quantize/rotator.h"
#include "quantize/tensor_rows.h"

namespace vla {
namespace {

using Values = std::vector<float>;

/// What rotations change in a tensor: first factors, then rotations.
struct Change {
  bool becomes_ones = false;
  std::vector<Values> columns_by, rows_by, divided_by;
  std::int64_t d_elements = 0, d_rows = 0;  // channels that are rotated together; 0 for none
};
using Changes = std::map<std::string, Change>;

std::vector<std::string> names_of(const std::set<const Param*>& params, const TensorsOfParams& tensors) {
  std::vector<std::string> names;
  for (const Param* param : params) names.push_back(tensors.of(param).name);
  std::ranges::sort(names);
  return names;
}

Rotation rotation_of(const RotationPlace& place, const TensorsOfParams& tensors) {
  Rotation made = {.d = place.d, .elements = names_of(place.elements, tensors), .rows = names_of(place.rows, tensors)};
  for (const FoldedGain& folded : place.folded)
    made.folded.push_back({.gain = tensors.of(folded.gain).name,
                           .bias = folded.bias != nullptr ? tensors.of(folded.bias).name : "",
                           .columns = names_of(folded.columns, tensors),
                           .rows = names_of(folded.rows, tensors)});
  return made;
}

std::string name_of(const RotationPlace& place, const Rotation& made) {
  const std::string& path = place.path.empty() ? made.rows.front() : place.path;
  return place.is_heads ? "heads" : path.substr(0, path.find('.'));
}

Result<Values> vector_of(const Bundle& bundle, const std::string& name) {
  Values values;
  VLA_CHECK(each_row(bundle, *bundle.find(name),
                     [&](std::int64_t, std::span<float> row) { values.assign(row.begin(), row.end()); }));
  return values;
}

Status fold(const Bundle& bundle, const Folded& folded, Changes& changes) {
  VLA_TRY(const Values gain, vector_of(bundle, folded.gain));
  changes[folded.gain].becomes_ones = true;
  for (const std::string& name : folded.columns) changes[name].columns_by.push_back(gain);
  for (const std::string& name : folded.rows)
    (bundle.find(name)->shape.size() > 1 ? changes[name].rows_by : changes[name].columns_by).push_back(gain);
  if (!folded.bias.empty()) changes[folded.bias].divided_by.push_back(gain);
  return {};
}

/// Whether each bias can be divided by its gain: it is 0 where the gain is.
Result<bool> can_fold(const Bundle& bundle, const Rotation& rotation) {
  for (const Folded& folded : rotation.folded) {
    if (folded.bias.empty()) continue;
    VLA_TRY(const Values gain, vector_of(bundle, folded.gain));
    VLA_TRY(const Values bias, vector_of(bundle, folded.bias));
    for (std::size_t i = 0; i < gain.size(); ++i)
      if (gain[i] == 0 && bias[i] != 0) return false;
  }
  return true;
}

Result<Changes> changes_of(const Bundle& bundle, std::span<const Rotation> rotations) {
  Changes changes;
  for (const Rotation& rotation : rotations) {
    for (const std::string& name : rotation.elements) changes[name].d_elements = rotation.d;
    for (const std::string& name : rotation.rows) changes[name].d_rows = rotation.d;
    for (const Folded& folded : rotation.folded) VLA_CHECK(fold(bundle, folded, changes));
  }
  return changes;
}

/// Rotates each `d` consecutive elements of a row.
void rotate_elements(std::span<float> row, Rotator& rotator, std::vector<double>& part) {
  const auto d = static_cast<std::size_t>(rotator.d());
  for (std::size_t at = 0; at < row.size(); at += d) {
    part.assign(row.begin() + static_cast<std::ptrdiff_t>(at), row.begin() + static_cast<std::ptrdiff_t>(at + d));
    rotator.rotate(part.data(), 1);
    for (std::size_t i = 0; i < d; ++i) row[at + i] = static_cast<float>(part[i]);
  }
}

/// Rotates each `d` consecutive rows of a matrix, some columns at a time.
void rotate_rows(Values& matrix, std::int64_t n_column, Rotator& rotator, std::vector<double>& part) {
  constexpr std::int64_t kColumns = 64;
  const std::int64_t d = rotator.d(), size = d * n_column;
  for (float* rows = matrix.data(); rows < matrix.data() + matrix.size(); rows += size)
    for (std::int64_t first = 0; first < n_column; first += kColumns) {
      const std::int64_t n = std::min(kColumns, n_column - first);
      part.clear();
      for (std::int64_t i = 0; i < d; ++i)
        part.insert(part.end(), rows + i * n_column + first, rows + i * n_column + first + n);
      rotator.rotate(part.data(), n);
      for (std::int64_t i = 0; i < d; ++i)
        for (std::int64_t k = 0; k < n; ++k)
          rows[i * n_column + first + k] = static_cast<float>(part[static_cast<std::size_t>(i * n + k)]);
    }
}

void apply_factors(const Change& change, std::int64_t row, std::span<float> values) {
  if (change.becomes_ones) std::ranges::fill(values, 1.0f);
  for (std::size_t k = 0; k < values.size(); ++k) {
    for (const Values& by : change.columns_by) values[k] *= by[k % by.size()];
    for (const Values& by : change.rows_by) values[k] *= by[static_cast<std::size_t>(row)];
    for (const Values& by : change.divided_by)
      if (by[k] != 0) values[k] /= by[k];
  }
}

Status put_changed(const Bundle& bundle, const TensorInfo& tensor, const Change& change, BundleFile& out) {
  Values matrix;  // empty unless rows are rotated
  std::vector<double> part;
  std::optional<Rotator> of_elements;
  if (change.d_elements > 0) of_elements.emplace(change.d_elements);
  if (change.d_rows > 0) matrix.reserve(static_cast<std::size_t>(tensor.count()));
  VLA_CHECK(each_row(bundle, tensor, [&](std::int64_t row, std::span<float> values) {
    apply_factors(change, row, values);
    if (of_elements) rotate_elements(values, *of_elements, part);
    if (change.d_rows == 0) return put_floats(values, tensor.type, out);
    matrix.insert(matrix.end(), values.begin(), values.end());
  }));
  if (change.d_rows == 0) return {};
  Rotator of_rows(change.d_rows);
  rotate_rows(matrix, tensor.shape.front(), of_rows, part);
  put_floats(matrix, tensor.type, out);
  return {};
}

/// Whether the graphs read every parameter. Else inputs that they were not made for, such as fewer views, may add one
/// to values that would be rotated.
bool has_seen_all(const RotationPlaces& finder, const ParamList& list) {
  std::set<const Param*> scales;
  for (const Param& param : list.params()) scales.insert(param.scales);
  return std::ranges::all_of(list.params(), [&](const Param& param) {
    return param.source == nullptr || scales.contains(&param) || finder.has_seen(param);
  });
}

}  // namespace

Result<Rotations> find_rotations(const std::string& bundle, const EngineOptions& options) {
  RotationPlaces finder;
  VLA_TRY(const std::unique_ptr<Engine> engine,
          see_graphs(bundle, options, [&](const Graph& graph) { finder.see(graph); }));
  if (!has_seen_all(finder, engine->params())) return Rotations();
  VLA_TRY(const Bundle file, Bundle::open(bundle));
  const TensorsOfParams tensors(file, engine->robot().bundle());
  Rotations found;
  for (const RotationPlace& place : finder.found()) {
    Rotation made = rotation_of(place, tensors);
    VLA_TRY(const bool can, can_fold(file, made));
    if (can) found[name_of(place, made)].push_back(std::move(made));
  }
  return found;
}

Status write_rotated(const std::string& from, const std::string& to, std::span<const Rotation> rotations) {
  VLA_TRY(const Bundle bundle, Bundle::open(from));
  VLA_TRY(const Changes changes, changes_of(bundle, rotations));
  return write_changed(
      bundle, to, [&](const TensorInfo& tensor) { return changes.contains(tensor.name); },
      [&](const TensorInfo& tensor, BundleFile& out) {
        return put_changed(bundle, tensor, changes.at(tensor.name), out);
      });
}

}  // namespace vla
