// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "engine/engine.h"
#include "serve/names.h"

namespace vla::cli {

/// A number that a robot's motors give and take.
struct Motor {
  const char *name, *unit;
};

/// A robot as LeRobot has it: motors in its order, and cameras where they have usual names.
struct RobotModel {
  const char* name;
  std::vector<Motor> motors;
  std::vector<std::string> cameras;
};

/// The models, and the names of all for a message.
const std::vector<RobotModel>& robot_models();

/// What the robot would send where, as LeRobot's door passes it on.
struct RobotCheck {
  const RobotModel& robot;
  std::vector<std::string> cameras;  // of its configuration
  const serve::Names& names;
  const v1::Description& description;
  const Robot& policy;

  /// Prints which motor and camera goes where, and what is missing. The number of problems.
  int print() const;
};

/// A chunk's columns over its rows as SVG, with where the robot is before them, for the columns that have such a value.
std::string plot_chunk(const std::vector<float>& rows, const std::vector<std::string>& names,
                       const std::vector<std::optional<float>>& state);

}  // namespace vla::cli
