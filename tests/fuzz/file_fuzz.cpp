// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <unistd.h>

#include "fuzz/file_target.h"

/// The first byte says which kind of file the others are.
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const std::string folder = "/dev/shm/vla-file-fuzz-" + std::to_string(::getpid());
  if (size == 0) return 0;
  const std::string_view bytes(reinterpret_cast<const char*>(data) + 1, size - 1);
  vla::fuzz::check_file(static_cast<vla::fuzz::FileKind>(data[0] % 3), bytes, folder);
  return 0;
}
