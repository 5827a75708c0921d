// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "base/result.h"
#include "engine/robot.h"

namespace vla::serve {

/// Writes each frame as the policy sees it after preprocessing to VIEW.png in a folder, which is created if it is
/// missing. Returns the files' paths. Errors: bad_observation, io.
Result<std::vector<std::string>> save_first_frames(const Observation& observation, const Robot& robot,
                                                   const std::string& folder);

}  // namespace vla::serve
