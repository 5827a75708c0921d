// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "ggml/guard.h"

#include <atomic>
#include <cstdio>
#include <stdexcept>

namespace vla {
namespace {

constexpr std::size_t kMaxLog = 1024;  // bytes of the log that are kept, up to one message more

std::atomic<bool> aborted = false;
thread_local int n_guard = 0;
thread_local std::string logged;  // errors of ggml since the outermost guard began

void on_log(ggml_log_level level, const char* text, void*) {
  if (n_guard > 0 && level == GGML_LOG_LEVEL_ERROR && logged.size() < kMaxLog) logged += text;
}

/// ggml ends the process when this returns.
void on_abort(const char* message) {
  if (n_guard == 0) {
    std::fprintf(stderr, "%s\n", message);
    return;
  }
  aborted = true;
  throw std::runtime_error(logged + message);
}

/// "a", "  b" -> "a; b"
std::string joined(const std::string& lines) {
  std::string line;
  for (const char c : lines)
    if (c == '\n')
      line += "; ";
    else if (c != ' ' || !line.ends_with(' '))
      line += c;
  return line;
}

}  // namespace

void set_guard() noexcept {
  ggml_log_set(on_log, nullptr);
  ggml_set_abort_callback(on_abort);
}

bool ggml_aborted() noexcept { return aborted; }

Guard::Guard() noexcept {
  if (n_guard++ == 0) logged.clear();
}

Guard::~Guard() { --n_guard; }

Error lost_device(const std::string& device, const std::string& what) {
  return {Code::device, device, "a device that answers", joined(what),
          "start the process again; the system's log may say more"};
}

}  // namespace vla
