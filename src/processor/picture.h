// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "processor/processor.h"

namespace vla {

/// An 8-bit picture, for people, of the planes that `Processor::encode_images` computes from a frame of this view.
/// Values are scaled so that the recipe's results for black and white become black and white. Errors: bad_observation.
Result<Frame> picture_of(const Processor& processor, const Frame& frame, int view);

}  // namespace vla
