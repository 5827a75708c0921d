// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "engine/engine.h"
#include "serve/options.h"
#include "wire/vla.pb.h"

namespace vla::serve {

/// Returns the picture that the network gets of one view of an act (picture_of), for the robot that the act names. The
/// view may cost at most `max_pixels`, as in an act with this view alone. Any thread may call it. Errors:
/// bad_observation, too_large.
Result<Frame> seen(const v1::Act& act, int view, const Engine& engine, std::int64_t max_pixels);

}  // namespace vla::serve
