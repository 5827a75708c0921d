// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "processor/processor.h"

namespace vla {

/// The planes that `Processor::encode_images` makes of a frame of this view, as an 8-bit picture for people. Values are
/// scaled so that the recipe's results for black and white are black and white. Errors: bad_observation.
Result<Frame> picture_of(const Processor& processor, const Frame& frame, int view);

}  // namespace vla
