// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "bench/report.h"

namespace vla::bench {

/// Draws a report's roofline as SVG: operations per second over operations per byte, both logarithmic. Roofs are the
/// measured limits of the machine, points the stages. Source of the model: Williams, Waterman and Patterson, Roofline
/// (CACM 52(4), 2009).
std::string draw_roofline(const Report& report);

}  // namespace vla::bench
