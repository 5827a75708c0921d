// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/result.h"

namespace vla {

/// Allocates nothing: the texts fit into the strings' own buffers.
inline Error out_of_memory(const char* where) {
  return {Code::out_of_memory, where, "", "no memory left", "ask again later"};
}

}  // namespace vla
