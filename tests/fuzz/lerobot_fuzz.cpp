// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "fuzz/lerobot_target.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  vla::fuzz::check_lerobot(std::as_bytes(std::span(data, size)));
  return 0;
}
