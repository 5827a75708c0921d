// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "bench/report.h"

namespace vla::bench {

/// The roofline of a report as an SVG image: operations per second over operations per byte, both logarithmic. The
/// roofs are what the machine was measured to do, the points what the stages did.
/// Source of the model: Williams, Waterman and Patterson, Roofline (CACM 52(4), 2009).
std::string draw_roofline(const Report& report);

}  // namespace vla::bench
