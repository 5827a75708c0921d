// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cli/say.h"

#include <cerrno>
#include <system_error>

namespace vla::cli {

void put(std::FILE* to, std::string_view text) {
  if (std::fwrite(text.data(), 1, text.size(), to) == text.size() || to == stderr) return;
  throw std::system_error(errno, std::generic_category());
}

void say_lines(std::FILE* to, std::string_view text) {
  std::string out;
  for (std::size_t end; !text.empty(); text.remove_prefix(std::min(end + 1, text.size()))) {
    end = std::min(text.find('\n'), text.size());
    out += printable(text.substr(0, end));
    if (end < text.size()) out += '\n';
  }
  put(to, out);
}

}  // namespace vla::cli
