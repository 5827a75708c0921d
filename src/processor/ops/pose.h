// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <span>

namespace vla {

/// How a pose is written: its position, then its rotation.
enum class PoseFormat {
  rotation_6d,      // the first two rows of the matrix, nine values in all
  rotation_vector,  // axis times angle, six values in all
};
std::size_t pose_size(PoseFormat format);

/// A rigid motion: x becomes rotation x + position.
struct Pose {
  std::array<double, 3> position;
  std::array<double, 9> rotation;  // row by row
};

/// The rows of a 6D rotation are made orthogonal in the precision of their elements, then the nearest rotation is taken
/// in double precision. Rows without a direction give values that are not finite.
Pose read_pose(PoseFormat format, std::span<const float> numbers);
Pose read_pose(PoseFormat format, std::span<const double> numbers);
void write_pose(PoseFormat format, const Pose& pose, std::span<double> numbers);

/// `relative` as seen from where `reference` is.
Pose compose(const Pose& reference, const Pose& relative);

}  // namespace vla
