// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "base/result.h"

namespace vla {

/// Takes no memory itself: the texts fit into the strings.
inline Error out_of_memory(const char* where) {
  return {Code::out_of_memory, where, "", "no memory left", "ask again later"};
}

}  // namespace vla
