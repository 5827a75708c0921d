// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/driver/compiler_cache.h"

#include <doctest/doctest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <map>
#include <optional>

namespace compiler_cache_test {

using vla::cuda::compiler_cache;

namespace {

/// The environment without these variables, and a folder of the test's own for temporary files; as it was afterwards.
struct Bare {
  Bare() {
    for (const char* name : {"CUDA_CACHE_PATH", "HOME", "XDG_CACHE_HOME", "TMPDIR"}) {
      const char* value = std::getenv(name);
      before[name] = value != nullptr ? std::optional<std::string>(value) : std::nullopt;
      unsetenv(name);
    }
    char name[] = "/tmp/vla-cache-test-XXXXXX";
    folder = mkdtemp(name);
    set("TMPDIR", folder);
  }
  ~Bare() {
    for (const auto& [name, value] : before) value ? setenv(name.c_str(), value->c_str(), 1) : unsetenv(name.c_str());
    std::filesystem::remove_all(folder);
  }
  static void set(const char* name, const std::string& value) { setenv(name, value.c_str(), 1); }
  std::string own() const { return folder + "/vla-cuda-" + std::to_string(geteuid()); }

  std::map<std::string, std::optional<std::string>> before;
  std::string folder;
};

}  // namespace

TEST_CASE_FIXTURE(Bare, "the driver's own folder for compiled kernels stands where it has one") {
  set("HOME", folder);
  CHECK(compiler_cache().empty());
  set("HOME", "/absent");
  set("CUDA_CACHE_PATH", "/elsewhere");
  CHECK(compiler_cache().empty());
}

TEST_CASE_FIXTURE(
    Bare, "without a home compiled kernels are kept in the cache of the user, or in a folder of this user's alone") {
  set("XDG_CACHE_HOME", folder);
  CHECK(compiler_cache() == folder + "/vla-cuda");
  unsetenv("XDG_CACHE_HOME");
  set("HOME", "/absent");
  CHECK(compiler_cache() == own());
  struct stat made = {};
  REQUIRE(stat(own().c_str(), &made) == 0);
  CHECK((made.st_mode & 0777) == 0700);
  CHECK(compiler_cache() == own());
}

TEST_CASE_FIXTURE(Bare, "a folder that others may write to, or that is a link, keeps no compiled kernels") {
  REQUIRE(mkdir(own().c_str(), 0700) == 0);
  REQUIRE(chmod(own().c_str(), 0770) == 0);
  CHECK(compiler_cache().empty());
  std::filesystem::remove(own());
  std::filesystem::create_directory_symlink(folder, own());
  CHECK(compiler_cache().empty());
}

}  // namespace compiler_cache_test
