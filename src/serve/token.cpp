// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/token.h"

#include <fmt/format.h>
#include <sys/stat.h>

#include <algorithm>

#include "base/file.h"

namespace vla::serve {

Result<std::string> read_token(const std::string& file) {
  if (file.empty()) return std::string();
  VLA_TRY(const std::vector<std::byte> bytes, read_file(file, 4096));
  const std::string text(reinterpret_cast<const char*>(bytes.data()), bytes.size());
  const std::string token = text.substr(0, text.find_first_of("\r\n"));
  const bool is_plain = std::all_of(token.begin(), token.end(), [](char c) { return c > ' ' && c < 0x7F; });
  if (token.empty() || !is_plain)
    return Error{Code::usage, file, "a line of ASCII characters without spaces", "something else"};
  struct stat info;
  if (::stat(file.c_str(), &info) == 0 && (info.st_mode & 077) != 0)
    return Error{Code::usage, file, "a secret that only its owner may read",
                 fmt::format("mode {:o}", info.st_mode & 0777), "chmod 600 " + file};
  return token;
}

bool is_same_secret(std::string_view a, std::string_view b) {
  unsigned difference = a.size() != b.size();
  for (std::size_t i = 0; i < std::min(a.size(), b.size()); ++i)
    difference |= static_cast<unsigned>(static_cast<unsigned char>(a[i]) ^ static_cast<unsigned char>(b[i]));
  return difference == 0;
}

}  // namespace vla::serve
