// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/file.h"

#include <fmt/format.h>

#include <filesystem>
#include <fstream>

namespace vla {

Result<std::vector<std::byte>> read_file(const std::string& path, std::size_t limit) {
  std::error_code error;
  if (!std::filesystem::is_regular_file(path, error))
    return Error{Code::io, path, "a file", error ? error.message() : "something that is not a regular file"};
  const std::uintmax_t size = std::filesystem::file_size(path, error);
  if (error) return Error{Code::io, path, "a readable file", error.message()};
  if (size > limit) return Error{Code::io, path, fmt::format("at most {} bytes", limit), fmt::format("{} bytes", size)};
  std::vector<std::byte> bytes(size);
  std::ifstream stream(path, std::ios::binary);
  stream.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(size));
  if (!stream) return Error{Code::io, path, "a readable file", "an error while reading"};
  return bytes;
}

}  // namespace vla
