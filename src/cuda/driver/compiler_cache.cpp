// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/driver/compiler_cache.h"

#include <sys/stat.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>

namespace vla::cuda {
namespace {

std::string variable(const char* name) {
  const char* value = std::getenv(name);
  return value != nullptr ? value : "";
}

bool is_writable(const std::string& folder) { return !folder.empty() && ::access(folder.c_str(), W_OK | X_OK) == 0; }

/// A private folder for temporary files, or empty. Refuses a folder that another user owns or may access, because the
/// code in it runs on the device.
std::string temporary() {
  std::error_code failed;
  const std::filesystem::path all = std::filesystem::temp_directory_path(failed);
  if (failed) return "";
  const std::string folder = all / ("vla-cuda-" + std::to_string(::geteuid()));
  struct stat found = {};
  ::mkdir(folder.c_str(), 0700);
  const bool is_ours = ::lstat(folder.c_str(), &found) == 0 && S_ISDIR(found.st_mode) && found.st_uid == ::geteuid() &&
                       (found.st_mode & 077) == 0;
  return is_ours ? folder : "";
}

}  // namespace

std::string compiler_cache() {
  const std::string home = variable("HOME"), cache = variable("XDG_CACHE_HOME");
  if (!variable("CUDA_CACHE_PATH").empty() || is_writable(home) || (!home.empty() && is_writable(home + "/.nv")))
    return "";
  return is_writable(cache) ? cache + "/vla-cuda" : temporary();
}

}  // namespace vla::cuda
