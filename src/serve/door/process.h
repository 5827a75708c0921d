// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sys/types.h>

#include <string>
#include <vector>

#include "base/result.h"

namespace vla::serve {

/// A program that the server starts and ends. It has descriptor 3, an end of a socket to the server, and 4, the one
/// that is given.
class Process {
 public:
  /// `name` lies beside this program or in ../libexec/vla. Errors: unsupported where there is none, io where the system
  /// starts no process.
  static Result<Process> start(const std::string& name, const std::vector<std::string>& arguments, int descriptor,
                               const char* option);
  Process() = default;
  Process(Process&& other) noexcept { *this = std::move(other); }
  Process& operator=(Process&& other) noexcept;
  /// Ends it at once.
  ~Process() { kill(); }

  /// Our end of the socket, which the caller has to close; once.
  int take_socket() { return std::exchange(socket_, -1); }
  /// Whether somebody has stopped it (SIGSTOP).
  bool is_stopped() const;
  /// Waits for its end, so long at most; false where it goes on.
  bool wait_for(int milliseconds);
  /// Ends it at once. How it had ended, or that it was killed, for people.
  std::string kill();

 private:
  pid_t pid_ = 0;
  int socket_ = -1, status_ = 0;
};

}  // namespace vla::serve
