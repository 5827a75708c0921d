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
/// Writes a file whole or not at all: the bytes go into a new file beside it, which takes its name and mode when all of
/// them are on the disk. A program that is killed leaves nothing, or, on file systems without files that have no name,
/// a part which the next one removes. Links are followed, and stay. What is no regular file, such as a pipe or a
/// device, and an open file by the name of /dev/stdout or /dev/fd/3, get the bytes when all of them are made. Errors:
/// io.
Status write_file(const std::string& path, std::span<const std::byte> bytes);
/// The same, for bytes that `write` puts into an open file, in any order. `write` returns false, with errno set, on
/// failure.
using WriteTo = std::function<bool(int file)>;
Status write_file(const std::string& path, const WriteTo& write);
/// An empty file in the folder of temporary files, which is gone when it is closed; -1, with errno set, on failure.
int open_temporary();
/// Writes all bytes; false with errno set on failure.
bool write_all(int file, std::span<const std::byte> bytes);
inline Status write_file(const std::string& path, const std::string& text) {
  return write_file(path, std::as_bytes(std::span(text)));
}

}  // namespace vla
