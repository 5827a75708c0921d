// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "processor/processor.h"

namespace vla {

/// Names of actions that never change by more than 1e-5, whatever the network computes, because their statistics have
/// no spread.
std::vector<std::string> constant_actions(const Processor& processor, int horizon, int d_action);

}  // namespace vla
