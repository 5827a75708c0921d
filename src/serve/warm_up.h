// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "engine/engine.h"

namespace vla::serve {

/// Computes one act for each robot, from a synthetic observation with every view and the longest text. So the first
/// client does not pay one-time costs, and a policy whose actions are not finite never answers a robot. Then computes
/// one act of each of `sizes` that fits this policy. Returns milliseconds. Errors: bad_action, naming the network's
/// first value that is not finite; bad_observation if the policy refuses the synthetic observations; device,
/// out_of_memory, internal.
Result<double> warm_up(Engine& engine, const std::vector<ActShape>& sizes = {});

}  // namespace vla::serve
