// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "kernels/cores.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <thread>

namespace cores_test {

using namespace vla::kernels;

namespace {

/// A folder as Linux's /sys/devices/system/cpu, with a capacity for each core; none where it is zero.
class Folder {
 public:
  explicit Folder(const std::vector<int>& capacities) {
    std::filesystem::remove_all(path_);
    for (std::size_t i = 0; i < capacities.size(); ++i) {
      const std::filesystem::path core = path_ / ("cpu" + std::to_string(i));
      std::filesystem::create_directories(core);
      if (capacities[i] != 0) std::ofstream(core / "cpu_capacity") << capacities[i] << '\n';
    }
  }
  ~Folder() { std::filesystem::remove_all(path_); }
  std::vector<int> big_of(const std::vector<int>& cores) const { return big_cores(cores, path_.string()); }

 private:
  std::filesystem::path path_ = std::filesystem::temp_directory_path() / "vla_cores_test";
};

using Cores = std::vector<int>;

}  // namespace

TEST_CASE("threads run on the big cores where capacities differ") {
  const Folder rk3588({397, 397, 397, 397, 1024, 1024, 1018, 1018});
  CHECK(rk3588.big_of({0, 1, 2, 3, 4, 5, 6, 7}) == Cores{4, 5, 6, 7});
  CHECK(rk3588.big_of({1, 2, 5}) == Cores{5});
  CHECK(rk3588.big_of({0, 1}) == Cores{0, 1});  // the process may use no other
}

TEST_CASE("threads run on all cores where they are alike, or the system does not tell") {
  CHECK(Folder({1024, 1024, 1024, 1024}).big_of({0, 1, 2, 3}) == Cores{0, 1, 2, 3});
  CHECK(Folder({1024, 400, 0, 1024}).big_of({0, 1, 2, 3}) == Cores{0, 1, 2, 3});
  CHECK(big_cores({0, 3}, "/nonexistent") == Cores{0, 3});
}

TEST_CASE("a thread stays on the cores that it is given, and others do not") {
  const Cores before = allowed_cores();
  Cores inside;
  std::thread([&] {
    stay_on({before.back()});
    inside = allowed_cores();
  }).join();
  CHECK(inside == Cores{before.back()});
  CHECK(allowed_cores() == before);
}

}  // namespace cores_test
