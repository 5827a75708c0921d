// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/guard.h"

#include <doctest/doctest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <memory>
#include <stdexcept>

#include "ggml/ggml_device.h"

namespace ggml_guard_test {

using namespace vla;

namespace {

void log_nothing(ggml_log_level, const char*, void*) {}

/// What ggml does where a driver fails: it logs the reason, then aborts, deep in functions of C++ and C.
void fail_as_ggml_does(const std::shared_ptr<int>&) {
  ggml_log_callback log = log_nothing;
  void* data = nullptr;
  ggml_log_get(&log, &data);
  log(GGML_LOG_LEVEL_ERROR, "CUDA error: an illegal memory access\n  current device: 0\n", data);
  ggml_new_tensor_1d(nullptr, GGML_TYPE_COUNT, 1);  // an assertion in a function of C
}

}  // namespace

TEST_CASE("ggml's abort in a guarded call is a device error with what was logged, and what the call held is freed") {
  set_guard();
  const auto held = std::make_shared<int>();
  const Status status = guarded("cuda:0", [&] { fail_as_ggml_does(std::shared_ptr<int>(held)); });
  REQUIRE_FALSE(status.ok());
  CHECK(status.error().code == Code::device);
  const std::string message = status.error().message();
  CHECK_MESSAGE(
      message.starts_with("cuda:0: expected a device that answers, found CUDA error: an illegal memory access; "
                          "current device: 0; "),
      message);
  CHECK_MESSAGE(message.find("ggml.c:") != std::string::npos, message);
  CHECK(held.use_count() == 1);
  CHECK(ggml_aborted());
}

TEST_CASE("exceptions of a driver are errors; one that says there is no memory is out_of_memory") {
  CHECK(guarded("vulkan:0", [] {}).ok());
  CHECK(guarded("vulkan:0", [] { throw std::runtime_error("lost"); }).error().code == Code::device);
  CHECK(guarded("vulkan:0", [] { throw std::bad_alloc(); }).error().code == Code::out_of_memory);
}

TEST_CASE("ggml's abort outside of a guarded call ends the process") {
  set_guard();
  static_cast<void>(guarded("cpu", [] {}));
  const pid_t child = fork();
  REQUIRE(child >= 0);
  if (child == 0) {
    std::signal(SIGABRT, SIG_DFL);  // not doctest's
    close(STDERR_FILENO);
    try {
      ggml_abort(__FILE__, __LINE__, "not guarded");
    } catch (...) {
    }
    _exit(0);
  }
  int status = 0;
  REQUIRE(waitpid(child, &status, 0) == child);
  CHECK(WIFSIGNALED(status));
  CHECK(WTERMSIG(status) == SIGABRT);
}

TEST_CASE("a device that failed once answers every later call with that error, and is freed in peace") {
  auto opened = GgmlDevice::cpu(2);
  REQUIRE(opened.ok());
  auto& device = static_cast<GgmlDevice&>(**opened);
  CHECK(device.failure().ok());
  const std::string reason = device.guarded([] { ggml_abort("driver.cu", 7, "lost"); }).error().message();
  CHECK(device.failure().error().message() == reason);
  bool called = false;
  CHECK(device.guarded([&] { called = true; }).error().message() == reason);
  CHECK_FALSE(called);
  opened->reset();
}

}  // namespace ggml_guard_test
