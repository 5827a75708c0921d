// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "base/result.h"
#include "engine/robot.h"

namespace vla::serve {

/// Writes what the policy sees of each frame as VIEW.png into a folder, which is made where it is not there. The files.
/// Errors: bad_observation, io.
Result<std::vector<std::string>> save_first_frames(const Observation& observation, const Robot& robot,
                                                   const std::string& folder);

}  // namespace vla::serve
