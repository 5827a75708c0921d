// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
// End-effector poses relative to the observed pose. Source: Isaac-GR00T gr00t/data/state_action/pose.py
// (EndEffectorPose) over scipy.spatial.transform.Rotation.
#include "processor/ops/pose.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "processor/json_fields.h"
#include "processor/ops/matrix.h"
#include "processor/recipe.h"

namespace vla {
namespace {

Matrix3<double> transposed(const Matrix3<double>& m) { return {m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]}; }

/// The nearest rotation to a matrix that is a rotation up to rounding errors, by Newton's method.
Matrix3<double> nearest_rotation(Matrix3<double> m) {
  for (int step = 0; step < 2; ++step) {
    Matrix3<double> correction = product(transposed(m), m);
    for (std::size_t i = 0; i < 9; ++i) correction[i] = (i % 4 == 0 ? 1.5 : 0.0) - 0.5 * correction[i];
    m = product(m, correction);
  }
  return m;
}

/// As in numpy: products are rounded to the element type, their sum is computed in double.
template <class T>
T dot(const T* a, const T* b) {
  const T x = a[0] * b[0], y = a[1] * b[1], z = a[2] * b[2];
  return static_cast<T>(static_cast<double>(x) + y + z);
}

template <class T>
Matrix3<double> rotation_of_rows(const T* rows) {
  T first[3], second[3];
  const T length = std::sqrt(dot(rows, rows));
  for (int i = 0; i < 3; ++i) first[i] = rows[i] / length;
  const T along = dot(first, rows + 3);
  for (int i = 0; i < 3; ++i) second[i] = rows[3 + i] - along * first[i];
  const T rest = std::sqrt(dot(second, second));
  for (T& x : second) x /= rest;
  Matrix3<double> out;
  std::copy_n(first, 3, out.begin());
  std::copy_n(second, 3, out.begin() + 3);
  for (std::size_t i = 0; i < 3; ++i) {
    const std::size_t j = (i + 1) % 3, k = (i + 2) % 3;
    out[6 + i] = first[j] * second[k] - first[k] * second[j];
  }
  return nearest_rotation(out);
}

Matrix3<double> rotation_of_vector(const double* v) {
  const double angle = std::sqrt(dot(v, v)), square = angle * angle;
  // For small angles, the quotient is computed by its series.
  const double scale = angle <= 1e-3 ? 0.5 - square / 48 + square * square / 3840 : std::sin(angle / 2) / angle;
  const double x = scale * v[0], y = scale * v[1], z = scale * v[2], w = std::cos(angle / 2);
  return {w * w + x * x - y * y - z * z, 2 * (x * y - z * w),           2 * (x * z + y * w),
          2 * (x * y + z * w),           w * w - x * x + y * y - z * z, 2 * (y * z - x * w),
          2 * (x * z - y * w),           2 * (y * z + x * w),           w * w - x * x - y * y + z * z};
}

/// Computes the quaternion from its largest component, which loses the fewest digits.
void write_vector(const Matrix3<double>& m, double* out) {
  const std::array<double, 4> parts = {m[0], m[4], m[8], m[0] + m[4] + m[8]};
  const auto i = static_cast<std::size_t>(std::max_element(parts.begin(), parts.end()) - parts.begin());
  std::array<double, 4> q;  // x, y, z, w
  if (i == 3) {
    q = {m[7] - m[5], m[2] - m[6], m[3] - m[1], 1 + parts[3]};
  } else {
    const std::size_t j = (i + 1) % 3, k = (i + 2) % 3;
    q[i] = 1 - parts[3] + 2 * parts[i];
    q[j] = m[3 * j + i] + m[3 * i + j];
    q[k] = m[3 * k + i] + m[3 * i + k];
    q[3] = m[3 * k + j] - m[3 * j + k];
  }
  const double length = std::sqrt(dot(q.data(), q.data()) + q[3] * q[3]);
  for (double& x : q) x = (q[3] < 0 ? -x : x) / length;
  const double angle = 2 * std::atan2(std::sqrt(dot(q.data(), q.data())), q[3]), square = angle * angle;
  const double scale = angle <= 1e-3 ? 2 + square / 12 + 7 * square * square / 2880 : angle / std::sin(angle / 2);
  for (std::size_t k = 0; k < 3; ++k) out[k] = scale * q[k];
}

template <class T>
Pose read_numbers(PoseFormat format, std::span<const T> numbers) {
  Pose pose{{numbers[0], numbers[1], numbers[2]}, {}};
  if (format == PoseFormat::rotation_6d) {
    pose.rotation = rotation_of_rows(&numbers[3]);
  } else {
    const double vector[3] = {numbers[3], numbers[4], numbers[5]};
    pose.rotation = rotation_of_vector(vector);
  }
  return pose;
}

}  // namespace

