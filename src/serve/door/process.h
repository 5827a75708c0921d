// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sys/types.h>

#include <string>
#include <vector>

#include "base/result.h"

namespace vla::serve {

/// A program that the server starts and ends. It inherits two descriptors: 3, its end of a socket to the server, and 4,
/// the given one.
class Process {
 public:
  /// Starts `name`, which lies beside this program or in ../libexec/vla. Errors: unsupported if it is missing, io if
  /// the system starts no process.
  static Result<Process> start(const std::string& name, const std::vector<std::string>& arguments, int descriptor,
                               const char* option);
  Process() = default;
  Process(Process&& other) noexcept { *this = std::move(other); }
  Process& operator=(Process&& other) noexcept;
  /// Ends it at once.
  ~Process() { kill(); }

  /// Returns our end of the socket, once; the caller must close it.
  int take_socket() { return std::exchange(socket_, -1); }
  /// Whether it is stopped (SIGSTOP).
  bool is_stopped() const;
  /// Waits at most this long for it to end; false if it still runs.
  bool wait_for(int milliseconds);
  /// Kills it if it still runs. Returns how it ended, for display.
  std::string kill();

 private:
  pid_t pid_ = 0;
  int socket_ = -1, status_ = 0;
};

}  // namespace vla::serve
