// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "fuzz/act_target.h"
#include "fuzz/mutant.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  vla::fuzz::check_act({reinterpret_cast<const char*>(data), size});
  return 0;
}

/// Changes keys and tensors instead of bytes, almost none of which mean anything in a file of weights.
extern "C" std::size_t LLVMFuzzerCustomMutator(std::uint8_t* data, std::size_t size, std::size_t max_size,
                                               unsigned seed) {
  vla::fuzz::Random random(seed);
  const std::string bytes = vla::fuzz::mutant({reinterpret_cast<const char*>(data), size}, random);
  if (bytes.size() > max_size) return size;
  std::copy(bytes.begin(), bytes.end(), data);
  return bytes.size();
}
