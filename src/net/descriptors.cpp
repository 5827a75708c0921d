// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "net/descriptors.h"

#include <sys/resource.h>

#include <filesystem>
#include <system_error>

namespace vla::net {

std::size_t spare_descriptors() {
  rlimit limit = {};
  ::getrlimit(RLIMIT_NOFILE, &limit);
  limit.rlim_cur = limit.rlim_max;
  ::setrlimit(RLIMIT_NOFILE, &limit);
  ::getrlimit(RLIMIT_NOFILE, &limit);
  std::error_code unreadable;
  std::size_t n_open = 0;
  for (const auto& each : std::filesystem::directory_iterator("/proc/self/fd", unreadable))
    n_open += each.is_symlink(unreadable);
  return limit.rlim_cur > n_open ? limit.rlim_cur - n_open : 0;
}

}  // namespace vla::net