std::size_t pose_size(PoseFormat format) { return format == PoseFormat::rotation_6d ? 9 : 6; }

Pose read_pose(PoseFormat format, std::span<const float> numbers) { return read_numbers(format, numbers); }
Pose read_pose(PoseFormat format, std::span<const double> numbers) { return read_numbers(format, numbers); }

void write_pose(PoseFormat format, const Pose& pose, std::span<double> numbers) {
  std::copy(pose.position.begin(), pose.position.end(), numbers.begin());
  if (format == PoseFormat::rotation_6d)
    std::copy_n(pose.rotation.begin(), 6, numbers.begin() + 3);
  else
    write_vector(pose.rotation, &numbers[3]);
}

Pose compose(const Pose& reference, const Pose& relative) {
  Pose out{reference.position, product(reference.rotation, relative.rotation)};
  for (std::size_t i = 0; i < 3; ++i)
    out.position[i] = dot(&reference.rotation[3 * i], relative.position.data()) + reference.position[i];
  return out;
}

// --- the op "compose_pose" ------------------------------------------------------------------------------------------

namespace {

/// A pose that starts at `column` is relative to the state's pose at `state_column`. The result is not rounded.
struct ComposePoseOp final : ActionOp {
  PoseFormat format = PoseFormat::rotation_6d;
  int column = 0, state_column = 0;

  Status bind(ActionLayout& layout, const std::string& where) override {
    layout.relative = true;
    const auto size = static_cast<int>(pose_size(format)), n_state = static_cast<int>(layout.n_state);
    if (column + size > layout.width)
      return misfit(where + ".column", fmt::format("{} columns of {} from here on", size, layout.width),
                    std::to_string(column));
    if (state_column + size <= n_state) return {};
    return misfit(where + ".state_column", fmt::format("{} columns of {} from here on", size, n_state),
                  std::to_string(state_column));
  }
  void apply(std::vector<double>& row, const RowPlace& place) const override {
    const std::size_t size = pose_size(format);
    const std::span<double> numbers = std::span(row).subspan(static_cast<std::size_t>(column), size);
    const auto observed = place.raw_state.subspan(static_cast<std::size_t>(state_column), size);
    const Pose relative = read_pose(format, std::span<const double>(numbers));
    write_pose(format, compose(read_pose(format, observed), relative), numbers);
  }
};

Status parse_compose_pose(JsonFields& fields, Recipe& recipe) {
  auto op = std::make_unique<ComposePoseOp>();
  VLA_TRY(const int format, fields.choice("format", {"xyz_rot6d", "xyz_rotvec"}));
  op->format = format == 0 ? PoseFormat::rotation_6d : PoseFormat::rotation_vector;
  VLA_TRY(op->column, fields.integer("column", 0, kMaxVector - 1));
  VLA_TRY(op->state_column, fields.integer("state_column", 0, kMaxVector - 1));
  recipe.action.push_back(std::move(op));
  return {};
}

}  // namespace

Ops pose_ops() { return {{"action", "compose_pose", parse_compose_pose}}; }

}  // namespace vla
