// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <csignal>
#include <initializer_list>

namespace vla::cli {

/// Handles SIGTERM, SIGINT and SIGHUP as long as it exists. Destroy it before what the handler uses: the main thread
/// runs all handlers, since other threads block signals (start_thread), so none can be running then.
class EndSignals {
 public:
  /// `stays_ignored`: those that are left alone if the parent process ignores them, as nohup ignores SIGHUP.
  EndSignals(void (*handler)(int signal), std::initializer_list<int> stays_ignored) {
    struct sigaction action = {};
    action.sa_handler = handler;
    for (std::size_t i = 0; i < kSignals.size(); ++i) {
      sigaction(kSignals[i], nullptr, &before_[i]);
      const bool is_kept = std::find(stays_ignored.begin(), stays_ignored.end(), kSignals[i]) != stays_ignored.end();
      if (!is_kept || before_[i].sa_handler != SIG_IGN) sigaction(kSignals[i], &action, nullptr);
    }
  }
  ~EndSignals() {
    for (std::size_t i = 0; i < kSignals.size(); ++i) sigaction(kSignals[i], &before_[i], nullptr);
  }
  EndSignals(const EndSignals&) = delete;
  EndSignals& operator=(const EndSignals&) = delete;

  /// Ends the process as if nothing handled the signal. For handlers.
  static void end_by(int signal) {
    std::signal(signal, SIG_DFL);
    std::raise(signal);
  }

 private:
  static constexpr std::array<int, 3> kSignals = {SIGTERM, SIGINT, SIGHUP};
  std::array<struct sigaction, 3> before_ = {};
};

}  // namespace vla::cli
