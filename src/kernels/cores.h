// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

namespace vla::kernels {

/// Indices of the cores that this thread may run on.
std::vector<int> allowed_cores();

/// The big cores: those with at least three quarters of the largest capacity in cpuN/cpu_capacity, which allows small
/// differences between chips. All cores if the system does not report every capacity. Little cores are left out because
/// a phase waits for its last item, and a little core takes two to four times as long for an item.
std::vector<int> big_cores(const std::vector<int>& cores, const std::string& folder = "/sys/devices/system/cpu");

/// Pins this thread to these cores, as far as the system permits.
void stay_on(const std::vector<int>& cores);

}  // namespace vla::kernels
