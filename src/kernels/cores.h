// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

namespace vla::kernels {

/// Numbers of the cores that this thread may run on.
std::vector<int> allowed_cores();

/// Those of them with at least three quarters of the greatest capacity, as Linux gives it in cpuN/cpu_capacity of a
/// folder: of big and little cores the big ones, all of one cluster whose chips differ a little. All where the system
/// does not tell the capacity of each. A phase waits for its last item, which a little core takes two to four times as
/// long for.
std::vector<int> big_cores(const std::vector<int>& cores, const std::string& folder = "/sys/devices/system/cpu");

/// Lets this thread run on these cores only, as far as the system permits it.
void stay_on(const std::vector<int>& cores);

}  // namespace vla::kernels
