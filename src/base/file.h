// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "base/result.h"

namespace vla {

/// The bytes of a regular file of at most `limit` bytes. Errors: io, naming the path.
Result<std::vector<std::byte>> read_file(const std::string& path, std::size_t limit);

/// Writes a file that does not exist yet. The file is written completely or not at all. Errors: io.
Status write_new_file(const std::string& path, std::span<const std::byte> bytes, unsigned mode);
/// Writes a file completely or not at all: writes the bytes to a new file in the same folder, which takes the old one's
/// name and mode once all bytes are on the disk. A killed program leaves at most a part, which the next call for this
/// path removes. Symbolic links are followed and kept. Pipes, devices and open files such as /dev/stdout or /dev/fd/3
/// are written in place, once all bytes have been produced. Errors: io.
Status write_file(const std::string& path, std::span<const std::byte> bytes);
/// The same, for bytes that `write` puts into an open file, in any order. `write` returns false, with errno set, on
/// failure.
using WriteTo = std::function<bool(int file)>;
Status write_file(const std::string& path, const WriteTo& write);
/// Opens an empty temporary file that is deleted when it is closed. Returns -1, with errno set, on failure.
int open_temporary();
/// Writes all bytes. Returns false, with errno set, on failure.
bool write_all(int file, std::span<const std::byte> bytes);
inline Status write_file(const std::string& path, const std::string& text) {
  return write_file(path, std::as_bytes(std::span(text)));
}

}  // namespace vla
