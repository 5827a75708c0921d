// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "engine/engine.h"

namespace vla::serve {

/// Computes an act of a synthetic observation for each robot, with every view and the longest text, so that the first
/// client does not pay for what happens once, and so that a policy whose actions are not finite never answers a robot.
/// Then one act of each of `sizes` that this policy can have. Returns milliseconds. Errors:
/// bad_action, with the first value of the network that is not finite; bad_observation where the policy takes no such
/// observation; device, out_of_memory, internal.
Result<double> warm_up(Engine& engine, const std::vector<ActShape>& sizes = {});

}  // namespace vla::serve
